"""Facets and capacity margin: against linear programs, direct normals, and themselves."""

from __future__ import annotations

import tracemalloc
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from model.errors import BadInput
from model.statics.feasibility import WrenchBox, capacity_margin, limiting_cables
from model.statics.wrench_sets import wrench_facets
from tests.model.statics.robots import (
    PAPER_LENGTH,
    PAPER_WEIGHT,
    flat_matrix,
    paper_matrices_at_slice,
    paper_matrix,
    random_matrix,
)

seeds = st.integers(0, 2**32 - 1)
cable_counts = st.sampled_from([6, 7, 8, 9, 10])
LENGTH = 0.2
UNITS = np.repeat([1.0, LENGTH], 3)


def random_problem(seed, cables):
    """Return matrix, limits and an external wrench, within reach in some problems only."""
    random = np.random.default_rng(seed)
    matrix = random_matrix(seed, cables)
    low = random.uniform(0.0, 10.0, cables)
    high = low + random.uniform(10.0, 90.0, cables)
    tensions = (low + high) / 2.0 + (high - low) * random.uniform(-0.7, 0.7, cables)
    return matrix, low, high, -matrix @ tensions


def room_along(matrix, low, high, wrench, direction):
    """Return how far the cables' wrench can go along a direction, by a linear program."""
    scaled = matrix / UNITS[:, np.newaxis]
    answer = linprog(
        np.append(np.zeros(matrix.shape[1]), -1.0),
        A_eq=np.column_stack([scaled, -direction]),
        b_eq=-wrench / UNITS,
        bounds=[*zip(low, high, strict=True), (None, None)],
    )
    return -answer.fun if answer.status == 0 else None


def smallest_gap(matrix, low, high, wrench):
    """Return the smallest gap to a facet plane, and the plane's normal, five columns at a time."""
    scaled = matrix / UNITS[:, np.newaxis]
    gaps = []
    for five in combinations(range(matrix.shape[1]), 5):
        normal = np.linalg.svd(scaled[:, five].T)[2][-1]
        for side in (normal, -normal):
            gains = side @ scaled
            reach = np.maximum(gains * low, gains * high).sum()
            gaps.append((reach - side @ (-wrench / UNITS), side))
    return min(gaps, key=lambda gap: gap[0])


def holdable(matrix, low, high, wrench):
    bounds = list(zip(low, high, strict=True))
    return linprog(np.zeros(len(low)), A_eq=matrix, b_eq=-wrench, bounds=bounds).status == 0


@settings(max_examples=60)
@given(seed=seeds, cables=cable_counts)
def test_margin_is_positive_exactly_where_a_linear_program_finds_tensions(seed, cables):
    matrix, low, high, wrench = random_problem(seed, cables)
    margin = float(capacity_margin(matrix, low, high, WrenchBox.of_one(wrench), LENGTH))
    if abs(margin) > 1e-5:
        assert (margin > 0.0) == holdable(matrix, low, high, wrench)


@settings(max_examples=60)
@given(seed=seeds, cables=cable_counts)
def test_margin_inside_is_the_distance_to_the_boundary(seed, cables):
    """The distance out along the binding normal is the margin, and no other is shorter."""
    matrix, low, high, wrench = random_problem(seed, cables)
    margin = float(capacity_margin(matrix, low, high, WrenchBox.of_one(wrench), LENGTH))
    if margin > 1e-5:
        _, binding_normal = smallest_gap(matrix, low, high, wrench)
        distance_out = room_along(matrix, low, high, wrench, binding_normal)
        assert distance_out == pytest.approx(margin, rel=1e-5, abs=1e-6)
        other = np.random.default_rng(seed).normal(size=6)
        other /= np.linalg.norm(other)
        assert room_along(matrix, low, high, wrench, other) >= margin - 1e-6


@settings(max_examples=40)
@given(seed=seeds, cables=cable_counts)
def test_facets_are_those_of_the_columns_themselves(seed, cables):
    """The null-space route gives the same planes as five columns at a time."""
    matrix, low, high, wrench = random_problem(seed, cables)
    margin = float(capacity_margin(matrix, low, high, WrenchBox.of_one(wrench), LENGTH))
    gap, _ = smallest_gap(matrix, low, high, wrench)
    assert margin == pytest.approx(gap, rel=1e-6, abs=1e-7)


