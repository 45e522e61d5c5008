"""Compiled kernels against independent implementations in plain NumPy and SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.special import ndtr

from model.pose import Array
from tracking.edges.coarse import locate_edges
from tracking.edges.fit import (
    KIND,
    KIND_DEVIATION,
    REACH,
    REACH_SPREADS,
    SETTLED,
    factored,
    fit_edges,
    ranked,
    solved,
)
from tracking.edges.sampling import (
    ACROSS,
    ALONG,
    BOXED,
    COLUMNS,
    HALF,
    MIDDLE,
    OFFSET,
    OFFSET_VARIANCE,
    SHARE,
    SPREAD,
    TILT,
    VALUE,
    beside,
    blurred_step,
    plane_of,
    sample_edge,
)

SQUARE = np.array([[50.3, 41.2], [98.7, 55.1], [86.2, 104.9], [36.4, 90.0]])
NO_BOW = np.zeros((1, 4, 2))


def box_share(x: Array) -> Array:
    """Cumulative distribution of the uniform one with mean 0 and variance 1."""
    return np.clip(0.5 + x / (2.0 * math.sqrt(3.0)), 0.0, 1.0)


@given(x=st.floats(-6.0, 6.0), boxed=st.floats(0.0, 1.0))
def test_the_blurred_step_is_that_of_a_gaussian_and_a_box_of_unit_variance(
    x: float, boxed: float
) -> None:
    share, slope, kind = blurred_step(x, boxed)
    bell = ndtr(x) if abs(x) < 4.5 else float(x > 0)
    assert share == pytest.approx((1.0 - boxed) * bell + boxed * box_share(x), abs=1e-9)
    assert kind == pytest.approx(box_share(x) - bell, abs=1e-9)
    if abs(x) < 4.5 and abs(abs(x) - math.sqrt(3.0)) > 1e-9:
        bell = math.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi)
        box = (abs(x) < math.sqrt(3.0)) / (2.0 * math.sqrt(3.0))
        assert slope == pytest.approx((1 - boxed) * bell + boxed * box, abs=1e-7)


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40), st.data())
def test_the_ranked_value_is_the_sorted_one(values: list[float], data: st.DataObject) -> None:
    rank = data.draw(st.integers(0, len(values) - 1))
    padded = np.array([*values, -1e9])  # values beyond the count do not matter
    assert ranked(padded, len(values), rank) == sorted(values)[rank]


@pytest.mark.parametrize("size", [1, 2, 8, 15])
def test_symmetric_equations_are_solved(size: int) -> None:
    rng = np.random.default_rng(size)
    root = rng.standard_normal((size, size))
    matrix, right = root @ root.T + 0.1 * np.eye(size), rng.standard_normal(size)
    factor, solution = matrix.copy(), right.copy()
    assert factored(factor, size)
    solved(factor, solution, size)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), rtol=1e-9)
    assert not factored(-matrix, size)


def test_points_of_the_square_are_those_of_its_homography() -> None:
    plane = np.empty(8)
    plane_of(SQUARE, 1, plane)
    for (a, b), corner in zip([(0, 0), (1, 0), (1, 1), (0, 1)], [1, 2, 3, 0], strict=True):
        along, outside = beside(SQUARE, 1, plane, a, b)
        direction = (SQUARE[2] - SQUARE[1]) / np.linalg.norm(SQUARE[2] - SQUARE[1])
        gap = SQUARE[corner] - SQUARE[1]
        assert (along, outside) == pytest.approx(
            (gap @ direction, gap @ [direction[1], -direction[0]]), abs=1e-9
        )
    # The diagonals intersect at the square's centre.
    along, outside = beside(SQUARE, 1, plane, 0.5, 0.5)
    middle = SQUARE[1] + along * direction + outside * np.array([direction[1], -direction[0]])
    for one, other in ((0, 2), (1, 3)):
        p, q = SQUARE[other] - SQUARE[one], middle - SQUARE[one]
        assert p[0] * q[1] - p[1] * q[0] == pytest.approx(0.0, abs=1e-6)


def brute_band(image: Array, edge: int, span: tuple[float, float], reach: float) -> Array:
    """Position, distance and value of the pixels near an edge, from all pixels."""
    start, end = SQUARE[edge], SQUARE[(edge + 1) % 4]
    direction = (end - start) / np.linalg.norm(end - start)
    rows, columns = np.indices(image.shape)
    gap = np.stack([columns - start[0], rows - start[1]], axis=-1)
    s, u = gap @ direction, gap @ [direction[1], -direction[0]]
    inside = (s >= span[0]) & (s <= span[1]) & (np.abs(u) <= reach)
    middle, half = (span[0] + span[1]) / 2.0, (span[1] - span[0]) / 2.0
    return np.array([(s[inside] - middle) / half, u[inside], image[inside]])


@pytest.mark.parametrize("edge", range(4))
def test_the_pixels_beside_an_edge_are_all_that_lie_there(edge: int) -> None:
    image = np.random.default_rng(edge).integers(0, 256, (130, 140), dtype=np.uint8)
    pixels = np.zeros((6, 2000))
    count = sample_edge(image, SQUARE, edge, np.zeros(2), (4.0, 41.5), 3.3, pixels)
    wanted = brute_band(image, edge, (4.0, 41.5), 3.3)
    assert count == wanted.shape[1] > 200
    np.testing.assert_allclose(pixels[[ALONG, ACROSS, VALUE], :count], wanted, atol=1e-9)
    few = np.zeros((6, 120))
    some = sample_edge(image, SQUARE, edge, np.zeros(2), (4.0, 41.5), 3.3, few)
    assert 60 < some <= 120
    assert np.ptp(few[ALONG, :some]) > 1.7  # spread along the whole edge


def black_square(
    spread: float, noise: float, seed: int, alike: float = 0.0, bright: float = 220.0
) -> np.ndarray:
    """A black square on white: ink is the product of four blurred steps.

    Noise is smoothed by a Gaussian of ``alike`` pixels, with its deviation kept.
    """
    rows, columns = np.indices((130, 140))
    ink = np.ones(rows.shape)
    for edge in range(4):
        start, end = SQUARE[edge], SQUARE[(edge + 1) % 4]
        direction = (end - start) / np.linalg.norm(end - start)
        outside = (columns - start[0]) * direction[1] - (rows - start[1]) * direction[0]
        ink *= ndtr(-outside / spread)
    grain = np.random.default_rng(seed).standard_normal(ink.shape)
    if alike > 0.0:
        grain = gaussian_filter(grain, alike)
        grain /= grain.std()
    picture = bright - (bright - 30.0) * ink + noise * grain
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def fitted(image: np.ndarray, quad: Array) -> tuple[Array, Array]:
    """The four edges by the coarse and the final kernel, shape (4, `COLUMNS`) each."""
    widths, before = np.full((1, 4), 6.2), np.zeros((1, 4, COLUMNS))
    locate_edges(image, quad[None], NO_BOW, widths, before)
    found = np.zeros_like(before)
    fit_edges(image, quad[None], NO_BOW, widths, 8, before, found)
    return before[0], found[0]


def reference(image: np.ndarray, edge: int, rough: Array, found: Array) -> tuple[Array, Array]:
    """SciPy's fit of a blurred step: parameters, and deviations of the first two."""
    span = (found[MIDDLE] - found[HALF], found[MIDDLE] + found[HALF])
    reach = REACH_SPREADS * rough[SPREAD] + REACH
    q, u, value = brute_band(image, edge, span, reach)

    def errors(p: Array) -> Array:
        x = (u - p[0] - p[1] * q) / p[2]
        share = (1.0 - p[3]) * ndtr(x) + p[3] * box_share(x)
        dark, bright = p[4] + p[5] * q, p[6] + p[7] * q
        kind = 2.0 * (p[3] - KIND) / KIND_DEVIATION  # 2 is the noise of the images
        return np.append(dark + (bright - dark) * share - value, kind)

    start = [0.0, 0.0, 0.8, 0.5, 30.0, 0.0, 220.0, 0.0]
    best = least_squares(errors, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    variance = 2.0 * best.cost / (len(value) - 8)
    covariance = variance * np.linalg.inv(best.jac.T @ best.jac)
    return best.x, np.sqrt(np.diag(covariance)[:2])


@pytest.mark.parametrize("edge", range(4))
def test_a_fitted_edge_is_the_one_that_scipy_finds(edge: int) -> None:
    image = black_square(spread=0.9, noise=2.0, seed=4)
    rough, found = (edges[edge] for edges in fitted(image, SQUARE))
    best, deviations = reference(image, edge, rough, found)
    assert found[SHARE] == 1.0
    assert found[OFFSET] == pytest.approx(best[0], abs=2.0 * SETTLED)
    assert found[TILT] == pytest.approx(best[1], abs=2.0 * SETTLED)
    assert found[SPREAD] == pytest.approx(best[2], rel=0.01)
    assert found[BOXED] == pytest.approx(best[3], abs=0.05)
    # Independent errors correlate by chance at times: deviations never shrink, rarely grow.
    assert 0.95 < math.sqrt(found[OFFSET_VARIANCE]) / deviations[0] < 1.4


def test_edges_lie_where_they_were_drawn_as_often_as_they_say() -> None:
    errors = []
    for seed in range(30):
        _, found = fitted(black_square(spread=0.7, noise=3.0, seed=seed), SQUARE)
        errors.append(found[:, OFFSET] / np.sqrt(found[:, OFFSET_VARIANCE]))
    assert 0.75 < np.std(errors) < 1.25
    assert abs(np.mean(errors)) < 0.3


def test_correlated_errors_along_an_edge_widen_its_uncertainty() -> None:
    """Noise smoothed over 1.5 px, as by upscaling: a seventh of the independent samples."""
    errors = []
    for seed in range(30):
        _, found = fitted(black_square(spread=1.2, noise=3.0, seed=seed, alike=1.5), SQUARE)
        errors.append(found[:, OFFSET] / np.sqrt(found[:, OFFSET_VARIANCE]))
    assert 0.8 < np.std(errors) < 2.0  # 3 and more if pixels counted as independent


def test_white_that_is_clipped_moves_no_edge() -> None:
    """A lamp saturates the paper; the rest of the step is sufficient."""
    errors = []
    for seed in range(10):
        picture = black_square(spread=0.8, noise=2.0, seed=seed, bright=330.0)
        assert np.mean(picture == 255) > 0.3
        _, found = fitted(picture, SQUARE)
        assert np.all(found[:, SHARE] > 0.5)
        assert np.abs(found[:, OFFSET]).max() < 0.08
        errors.append(found[:, OFFSET] / np.sqrt(found[:, OFFSET_VARIANCE]))
    assert np.std(errors) < 1.6
    assert abs(np.mean(errors)) < 0.5


def test_an_edge_that_is_bent_by_the_lens_is_found_along_its_bow() -> None:
    image = black_square(spread=0.7, noise=0.0, seed=0)
    _, straight = fitted(image, SQUARE)
    rough, found = np.zeros((1, 4, COLUMNS)), np.zeros((1, 4, COLUMNS))
    bows, widths = np.full((1, 4, 2), [0.8, 0.0]), np.full((1, 4), 6.2)
    locate_edges(image, SQUARE[None], bows, widths, rough)
    fit_edges(image, SQUARE[None], bows, widths, 8, rough, found)
    # A bow of 0.8 f (1 - f) is 0.13 px outside its chord on average.
    gone = straight[:, OFFSET] - found[0, :, OFFSET]
    np.testing.assert_allclose(gone, 0.8 / 6.0, atol=0.03)
