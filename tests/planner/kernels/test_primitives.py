"""Compiled distances against their plain definitions and against coal."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from planner.kernels.gjk import hulls_apart, hulls_distance
from planner.kernels.primitives import (
    segment_box_squared,
    triangle_box_apart,
    triangle_box_squared,
    triangle_point_squared,
    triangle_segment_squared,
)
from tests.planner.collision.sampled_oracle import triangle
from tests.planner.kernels.definitions import (
    hulls_definition,
    segment_box_definition,
    triangle_box_definition,
    triangle_point_definition,
    triangle_segment_definition,
)

EXACT = 1e-12
"""Of the largest coordinate: round-off of the definitions themselves."""

# Rounded to a coarse grid half of the time: parallel edges, shared points, flat triangles.
smooth = st.floats(-1.0, 1.0)
coarse = st.integers(-4, 4).map(lambda k: k / 4.0)
scales = st.sampled_from([1e-3, 1.0, 1e3])


def points(count: int) -> st.SearchStrategy[np.ndarray]:
    return st.one_of(arrays(float, (count, 3), elements=e) for e in (smooth, coarse))


def halves() -> st.SearchStrategy[np.ndarray]:
    return arrays(float, (3,), elements=st.sampled_from([0.125, 0.25, 0.3, 0.5, 0.01]))


def vector(array: np.ndarray) -> tuple[float, float, float]:
    x, y, z = array.tolist()
    return x, y, z


def corners_of(half: np.ndarray) -> np.ndarray:
    return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * half


@given(points(2), halves(), scales)
def test_segment_to_box_is_the_least_over_all_regions(ends, half, scale) -> None:
    ends, half = ends * scale, half * scale
    found = segment_box_squared(vector(ends[0]), vector(ends[1]), vector(half)) ** 0.5
    assert found == pytest.approx(segment_box_definition(*ends, half), rel=0, abs=EXACT * scale)


@given(points(3), halves(), scales)
def test_triangle_to_box_is_the_least_over_all_features(corners, half, scale) -> None:
    corners, half = corners * scale, half * scale
    found = triangle_box_squared(*map(vector, corners), vector(half)) ** 0.5
    expected = triangle_box_definition(corners, half)
    assert found == pytest.approx(expected, rel=0, abs=EXACT * scale)


@given(points(3), halves(), st.floats(-12.0, -3.0), st.booleans())
def test_grazing_triangles_are_separated_to_round_off(corners, half, exponent, nearer) -> None:
    distance = triangle_box_definition(corners, half)
    shift = 10.0**exponent
    needed = distance + shift if nearer else distance - shift
    if needed > 0.0:
        apart = triangle_box_apart(*map(vector, corners), vector(half), needed)
        assert apart is not nearer


@given(points(4), scales)
def test_triangle_to_point_is_the_least_over_face_edges_and_corners(given_points, scale) -> None:
    corners, point = given_points[:3] * scale, given_points[3] * scale
    found = triangle_point_squared(*map(vector, corners), vector(point)) ** 0.5
    expected = triangle_point_definition(corners, point)
    assert found == pytest.approx(expected, rel=0, abs=1e-9 * scale)


@settings(max_examples=40)
@given(points(5))
def test_triangle_to_segment_is_the_least_over_the_segment(given_points) -> None:
    corners, ends = given_points[:3], given_points[3:]
    found = triangle_segment_squared(*map(vector, [*corners, *ends])) ** 0.5
    # Near a crossing the definition's search ends a little beside the crossing itself.
    assert found == pytest.approx(triangle_segment_definition(corners, *ends), rel=0, abs=1e-7)


@given(points(3), halves())
def test_hulls_agree_with_the_closed_form_and_prove_it_by_a_plane(corners, half) -> None:
    low, high = hulls_distance(corners, corners_of(half), (0.0, 0.0, 1.0), 0.0, np.inf)
    expected = triangle_box_squared(*map(vector, corners), vector(half)) ** 0.5
    assert low <= expected + EXACT
    assert low == pytest.approx(expected, rel=0, abs=1e-9)
    assert high == pytest.approx(expected, rel=0, abs=1e-9)


@given(points(4), points(6))
def test_hulls_of_points_agree_with_a_quadratic_program(first, second) -> None:
    low, _ = hulls_distance(first, second + 0.5, (0.0, 0.0, 1.0), 0.0, np.inf)
    assert low == pytest.approx(hulls_definition(first, second + 0.5), rel=0, abs=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_hull_grown_by_a_disc_is_a_cylinder(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners, radius, length = rng.uniform(-1, 1, (3, 3)), *rng.uniform(0.05, 0.4, 2)
    axis_ends = np.array([[0.0, 0.0, -length / 2], [0.0, 0.0, length / 2]])
    low, high = hulls_distance(corners, axis_ends, (0.0, 0.0, 1.0), float(radius), np.inf)
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.gjk_max_iterations = 1e-9, 1000
    nowhere = coal.Transform3s.Identity()
    cylinder = coal.Cylinder(float(radius), float(length))
    expected = max(
        coal.distance(triangle(corners), nowhere, cylinder, nowhere, request, result), 0.0
    )
    assert low <= high + EXACT
    assert low == pytest.approx(expected, rel=0, abs=1e-7)


@settings(max_examples=400)
@given(st.integers(0, 2**32 - 1), st.one_of(st.just(0.0), st.floats(-18.0, -2.0)))
def test_hull_face_to_face_with_a_tilted_disc_is_as_far_as_the_planes(seed, exponent) -> None:
    rng = np.random.default_rng(seed)
    frame = Rotation.random(random_state=rng).as_matrix()
    tilt = 10.0**exponent if exponent else 0.0
    axis, radius, length, gap = frame[:, 2], *rng.uniform(0.05, 0.4, 3)
    middle = rng.uniform(-2, 2, 3)
    axis_ends = middle + np.outer([-0.5, 0.5], length * axis)
    angles = np.linspace(0.0, 2.0 * np.pi, int(rng.integers(3, 7)), endpoint=False)
    outline = np.column_stack([np.cos(angles), np.sin(angles), tilt * np.cos(angles)])
    face = axis_ends[1] + (outline + np.array([0.0, 0.0, gap + tilt])) @ frame.T
    low, high = hulls_distance(face, axis_ends, vector(axis), float(radius), np.inf)
    normal = np.array([-tilt, 0.0, 1.0]) / np.hypot(1.0, tilt)
    expected = (gap + tilt) * normal[2] - radius * abs(normal[0])
    assert expected - 1e-6 <= low <= expected + 10.0 * EXACT
    assert expected - 10.0 * EXACT <= high <= expected + 1e-6


def test_hulls_at_least_as_far_as_needed_are_apart_and_nearer_ones_are_not() -> None:
    first = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    second = np.array([[0.5, -1.0, 0.25], [0.5, 1.0, 0.25]])
    assert hulls_apart(first, second, (0.0, 0.0, 1.0), 0.0, 0.25)
    assert not hulls_apart(first, second, (0.0, 0.0, 1.0), 0.0, 0.25 + 1e-12)


def test_an_anchor_line_through_the_outlet_is_a_triangle_without_area() -> None:
    half = (0.1, 0.1, 0.1)
    outlet, near, far = (1.0, 0.0, 0.25), (0.5, 0.0, 0.25), (0.0, 0.0, 0.25)
    assert triangle_box_squared(outlet, near, far, half) ** 0.5 == pytest.approx(0.15)
    assert triangle_box_squared(outlet, far, far, half) ** 0.5 == pytest.approx(0.15)
    assert triangle_box_squared(outlet, outlet, outlet, half) > 0.0