@given(seed=seeds, cables=cable_counts)
def test_every_plane_touches_the_set_and_none_cuts_it(seed, cables):
    matrix, low, high, _ = random_problem(seed, cables)
    facets = wrench_facets(matrix, low, high, LENGTH)
    np.testing.assert_allclose(np.linalg.norm(facets.normals, axis=-1), 1.0, rtol=1e-12)
    tensions = np.random.default_rng(seed).uniform(low, high, (50, cables))
    along = tensions @ (matrix / UNITS[:, np.newaxis]).T @ facets.normals.T
    assert (along <= facets.upper + 1e-9).all()
    assert (along >= facets.lower - 1e-9).all()
    farthest = np.where(facets.cable_gains > 0.0, high, low)
    touching = (facets.cable_gains * farthest).sum(axis=-1)
    np.testing.assert_allclose(touching, facets.upper, rtol=1e-9, atol=1e-9)


@settings(max_examples=30)
@given(seed=seeds, cables=cable_counts)
def test_margin_of_a_box_is_that_of_its_worst_corner(seed, cables):
    matrix, low, high, wrench = random_problem(seed, cables)
    half_widths = np.random.default_rng(seed).uniform(0.0, 3.0, 6) * UNITS
    box = WrenchBox(wrench, half_widths)
    corners = wrench + np.array(list(product([-1.0, 1.0], repeat=6))) * half_widths
    repeated = np.broadcast_to(matrix, (64, *matrix.shape))
    at_corners = capacity_margin(repeated, low, high, WrenchBox.of_one(corners), LENGTH)
    assert capacity_margin(matrix, low, high, box, LENGTH) == pytest.approx(at_corners.min())


@given(seed=seeds, cables=cable_counts)
def test_margin_does_not_depend_on_the_order_of_cables_nor_on_the_world_axes(seed, cables):
    matrix, low, high, wrench = random_problem(seed, cables)
    random = np.random.default_rng(seed)
    order = random.permutation(cables)
    turn = np.kron(np.eye(2), np.linalg.qr(random.normal(size=(3, 3)))[0])
    expected = float(capacity_margin(matrix, low, high, WrenchBox.of_one(wrench), LENGTH))
    same = capacity_margin(
        turn @ matrix[:, order], low[order], high[order], WrenchBox.of_one(turn @ wrench), LENGTH
    )
    assert same == pytest.approx(expected, rel=1e-7, abs=1e-8)


@given(seed=seeds, cables=cable_counts)
def test_wider_limits_never_lower_the_margin(seed, cables):
    matrix, low, high, wrench = random_problem(seed, cables)
    box = WrenchBox.of_one(wrench)
    wider = capacity_margin(matrix, low - 1.0, high + 1.0, box, LENGTH)
    assert wider > capacity_margin(matrix, low, high, box, LENGTH)


def test_the_paper_holds_its_weight_with_taut_cables_but_not_fifty_times_as_much():
    light, heavy = WrenchBox.of_one(PAPER_WEIGHT), WrenchBox.of_one(100.0 * PAPER_WEIGHT)
    assert capacity_margin(paper_matrix(), 5.0, 100.0, light, PAPER_LENGTH) > 0.0
    assert capacity_margin(paper_matrix(), 5.0, 100.0, heavy, PAPER_LENGTH) < 0.0


@settings(max_examples=60)
@given(seed=seeds, cables=cable_counts)
def test_only_the_limits_of_the_limiting_cables_change_the_margin(seed, cables):
    matrix = random_matrix(seed, cables)
    random = np.random.default_rng(seed)
    wrench = -matrix @ random.uniform(-10.0, 120.0, cables)
    box = WrenchBox(wrench, random.uniform(0.0, 3.0, 6) * UNITS)
    low, high = np.full(cables, 5.0), np.full(cables, 100.0)
    margin = float(capacity_margin(matrix, low, high, box, LENGTH))
    at_largest, at_smallest = map(list, limiting_cables(matrix, 5.0, 100.0, box, LENGTH))
    others_low, others_high = low - 1.0, high + 1.0
    others_low[at_smallest], others_high[at_largest] = 5.0, 100.0
    unchanged = capacity_margin(matrix, others_low, others_high, box, LENGTH)
    assert unchanged == pytest.approx(margin, rel=1e-6, abs=1e-6)
    low[at_smallest] += 1.0
    high[at_largest] -= 1.0
    assert capacity_margin(matrix, low, high, box, LENGTH) < margin


@pytest.mark.parametrize("cables", [6, 7, 8, 9])
def test_a_load_too_light_or_too_heavy_under_a_ceiling_binds_one_kind_of_limit(cables):
    matrix = random_matrix(4, cables, suspended=True)
    held = -matrix @ np.full(cables, 30.0)
    light, heavy = WrenchBox.of_one(0.01 * held), WrenchBox.of_one(100.0 * held)
    assert limiting_cables(matrix, 5.0, 100.0, light, LENGTH)[0] == ()
    assert limiting_cables(matrix, 5.0, 100.0, heavy, LENGTH)[1] == ()


