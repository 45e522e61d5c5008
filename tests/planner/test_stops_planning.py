"""Plans through stops: every leg meets its ends exactly and is held with its own load."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from model.distances import convex_bodies, separation
from model.errors import BadInput, NoSolution
from model.files.plan_file import PlanDocument
from model.files.scene_file import Payload, StopDocument
from model.plan import load_plan, plan_from_document, save_plan
from model.pose import Pose, interpolate
from model.rig import Rig
from model.scene import Load, Scene, legs_of
from model.shapes import Sphere
from model.statics.gravity import working_tensions
from planner.check import check_path, verify
from planner.planning import make_plan
from planner.settings import OptimalSettings, PlannerSettings

OPTIMAL = OptimalSettings(rounds=20)
SETTINGS = [OPTIMAL, PlannerSettings(mode="paper"), PlannerSettings(cost="length")]
WALL = {
    "name": "wall",
    "box": {"size_mm": [40.0, 300.0, 250.0]},
    "position_mm": [0.0, 0.0, 125.0],
}


def stop(name: str, x: float, y: float, z: float, **keys: object) -> dict[str, object]:
    return {"name": name, "position_mm": [x, y, z], **keys}


def pick(name: str, at: tuple[float, float, float], kg: float, **keys: object) -> dict[str, object]:
    return stop(name, *at, kind="pick", dwell_s=1.0, mass_kg=kg, **keys)


@pytest.fixture(scope="module")
def planned(gachon: Rig, ready_scene: Callable[[str], Scene]) -> PlanDocument:
    """A plan through the stops of the example scene."""
    return make_plan(gachon, ready_scene("pick_and_place"), OPTIMAL)


@pytest.mark.parametrize("settings", SETTINGS, ids=["optimal", "paper", "rewire"])
def test_a_plan_meets_every_stop_exactly_and_passes_its_check(
    gachon, ready_scene, settings, tmp_path
) -> None:
    scene = ready_scene("pick_and_place")
    if settings is not OPTIMAL:  # the paper's planners take long for each leg
        scene = scene.changed(stops=scene.document.stops[:2])
    save_plan(make_plan(gachon, scene, settings), tmp_path / "plan.json")
    plan = load_plan(tmp_path / "plan.json")
    assert verify(plan).report.passed
    assert [mark.name for mark in plan.document.stops] == [s.name for s in scene.stops]
    for index, at in zip(plan.stops, scene.stops, strict=True):
        assert plan.waypoints[index].distance_to(at.pose) < 1e-9
    assert plan.waypoints[0].distance_to(scene.start) < 1e-9
    assert plan.waypoints[-1].distance_to(scene.goal) < 1e-9
    tree = plan.document.tree
    assert tree.parents.count(-1) == len(scene.stops) + 1, "a root for each leg"
    nodes = np.array([*tree.positions_mm, [np.nan] * 3])
    for index in (*plan.stops, len(plan.waypoints) - 1):
        ends = plan.waypoints[index].position * 1000.0
        assert np.nanmin(np.linalg.norm(nodes - ends, axis=1)) < 0.002


def test_figures_of_a_plan_are_those_of_its_legs_with_their_loads(gachon, planned) -> None:
    """Tensions by the working rule at dense poses, with masses written out here."""
    plan = plan_from_document(planned)
    bounds = [0, *plan.stops, len(plan.waypoints) - 1]
    lows, highs, length = [], [], 0.0
    masses = [0.0, 1.2, 1.2, 0.0, 0.5, 0.5, 0.0]
    for (first, last), mass in zip(pairwise(bounds), masses, strict=True):
        hanging = Load(mass, np.array([0.0, 0.0, -0.08]), np.zeros(3), np.zeros(3))
        for a, b in pairwise(plan.waypoints[first : last + 1]):
            length += a.distance_to(b)
            for share in np.linspace(0.0, 1.0, 40):
                tensions = working_tensions(gachon, interpolate(a, b, share), hanging).tensions
                lows.append(tensions.min())
                highs.append(tensions.max())
    assert planned.quality.length_mm == pytest.approx(length * 1000.0, rel=1e-6)
    assert planned.quality.min_tension_n == pytest.approx(min(lows), abs=0.1)
    assert planned.quality.max_tension_n == pytest.approx(max(highs), abs=0.1)


def test_the_parts_of_the_ready_scene_are_carried_over_the_wall(gachon, ready_scene) -> None:
    """Only box and cables are kept away, so its stops must be high enough for the parts."""
    scene = ready_scene("pick_and_place")
    plan = plan_from_document(make_plan(gachon, scene, OPTIMAL))
    [wall] = convex_bodies(scene.obstacles[0].shape, scene.obstacles[0].pose)
    bounds = [0, *plan.stops, len(plan.waypoints) - 1]
    for leg, (first, last) in zip(legs_of(scene), pairwise(bounds), strict=True):
        if leg.scene.load.payload_mass == 0.0:
            continue
        for a, b in pairwise(plan.waypoints[first : last + 1]):
            for share in np.linspace(0.0, 1.0, 40):
                at = interpolate(a, b, share).apply(leg.scene.load.payload_centre)
                [part] = convex_bodies(Sphere(0.02), Pose.level(at))
                assert separation(part, wall).distance >= scene.obstacle_clearance


def test_the_same_rounds_of_each_leg_give_the_same_path_again(gachon, ready_scene) -> None:
    scene = ready_scene("pick_and_place")
    first = make_plan(gachon, scene, OptimalSettings(budget=0.01))
    rounds = first.planner.rounds
    assert len(rounds) == len(scene.stops) + 1
    again = make_plan(gachon, scene, OptimalSettings(), rounds=rounds)
    assert again.waypoints == first.waypoints
    assert again.planner.rounds == rounds


def test_a_leg_is_the_plan_that_its_ends_alone_would_have(gachon, ready_scene, planned) -> None:
    scene, whole = ready_scene("pick_and_place"), plan_from_document(planned)
    tray, over, shelf = whole.stops[:3]
    for first, last in ((tray, over), (over, shelf)):
        ends = {"start": whole.waypoints[first], "goal": whole.waypoints[last]}
        alone = scene.changed(**ends, stops=[], payload=Payload(1.2, (0.0, 0.0, -80.0)))
        path = plan_from_document(make_plan(gachon, alone, OPTIMAL)).waypoints
        part = whole.waypoints[first : last + 1]
        assert [tuple(p.position) for p in part] == [tuple(p.position) for p in path]


def test_a_leg_that_only_its_own_load_makes_impossible_fails_the_check(gachon, scene_with) -> None:
    """12 kg are held at home and at the goal, but not at [200, 200, 600] mm in between."""
    ends = {"start": {"position_mm": [0, 0, 300]}, "goal": {"position_mm": [200, 200, 300]}}
    high = Pose.level(np.array([0.2, 0.2, 0.6]))
    loaded = scene_with(**ends, stops=[pick("heavy", (0, 0, 445), 12.0)])
    empty = scene_with(**ends, stops=[stop("heavy", 0, 0, 445)])
    poses = [loaded.start, loaded.stops[0].pose, high, loaded.goal]
    assert check_path(gachon, empty, poses, [1]).passed
    report = check_path(gachon, loaded, poses, [1])
    assert not report.passed
    assert "cannot hold" in report.violations[0].what
    late = scene_with(**ends, stops=[stop("high", 200, 200, 600), pick("heavy", (0, 0, 445), 12.0)])
    before = [late.start, high, late.stops[1].pose, late.goal]
    assert check_path(gachon, late, before, [1, 2]).passed, "the mass is picked after it"


def test_a_load_picked_in_between_is_planned_for(gachon, scene_with) -> None:
    scene = scene_with(
        start={"position_mm": [0, 0, 300]},
        goal={"position_mm": [200, 200, 300]},
        stops=[pick("heavy", (0, 0, 445), 12.0)],
    )
    document = make_plan(gachon, scene, OPTIMAL)
    assert verify(plan_from_document(document)).report.proved_capacity_margin >= 0.0


@pytest.mark.parametrize(
    ("stops", "words"),
    [
        ([stop("out", 0, 0, 700)], ["stop 'out' is 50.0 mm outside the workspace"]),
        ([stop("in the wall", 0, 0, 150)], ["stop 'in the wall'", "touches wall"]),
        ([pick("heavy", (200, 200, 600), 12.0)], ["stop 'heavy' the cables cannot hold"]),
        (
            [pick("heavy", (0, 0, 445), 12.0), stop("high", 200, 200, 600)],
            ["stop 'high' the cables cannot hold"],
        ),
        (
            [stop("rotated", 0, 0, 445, rotation_wxyz=[0.0, 0.0, 0.0, 1.0])],
            ["start and stop 'rotated' differ in orientation by 180 deg"],
        ),
    ],
)
def test_a_stop_that_cannot_be_used_is_named(gachon, scene_with, stops, words) -> None:
    ends = {"start": {"position_mm": [0, 0, 400]}, "goal": {"position_mm": [0, 0, 400]}}
    with pytest.raises(BadInput) as refusal:
        make_plan(gachon, scene_with(WALL, **ends, stops=stops), OPTIMAL)
    assert all(word in str(refusal.value) for word in words)


def test_no_path_names_the_leg(gachon, ready_scene) -> None:
    scene = ready_scene("environment_3")
    near = StopDocument(name="near", position_mm=scene.document.start.position_mm)
    through = scene.changed(stops=[near])
    settings = PlannerSettings(max_iterations=40)
    with pytest.raises(NoSolution, match="from stop 'near' to goal: no path after 40 iterations"):
        make_plan(gachon, through, settings)


@pytest.mark.parametrize(
    ("stops", "why"), [([], "stops at poses []"), ([2, 1], "[2, 1]"), ([1, 9], "between 0 and 3")]
)
def test_invalid_stops_of_a_path_are_refused(gachon, scene_with, stops, why) -> None:
    scene = scene_with(stops=[stop("a", 0, 0, 445), stop("b", 0, 0, 445)])
    with pytest.raises(BadInput) as refusal:
        check_path(gachon, scene, [gachon.home] * 4, stops)
    assert why in refusal.value.what


def test_a_path_past_its_stop_fails_the_check(gachon, scene_with) -> None:
    scene = scene_with(stops=[stop("a", 0, 0, 450)])
    poses = [gachon.home, Pose.level(np.array([0.0, 0.0, 0.451])), gachon.home]
    report = check_path(gachon, scene, poses, [1])
    assert {v.what for v in report.violations} == {"the path does not meet the scene's stop 'a'"}


def test_a_longest_path_and_wrong_rounds_are_refused_with_stops(gachon, scene_with) -> None:
    scene = scene_with(stops=[stop("a", 0, 0, 450)])
    with pytest.raises(BadInput, match="limit on its length"):
        make_plan(gachon, scene, OptimalSettings(longest=1.0))
    with pytest.raises(BadInput, match=r"rounds are given for 3 legs; the scene has 2"):
        make_plan(gachon, scene, OptimalSettings(), rounds=[1, 1, 1])
    with pytest.raises(BadInput, match="have no rounds"):
        make_plan(gachon, scene, PlannerSettings(), rounds=[1, 1])


def test_a_report_of_legs_can_be_written_as_json(planned) -> None:
    plan = plan_from_document(planned)
    report = verify(plan).report
    assert json.dumps(report.as_dict(), allow_nan=False)
    motion = sum(a.distance_to(b) for a, b in pairwise(plan.waypoints))
    assert 0.0 <= report.obstacle_clearance.at <= motion
    assert report.length == pytest.approx(motion)
