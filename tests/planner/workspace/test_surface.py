"""The surface of a field: closed, outward, and where the field is zero."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from planner.workspace.grid import zero_surface

AXES = tuple(np.linspace(-1.0, 1.0, n) for n in (33, 41, 29))
POINTS = np.stack(np.meshgrid(*AXES, indexing="ij"), axis=-1)


def enclosed_volume(triangles):
    """Volume within a closed surface of triangles, shape (t, 3, 3) (divergence theorem)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.einsum("ki,ki->", a, np.cross(b, c)) / 6.0)


def ball(radius):
    return radius - np.linalg.norm(POINTS, axis=-1)


def test_a_ball_has_its_volume_and_its_radius():
    triangles = zero_surface(AXES, ball(0.8))
    assert enclosed_volume(triangles) == pytest.approx(4.0 / 3.0 * np.pi * 0.8**3, rel=6e-3)
    assert np.linalg.norm(triangles, axis=-1) == pytest.approx(0.8, abs=2e-3)


def test_a_plane_is_met_exactly():
    triangles = zero_surface(AXES, 0.123 - POINTS[..., 0])
    inner = triangles[(np.abs(triangles) < 0.999).all(axis=(1, 2))]
    assert len(inner) > 500
    assert inner[..., 0] == pytest.approx(0.123, abs=1e-12)


@pytest.mark.parametrize("radius", [0.8, 1.2, 1.6])
def test_every_edge_belongs_to_two_triangles_that_run_along_it_in_opposite_directions(radius):
    """Also where the region cuts the body off."""
    triangles = np.round(zero_surface(AXES, ball(radius)), 12)
    edges = Counter()
    for corners in triangles.tolist():
        a, b, c = (tuple(corner) for corner in corners)
        if len({a, b, c}) == 3:
            edges.update([(a, b), (b, c), (c, a)])
    assert all(edges[b, a] == count for (a, b), count in edges.items())


def test_a_field_that_is_positive_everywhere_is_the_whole_region():
    assert enclosed_volume(zero_surface(AXES, np.ones(POINTS.shape[:3]))) == pytest.approx(8.0)


@pytest.mark.parametrize("nothing", [-1.0, 0.0, np.nan, -np.inf])
def test_a_field_that_is_positive_nowhere_has_no_surface(nothing):
    assert len(zero_surface(AXES, np.full(POINTS.shape[:3], nothing))) == 0


def test_unknown_values_are_outside_and_infinite_ones_harmless():
    field = ball(0.8)
    field[POINTS[..., 2] > 0.5] = np.nan
    field[POINTS[..., 2] < -0.5] = -np.inf
    triangles = zero_surface(AXES, field)
    assert np.isfinite(triangles).all()
    assert 0.0 < enclosed_volume(triangles) < 4.0 / 3.0 * np.pi * 0.8**3
