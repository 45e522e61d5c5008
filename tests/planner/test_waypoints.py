"""Paths of other planners become plans only by the check that ours pass."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from model.errors import BadInput, Refused
from model.plan import load_plan
from model.pose import Pose
from model.rig import load_rig
from model.scene import load_scene
from planner.check import check_path, verify
from planner.check_report import PlanRejected
from planner.planning import plan_from_waypoints

CONFIGS = Path(__file__).parents[2] / "configs"
RIG = load_rig(CONFIGS / "gachon_8_6.yaml")
BLOCKED = load_scene(CONFIGS / "environment_1.yaml")
FREE = BLOCKED.changed(goal=Pose.level(np.add(BLOCKED.start.position, (0.0, 0.0, 0.02))))


def test_a_straight_path_in_free_space_becomes_a_plan_that_its_file_keeps(tmp_path: Path) -> None:
    plan = plan_from_waypoints(RIG, FREE, [FREE.start, FREE.goal], author="straight line")
    again = load_plan(plan.save(tmp_path / "plan.json"))
    assert again.document.hash == plan.document.hash
    assert again.document.planner.name == "waypoints"
    assert verify(again, RIG).report.length == pytest.approx(0.02)


def test_a_path_through_an_obstacle_is_rejected_with_every_violation() -> None:
    ends = [BLOCKED.start, BLOCKED.goal]
    with pytest.raises(PlanRejected) as rejected:
        plan_from_waypoints(RIG, BLOCKED, ends)
    expected = check_path(RIG, BLOCKED, ends).violations
    assert [v.what for v in rejected.value.violations] == [v.what for v in expected]
    assert isinstance(rejected.value, Refused)
    assert all(v.sentence() in str(rejected.value) for v in rejected.value.violations)
    copy = pickle.loads(pickle.dumps(rejected.value))
    assert len(copy.violations) == len(expected)


def test_a_path_that_misses_the_goal_is_rejected() -> None:
    with pytest.raises(PlanRejected, match="does not meet the scene's goal"):
        plan_from_waypoints(RIG, BLOCKED, [BLOCKED.start, BLOCKED.start])


def test_one_waypoint_is_refused() -> None:
    with pytest.raises(BadInput, match="two waypoints"):
        plan_from_waypoints(RIG, FREE, [FREE.start])
