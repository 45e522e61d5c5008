"""Paths of other planners become plans only by the check that ours pass."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model.errors import BadInput, Refused
from model.files.documents import PoseDocument
from model.files.scene_file import StopDocument
from model.plan import load_plan
from model.pose import Pose
from model.rig import Rig, load_rig
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


@pytest.mark.parametrize("scale", [10.0, 1000.0, 1e8])
def test_a_path_far_outside_is_rejected_for_that_alone(scale: float) -> None:
    """As of a waypoint in mm: sampling every 5 mm took hours and all memory."""
    far = Pose.level(scale * np.array([-0.115, -0.185, 0.5]))
    with pytest.raises(PlanRejected, match="so far that nothing else was checked") as rejected:
        plan_from_waypoints(RIG, BLOCKED, [BLOCKED.start, far, BLOCKED.goal])
    (violation,) = rejected.value.violations
    assert violation.measured > 0.5
    report = rejected.value.report
    assert report.samples == 0
    assert report.facts()
    assert report._repr_html_()
    json.dumps(report.as_dict(), allow_nan=False)


def test_a_path_a_bit_outside_gets_the_whole_report() -> None:
    above = Pose.level([*BLOCKED.start.position[:2], RIG.workspace_upper[2] + 0.05])
    with pytest.raises(PlanRejected, match="leaves the workspace box") as rejected:
        plan_from_waypoints(RIG, BLOCKED, [BLOCKED.start, above, BLOCKED.start])
    report = rejected.value.report
    assert report.samples > 10
    assert len(report.facts()) > 4
    assert len(rejected.value.violations) > 1


@pytest.mark.parametrize("make", [iter, list, lambda poses: np.array(poses, dtype=object)])
def test_waypoints_come_from_any_iterable(make: Callable[[list[Pose]], Any]) -> None:
    plan = plan_from_waypoints(RIG, FREE, make([FREE.start, FREE.goal]))
    assert len(plan.waypoints) == 2


@pytest.mark.parametrize(
    "arguments",
    [
        {"author": 3},
        {"author": None},
        {"stops": 1},
        {"stops": None},
        {"waypoints": None},
        {"waypoints": "path"},
        {"waypoints": 3},
        {"waypoints": np.zeros((3, 3))},
    ],
)
def test_other_things_than_poses_stops_and_text_are_refused(arguments: dict[str, Any]) -> None:
    with pytest.raises(BadInput):
        plan_from_waypoints(RIG, FREE, **{"waypoints": [FREE.start, FREE.goal], **arguments})


def test_one_waypoint_is_refused() -> None:
    with pytest.raises(BadInput, match="two waypoints"):
        plan_from_waypoints(RIG, FREE, [FREE.start])


def test_a_plan_too_fast_for_the_winches_is_refused_with_the_speeds_to_change() -> None:
    plan = plan_from_waypoints(RIG, FREE, [FREE.start, FREE.goal])
    document = RIG.as_dict()
    document["motion"] = {**document.get("motion", {}), "speed_mm_s": 5000.0}
    with pytest.raises(PlanRejected) as rejected:
        verify(plan, Rig.from_dict(document))
    assert {v.unit for v in rejected.value.violations} == {"mm/s"}
    assert "reduce motion.speed_mm_s" in (rejected.value.next_step or "")
    assert "cdpr plan" not in (rejected.value.next_step or "")


def test_the_report_of_a_path_with_one_leg_far_outside_has_finite_numbers_alone() -> None:
    by = Pose.level(np.add(FREE.start.position, (0.0, 0.0, 0.01)))
    scene = FREE.changed(stops=[StopDocument(name="by", **PoseDocument.of(by).model_dump())])
    far = Pose.level(np.array([0.0, 0.0, 1000.0]))
    report = check_path(RIG, scene, [FREE.start, by, far], [1])
    assert report.obstacle_clearance is not None
    facts = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert facts["exactness_mm"] is None
