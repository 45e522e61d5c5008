"""Grids: both ends are in, points are numbered as arrays are, wrong arguments are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import BadInput
from planner.workspace.grid import frame_box, parsed_slice, slice_through, volume

LOWER, UPPER = np.array([-0.25, -0.2, 0.15]), np.array([0.25, 0.2, 0.65])


@given(step=st.floats(0.01, 2.0))
def test_a_volume_holds_both_ends_and_no_gap_wider_than_the_step(step):
    grid = volume("box", LOWER, UPPER, step)
    for axis, low, high in zip(grid.axes, LOWER, UPPER, strict=True):
        assert axis[0] == low
        assert axis[-1] == high
        assert np.diff(axis).max() <= step * (1.0 + 1e-6)


def test_a_step_that_divides_the_sides_is_kept():
    assert volume("box", LOWER, UPPER, 0.01).shape == (51, 41, 51)


def test_points_come_in_the_order_of_an_array():
    grid = volume("box", LOWER, UPPER, 0.1)
    points = np.concatenate([grid.points(0, 7), grid.points(7, grid.count)])
    expected = np.stack(np.meshgrid(*grid.axes, indexing="ij"), axis=-1)
    assert np.array_equal(points.reshape(*grid.shape, 3), expected)


def test_a_slice_has_one_layer_at_its_value():
    grid = slice_through(2, 0.445, LOWER, UPPER, 0.02)
    assert grid.name == "slice_z_445"
    assert grid.shape == (26, 21, 1)
    assert grid.axes[2][0] == 0.445


def test_a_slice_below_zero_has_a_name_that_any_file_system_takes():
    assert slice_through(0, -0.1, LOWER, UPPER, 0.1).name == "slice_x_minus_100"


@pytest.mark.parametrize(
    ("text", "expected"), [("z=445", (2, 0.445)), (" x = -10.5", (0, -0.0105))]
)
def test_a_slice_is_read_in_millimetres(text, expected):
    axis, value = parsed_slice(text)
    assert (axis, value) == (expected[0], pytest.approx(expected[1]))


@pytest.mark.parametrize("text", ["445", "w=3", "z=", "z=high", "z=nan", "=3", "xy=3"])
def test_what_is_not_a_slice_is_refused(text):
    with pytest.raises(BadInput, match="not a slice"):
        parsed_slice(text)


def test_a_slice_beside_the_region_names_the_region():
    with pytest.raises(BadInput, match="z from 150 to 650 mm") as refused:
        slice_through(2, 0.7, LOWER, UPPER, 0.01)
    assert "150 and 650 mm, in Python in metres" in (refused.value.next_step or "")


@pytest.mark.parametrize("step", [0.0, -0.01, np.nan, np.inf, 1e-4, 1e-300])
def test_a_step_too_small_to_finish_is_refused(step):
    with pytest.raises(BadInput):
        volume("box", LOWER, UPPER, step)


def test_a_region_without_extent_is_refused():
    with pytest.raises(BadInput, match="no extent"):
        volume("box", UPPER, LOWER, 0.01)


def test_the_frame_holds_outlets_and_workspace(gachon):
    lower, upper = frame_box(gachon)
    for points in (gachon.outlets, gachon.workspace_lower, gachon.workspace_upper):
        assert (points >= lower).all()
        assert (points <= upper).all()
