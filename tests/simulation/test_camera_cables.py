"""Cables in the synthetic camera's image end where they are hidden, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.kinematics import Cables
from model.pose import Pose
from simulation.camera.cables import HIDDEN, NEAR, draw_cables
from simulation.camera.rendering import Image8, pixels_of
from tests.tracking.tag_images import small_camera

HERE = Pose.level(np.zeros(3))
RADIUS, WALL = 0.5e-3, 0.4
CAMERA = small_camera()

near_the_lens = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.1, 0.25))
farther_away = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.3, 1.0))


def drawn(start: tuple[float, ...], end: tuple[float, ...], wall: bool) -> Image8:
    """A white image with one cable, and a wall behind which nothing shows on its right half."""
    span = np.array(end) - start
    length = float(np.linalg.norm(span))
    cable = Cables(np.array([start]), np.array([end]), -span[None] / length, np.array([length]))
    picture = np.full((240, 320), 220, np.uint8)
    depth = np.full((240, 320), np.inf, np.float32)
    if wall:
        depth[:, 160:] = WALL
    draw_cables(picture, depth, CAMERA, cable, HERE, RADIUS)
    return picture


@given(start=near_the_lens, end=farther_away, wall=st.booleans())
@settings(max_examples=60, deadline=None)
def test_all_of_a_cable_that_can_be_seen_is_drawn_and_nothing_else(
    start: tuple[float, ...], end: tuple[float, ...], wall: bool
) -> None:
    """Against projected points, 60 times as many as are drawn."""
    dark = (drawn(start, end, wall) < 150).astype(np.uint8)
    share = np.linspace(0.0, 1.0, 6000)[:, None]
    points = np.array(start) + share * (np.array(end) - start)
    points = points[points[:, 2] > NEAR + 1e-3]
    pixels = pixels_of(CAMERA, points)
    inside = np.all((pixels > 1.0) & (pixels < [318.0, 238.0]), axis=1)
    points, pixels = points[inside], pixels[inside]
    apart = np.abs(pixels[:, 0] - 159.5) > 2.0  # and not on the edge of the wall
    hidden = wall & (pixels[:, 0] > 160.0) & (points[:, 2] > WALL + HIDDEN)
    clear = apart & (~hidden | (points[:, 2] < WALL))
    columns, rows = np.round(pixels[clear]).astype(int).T
    assert np.all(cv2.dilate(dark, np.ones((3, 3)))[rows, columns])
    allowed = np.ones((240, 320), np.uint8)
    for (column, row), z in zip(pixels[~hidden], points[~hidden, 2], strict=True):
        reach = round(RADIUS * 400.0 / z) + 3
        allowed[
            max(0, round(row) - reach) : round(row) + reach + 1,
            max(0, round(column) - reach) : round(column) + reach + 1,
        ] = 0
    edge = np.zeros_like(dark)
    edge[4:-4, 4:-4] = 1  # where a thick cable passes just outside, its rim shows
    assert not np.any(dark & allowed & edge)


def test_a_cable_that_leaves_the_picture_near_the_lens_reaches_its_edge() -> None:
    picture = drawn((-0.12, 0.0, 0.06), (0.1, 0.02, 0.9), wall=False)
    columns = np.flatnonzero((picture < 150).any(axis=0))
    assert columns[0] == 0
    assert np.all(np.diff(columns) == 1)


def test_a_cable_behind_the_camera_is_not_drawn() -> None:
    assert np.all(drawn((-0.1, 0.0, -0.4), (0.1, 0.1, 0.01), wall=False) == 220)


@pytest.mark.parametrize("end", [(0.1, 0.05, 0.2), (0.1, 0.05, 0.2 + 1e-9)])
def test_a_cable_across_the_view_is_drawn(end: tuple[float, float, float]) -> None:
    """Both ends equally far away."""
    assert np.any(drawn((-0.1, 0.0, 0.2), end, wall=False) < 150)
