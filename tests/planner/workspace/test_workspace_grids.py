"""Grids that are mapped by default, in a script or by `cdpr workspace`."""

from __future__ import annotations

import numpy as np
import pytest

from model.rig import load_rig
from planner.workspace.compute import workspace_grids
from tests.cli.plans import RIG


def test_nothing_asked_gives_a_slice_through_home_and_both_volumes() -> None:
    rig = load_rig(RIG)
    grids = workspace_grids(rig)
    assert [grid.name for grid in grids][1:] == ["frame", "workspace"]
    level = grids[0].points(0, grids[0].count)
    assert level[:, 2] == pytest.approx(rig.home.position[2])


def test_a_slice_alone_leaves_the_volumes_out_unless_they_are_asked_for() -> None:
    rig = load_rig(RIG)
    assert len(workspace_grids(rig, [(0, 0.0)])) == 1
    assert len(workspace_grids(rig, [(0, 0.0)], volume=True)) == 3


def test_the_region_is_the_rigs_workspace_or_the_given_box() -> None:
    rig = load_rig(RIG)
    lower, upper = rig.workspace_lower, (rig.workspace_lower + rig.workspace_upper) / 2.0
    (half,) = workspace_grids(rig, [(2, float(lower[2]))], lower=lower, upper=upper, step=0.02)
    points = half.points(0, half.count)
    assert np.all(points >= lower - 1e-9)
    assert np.all(points <= upper + 0.02)