def test_gravity_has_the_sign_of_an_external_wrench():
    """A suspended robot carries a load that pulls down and none that pushes up."""
    outlets_above = random_matrix(11, 8, suspended=True)
    carried = -outlets_above @ np.full(8, 30.0)
    assert carried[2] < 0.0
    down, up = WrenchBox.of_one(carried), WrenchBox.of_one(-carried)
    assert capacity_margin(outlets_above, 0.0, 100.0, down, LENGTH) > 0.0
    assert capacity_margin(outlets_above, 0.0, 100.0, up, LENGTH) < 0.0


def test_a_batch_with_a_wrench_and_limits_a_pose_equals_its_poses_one_by_one():
    matrices = paper_matrices_at_slice(12)
    random = np.random.default_rng(5)
    low, high = random.uniform(0.0, 9.0, (144, 8)), random.uniform(50.0, 99.0, (144, 8))
    centres, half_widths = random.normal(size=(144, 6)), np.full(6, 0.1)
    batched = capacity_margin(matrices, low, high, WrenchBox(centres, half_widths), PAPER_LENGTH)
    singly = [
        float(capacity_margin(m, a, b, WrenchBox(c, half_widths), PAPER_LENGTH))
        for m, a, b, c in zip(matrices, low, high, centres, strict=True)
    ]
    np.testing.assert_allclose(batched, singly, rtol=1e-10)


@pytest.mark.parametrize("matrix", [flat_matrix(), paper_matrix()[:, :5], np.zeros((6, 8))])
@pytest.mark.parametrize("wrench", [np.zeros(6), PAPER_WEIGHT, np.arange(6.0)])
def test_without_full_rank_nothing_is_feasible_and_nothing_is_nan(matrix, wrench):
    box = WrenchBox.of_one(wrench)
    assert capacity_margin(np.array([matrix]), 1.0, 100.0, box, 0.1) == [-np.inf]


def test_one_singular_pose_does_not_touch_its_neighbours_in_a_batch():
    box = WrenchBox.of_one(PAPER_WEIGHT)
    margins = capacity_margin(
        np.array([paper_matrix(), flat_matrix(), paper_matrix()]), 1.0, 100.0, box, PAPER_LENGTH
    )
    assert margins[1] == -np.inf
    assert margins[0] == margins[2] > 0.0


def test_dependent_columns_that_span_no_facet_do_no_harm():
    """Two equal cables are as good as one with twice the range."""
    matrix = random_matrix(21, 7)
    doubled = np.column_stack([matrix, matrix[:, 0]])
    box = WrenchBox.of_one(-matrix @ np.full(7, 40.0))
    high = np.append(200.0, np.full(6, 100.0))
    assert capacity_margin(doubled, 0.0, 100.0, box, LENGTH) == pytest.approx(
        float(capacity_margin(matrix, 0.0, high, box, LENGTH))
    )


def test_unusable_arguments_are_refused():
    matrix, box = paper_matrix(), WrenchBox.of_one(PAPER_WEIGHT)
    with pytest.raises(BadInput, match="t_min is above t_max"):
        capacity_margin(matrix, 5.0, 1.0, box, 0.1)
    with pytest.raises(BadInput, match="7 values for 8 cables"):
        capacity_margin(matrix, np.ones(7), 100.0, box, 0.1)
    with pytest.raises(BadInput, match="half-width"):
        WrenchBox(PAPER_WEIGHT, -np.ones(6))
    with pytest.raises(BadInput, match=r"not \(\.\.\., 6\)"):
        WrenchBox(np.ones(3), np.ones(6))
    with pytest.raises(BadInput, match="finite"):
        WrenchBox(np.full(6, np.nan), np.ones(6))
    with pytest.raises(BadInput, match="for poses of shape"):
        capacity_margin(np.array([matrix] * 3), 1.0, 100.0, WrenchBox.of_one(np.ones((2, 6))), 0.1)


def test_a_box_cannot_be_changed():
    box = WrenchBox.of_one(PAPER_WEIGHT)
    for array in (box.centre, box.half_widths):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_margins_of_many_poses_and_cables_take_little_memory():
    """14 cables have 2002 facets: 100 poses at once took 230 MB."""
    matrices = np.random.default_rng(0).normal(size=(100, 6, 14))
    tracemalloc.start()
    try:
        together = capacity_margin(matrices, 1.0, 100.0, WrenchBox.of_one(np.zeros(6)), LENGTH)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 60e6
    single = capacity_margin(matrices[7], 1.0, 100.0, WrenchBox.of_one(np.zeros(6)), LENGTH)
    assert together[7] == pytest.approx(float(single), rel=1e-9)
