"""The clipping of small polygons, and their nearest points."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.statics.tension_distribution import (
    clipped,
    nearest_on_boundary,
    square,
)

seeds = st.integers(0, 2**32 - 1)
SIDES = [(1.0, 0.0, 10.0), (-1.0, 0.0, 10.0), (0.0, 1.0, 10.0), (0.0, -1.0, 10.0)]


def random_half_planes(seed):
    random = np.random.default_rng(seed)
    return [(*random.normal(size=2), random.uniform(-0.5, 4.0)) for _ in range(8)]


def corners_by_enumeration(half_planes):
    """Return every crossing of two lines that no half-plane cuts away."""
    lines = np.array(half_planes)
    found = []
    for first, second in combinations(lines, 2):
        if abs(np.linalg.det([first[:2], second[:2]])) > 1e-9:
            point = np.linalg.solve([first[:2], second[:2]], [-first[2], -second[2]])
            if (lines[:, :2] @ point + lines[:, 2] >= -1e-9).all():
                found.append(point)
    return np.array(found).reshape(-1, 2)


@given(seed=seeds)
def test_clipping_keeps_exactly_the_crossings_that_no_half_plane_cuts_away(seed):
    half_planes = random_half_planes(seed)
    polygon = np.array(clipped(square(10.0), half_planes)).reshape(-1, 2)
    expected = corners_by_enumeration([*SIDES, *half_planes])
    assert (len(polygon) == 0) == (len(expected) == 0)
    for one, other in ((polygon, expected), (expected, polygon)):
        for point in one:
            assert np.linalg.norm(other - point, axis=1).min() < 1e-6


@given(seed=seeds, x=st.floats(-20.0, 20.0), y=st.floats(-20.0, 20.0))
def test_nearest_point_is_on_an_edge_and_no_point_of_the_edges_is_nearer(seed, x, y):
    polygon = clipped(square(10.0), random_half_planes(seed))
    if not polygon:
        return
    distance = np.hypot(*np.subtract(nearest_on_boundary(polygon, (x, y)), (x, y)))
    corners = np.array(polygon)
    parts = np.linspace(0.0, 1.0, 200)[:, np.newaxis, np.newaxis]
    samples = (corners + parts * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 2)
    smallest = np.linalg.norm(samples - (x, y), axis=1).min()
    assert smallest - 0.2 <= distance <= smallest + 1e-9


def test_half_planes_that_exclude_each_other_leave_nothing():
    assert clipped(square(1.0), [(1.0, 0.0, -0.5), (-1.0, 0.0, 0.4)]) == []


def test_half_planes_that_touch_leave_a_segment():
    segment = clipped(square(1.0), [(1.0, 0.0, -0.5), (-1.0, 0.0, 0.5)])
    assert nearest_on_boundary(segment, (3.0, 0.25)) == pytest.approx((0.5, 0.25))


def test_half_planes_that_touch_in_a_corner_leave_a_point():
    point = clipped(square(1.0), [(1.0, 0.0, -1.0), (0.0, -1.0, -1.0)])
    assert nearest_on_boundary(point, (9.0, 9.0)) == (1.0, -1.0)


def test_a_half_plane_without_direction_keeps_all_or_nothing():
    whole = square(1.0)
    assert clipped(whole, [(0.0, 0.0, 1.0)]) == whole
    assert clipped(whole, [(0.0, 0.0, -1.0)]) == []
