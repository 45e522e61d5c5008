"""The check: what it proves, and everything it must catch."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from model.clearance import ClearanceModel
from model.errors import Refused
from model.kinematics import axis_distances, structure_matrix
from model.plan import plan_from_document, sealed
from model.pose import Pose, interpolate
from model.rig import Rig, rig_from_document
from planner.check import _Check, check_path, verify
from planner.check_report import CheckReport, VerifiedPlan, Violation, joined
from planner.costs import capacity_margins
from planner.path import PosePath
from planner.planning import make_plan
from planner.settings import PlannerSettings


@pytest.fixture(scope="module")
def document(gachon, ready_scene):
    return make_plan(gachon, ready_scene("environment_1"), PlannerSettings(mode="paper"))


def edited(document, **changes):
    fields = {name: getattr(document, name) for name in type(document).model_fields}
    for name in ("hash", "kind", "schema_version"):
        del fields[name]
    return plan_from_document(sealed(fields | changes))


def kinds(report) -> str:
    return "; ".join(violation.what for violation in report.violations)


def test_a_plan_is_verified_with_figures_that_dense_sampling_confirms(gachon, document) -> None:
    plan = plan_from_document(document)
    report = verify(plan).report
    model = ClearanceModel(gachon, plan.scene)
    moves = zip(plan.waypoints[:-1], plan.waypoints[1:], strict=True)
    poses = [interpolate(a, b, t) for a, b in moves for t in np.linspace(0, 1, 60)]
    obstacle = min(model.smallest(p).distance for p in poses)
    own = min(model.self_clearance(p).distance for p in poses)
    assert report.proved_obstacle_clearance <= obstacle + 1e-9
    assert report.proved_self_clearance <= own + 1e-9
    assert report.obstacle_clearance.nearest.distance == pytest.approx(obstacle, abs=1.5e-3)
    assert report.self_clearance.nearest.distance == pytest.approx(own, abs=1e-3)
    assert report.exactness <= 0.1e-3 + 1e-9
    assert gachon.min_tension <= report.min_tension <= report.max_tension <= gachon.max_tension
    assert 0 < report.max_cable_speed <= gachon.motion.speed
    assert report.length == pytest.approx(document.quality.length_mm / 1000, abs=1e-6)


def test_the_straight_line_of_the_paper_collides_in_every_environment(gachon, ready_scene) -> None:
    for number in (1, 2, 3):
        scene = ready_scene(f"environment_{number}")
        report = check_path(gachon, scene, [scene.start, scene.goal])
        assert not report.passed
        assert "obstacle clearance too small" in kinds(report)
        assert report.obstacle_clearance.nearest.distance < 0


def test_an_edited_plan_through_an_obstacle_is_refused(document, ready_scene) -> None:
    ends = [document.waypoints[0], document.waypoints[-1]]
    with pytest.raises(Refused, match="obstacle clearance too small") as refusal:
        verify(edited(document, waypoints=ends))
    assert refusal.value.exit_code == 3


def test_a_needle_thin_obstacle_between_samples_is_found(gachon, scene_with) -> None:
    """A needle a cable sweeps over in passing: dense samples of the ends alone would miss it."""
    start, goal = Pose.level([0, 0, 0.40]), Pose.level([0, 0, 0.4049])
    exits = gachon.outlets[0]
    crossed = (exits + interpolate(start, goal, 0.5).apply(gachon.anchors[0])) / 2
    scene = scene_with(
        {"name": "needle", "sphere": {"radius_mm": 0.2}, "position_mm": (crossed * 1e3).tolist()},
        clearance={"obstacle_mm": 0.5},
        start={"position_mm": [0.0, 0.0, 400.0]},
        goal={"position_mm": [0.0, 0.0, 404.9]},
    )
    report = check_path(gachon, scene, [start, goal])
    assert "obstacle clearance too small, cable 1 – needle" in kinds(report)
    near = ClearanceModel(gachon, scene)
    assert near.smallest(start).distance > 0.0005
    assert near.smallest(goal).distance > 0.0005


def test_clearance_just_below_the_limit_is_refused_and_just_above_is_proved(
    gachon, document
) -> None:
    plan = plan_from_document(document)
    smallest = check_path(gachon, plan.scene, plan.waypoints).proved_obstacle_clearance
    above = plan.scene.changed(clearance=smallest + 0.2e-3)
    below = plan.scene.changed(clearance=smallest - 0.02e-3)
    assert not check_path(gachon, above, plan.waypoints).passed
    assert check_path(gachon, below, plan.waypoints).passed


def test_a_dense_list_of_poses_gives_the_figures_of_its_corners(gachon, document) -> None:
    plan = plan_from_document(document)
    coarse = check_path(gachon, plan.scene, plan.waypoints)
    moves = zip(plan.waypoints[:-1], plan.waypoints[1:], strict=True)
    dense = [interpolate(a, b, t) for a, b in moves for t in np.linspace(0, 1, 400)]
    report = check_path(gachon, plan.scene, dense)
    assert report.passed
    assert report.length == pytest.approx(coarse.length)
    first, second = (r.obstacle_clearance.nearest.distance for r in (coarse, report))
    assert second == pytest.approx(first, abs=0.2e-3)
    assert report.samples < 2000  # not one for each of the poses given


def test_a_spike_among_dense_poses_is_not_overlooked(gachon, scene_with) -> None:
    """One pose of a thousand that is far off still counts."""
    ball = {"name": "ball", "sphere": {"radius_mm": 5}, "position_mm": [110, 25, 445]}
    scene = scene_with(ball, goal={"position_mm": [0.0, 50.0, 445.0]})
    ys = np.linspace(0.0, 0.05, 1000)
    poses = [Pose.level([0.0, y, 0.445]) for y in ys]
    calm = check_path(gachon, scene, poses).obstacle_clearance.nearest.distance
    poses[500] = Pose.level([0.02, ys[500], 0.445])
    spiked = check_path(gachon, scene, poses).obstacle_clearance.nearest.distance
    assert spiked < calm - 0.015


@pytest.mark.parametrize(
    ("path", "what"),
    [
        ([[0, 0, 445], [0, 0, 500], [10, 0, 445]], "does not meet the scene's goal"),
        ([[10, 0, 445], [0, 0, 445]], "does not meet the scene's start"),
        ([[0, 0, 445], [0, 0, 660], [0, 0, 445]], "leaves the workspace box"),
    ],
)
def test_paths_that_leave_the_box_or_miss_their_ends_are_refused(
    gachon, scene_with, path, what
) -> None:
    poses = [Pose.level(np.array(p) / 1000) for p in path]
    assert what in kinds(check_path(gachon, scene_with(), poses))


def test_a_load_that_cannot_be_held_is_a_violation_not_a_crash(gachon, scene_with) -> None:
    heavy = scene_with(load={"payload_kg": 60.0})
    report = check_path(gachon, heavy, [heavy.start, heavy.goal])
    assert "cannot hold" in kinds(report)
    assert "no tensions within the limits" in kinds(report)
    assert math.isnan(report.min_tension)
    assert report.as_dict()["min_tension_n"] is None


@pytest.mark.parametrize(
    ("smallest", "what", "is_proved"),
    [
        (-0.5, "cannot hold every required load", False),
        (0.01, "cannot accelerate the platform", False),
        (0.08 + 1e-5, "not proved between samples", True),  # 2 * 0.4 kg * 100 mm/s2
    ],
)
def test_a_margin_violation_states_the_margin_at_its_position(
    gachon, scene_with, smallest, what, is_proved
) -> None:
    def scene(force: float):
        return scene_with(load={"force_n": [force] * 3}, goal={"position_mm": [60.0, 40.0, 480.0]})

    def margin(force: float, positions) -> float:
        return capacity_margins(gachon, scene(force), np.array(positions), np.eye(3)).min()

    ends = scene(0.0)
    line = np.linspace(ends.start.position, ends.goal.position, 201)
    force = brentq(lambda force: margin(force, line) - smallest, 0.0, 100.0, xtol=1e-13)
    report = check_path(gachon, scene(force), [ends.start, ends.goal])
    (violation,) = (v for v in report.violations if "margin" in v.what)
    assert what in violation.what
    assert violation.measured == pytest.approx(smallest, abs=1e-6)
    assert violation.measured == pytest.approx(margin(force, [violation.position]), abs=1e-9)
    assert violation.measured == report.capacity_margin
    assert (violation.proved == report.proved_capacity_margin) == is_proved
    assert f"{violation.measured:.4g} N" in violation.sentence()
    assert (", proved " in violation.sentence()) == is_proved


def test_a_margin_must_cover_the_inertia_of_the_motion_limits(gachon, scene_with) -> None:
    """60 kg at 5 m/s2 take 300 N, and as much again for a feed hold while slowing down."""
    scene = scene_with(goal={"position_mm": [60.0, 40.0, 480.0]})

    def report_with(mass: float, **motion: float) -> CheckReport:
        document = gachon.document
        rig = rig_from_document(
            document.model_copy(
                update={
                    "platform": document.platform.model_copy(update={"mass_kg": mass}),
                    "cables": document.cables.model_copy(update={"max_tension_n": 600.0}),
                    "motion": document.motion.model_copy(update=motion),
                }
            )
        )
        return check_path(rig, scene, [scene.start, scene.goal])

    at_rest = report_with(60.0)
    fast = report_with(60.0, acceleration_mm_s2=5000.0, jerk_mm_s3=1e6)
    assert at_rest.passed
    assert fast.required_capacity_margin == pytest.approx(600.0)
    assert fast.capacity_margin == at_rest.capacity_margin < 600.0
    (violation,) = fast.violations
    assert "cannot accelerate the platform" in violation.what
    assert "acceleration_mm_s2" in fast.cure
    light = report_with(0.4, acceleration_mm_s2=5000.0, jerk_mm_s3=1e6)
    assert light.passed


def test_the_margins_of_a_path_with_stops_are_of_the_leg_with_the_least_to_spare(
    gachon, scene_with
) -> None:
    """Loads differ from leg to leg, and with them the margin and what acceleration requires."""
    scene = scene_with()
    leg = check_path(gachon, scene, [scene.start] * 2, ends=False)
    roomy, empty, loaded = (
        replace(leg, capacity_margin=m, proved_capacity_margin=p, required_capacity_margin=r)
        for m, p, r in ((90.0, 80.0, 30.0), (12.0, 10.0, 2.0), (29.0, 28.0, 25.0))
    )
    for legs in permutations((roomy, empty, loaded)):
        whole = joined(legs, [0.1] * 3)
        assert whole.capacity_margin == 29.0
        assert whole.proved_capacity_margin == 28.0
        assert whole.required_capacity_margin == 25.0


def test_disturbances_count_although_the_weight_alone_is_held(gachon, scene_with) -> None:
    windy = scene_with(load={"force_n": [80.0, 80.0, 80.0]})
    what = kinds(check_path(gachon, windy, [windy.start, windy.goal]))
    assert "cannot hold" in what
    assert "no tensions" not in what


def test_too_little_self_clearance_is_a_violation_with_its_pair(gachon, scene_with) -> None:
    scene = scene_with(clearance={"self_mm": 30.0})
    report = check_path(gachon, scene, [scene.start, scene.goal])
    assert "self clearance too small" in kinds(report)
    assert report.self_clearance.nearest.first in kinds(report)


def test_a_winch_too_slow_for_the_path_speed_is_a_violation(gachon, scene_with) -> None:
    scene = scene_with(goal={"position_mm": [0.0, 0.0, 500.0]})
    document = gachon.document
    slow = [w.model_copy(update={"max_speed_mm_s": 5.0}) for w in document.winches]
    rig = rig_from_document(document.model_copy(update={"winches": slow}))
    assert "faster than its winch" in kinds(check_path(rig, scene, [scene.start, scene.goal]))


def test_a_path_that_turns_the_platform_is_checked_too(gachon, scene_with) -> None:
    rotated = Pose(gachon.home.position, Rotation.from_euler("z", 1, degrees=True).as_matrix())
    report = check_path(gachon, scene_with(), [gachon.home, rotated, gachon.home])
    assert report.passed
    assert report.length == 0.0
    far = Pose(gachon.home.position, Rotation.from_euler("z", 150, degrees=True).as_matrix())
    assert "self clearance" in kinds(
        check_path(gachon, scene_with(), [gachon.home, far], ends=False)
    )


def test_a_rotation_violation_states_where_the_rotation_is_largest(gachon, scene_with) -> None:
    scene = scene_with(rotation_limits={"tilt_deg": 3.0, "turn_deg": 180.0})
    position = np.add(gachon.home.position, [0.05, 0.0, 0.0])
    goal = Pose(position, Rotation.from_euler("x", 0.1).as_matrix())
    report = check_path(gachon, scene, [gachon.home, goal, gachon.home], ends=False)
    (violation,) = (v for v in report.violations if "tilted" in v.what)
    assert violation.measured == pytest.approx(0.1)
    assert violation.position == pytest.approx(goal.position)


@pytest.mark.parametrize("miss", [-0.01, -2e-6, 0.0, 1e-8, 2e-6, 0.01])
def test_a_half_turn_in_one_move_is_refused_whatever_the_limits(gachon, scene_with, miss) -> None:
    """Which way it goes is round-off: the limits were proved for the other way."""
    rng = np.random.default_rng(1)
    start = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3))
    goal = start * Rotation.from_rotvec((np.pi + miss) * unit(rng))
    ends = [Pose(gachon.home.position, rotation.as_matrix()) for rotation in (start, goal)]
    for limits in ({}, {"rotation_limits": {"tilt_deg": 90.0, "turn_deg": 180.0}}):
        report = check_path(gachon, scene_with(**limits), ends, ends=False)
        assert ("half turn" in kinds(report)) == (abs(miss) < 1e-6)


def test_from_one_side_to_the_other_through_the_back_is_not_proved_through_the_front(
    gachon, scene_with
) -> None:
    half = math.sqrt(0.5)
    start, goal = (
        Pose.from_quaternion(gachon.home.position, [half, 0.0, 0.0, side * half])
        for side in (-1, 1)
    )
    scene = scene_with(rotation_limits={"tilt_deg": 10.0, "turn_deg": 90.0})
    report = check_path(gachon, scene, [start, goal], ends=False)
    assert "half turn in one move" in kinds(report)


def test_a_speed_violation_and_the_report_state_the_fastest_sample(gachon, scene_with) -> None:
    """Slow at first, as the cable is nearly at right angles to the path, then faster."""
    document = gachon.document
    slow = [w.model_copy(update={"max_speed_mm_s": 5.0}) for w in document.winches]
    rig = rig_from_document(document.model_copy(update={"winches": slow}))
    path = [Pose.level(p) for p in ([0.1, 0.1, 0.6], [0.1, 0.1, 0.4], [0, 0, 0.4])]
    report = check_path(rig, scene_with(), path, ends=False)
    assert (
        report.max_cable_speed == check_path(gachon, scene_with(), path, ends=False).max_cable_speed
    )
    (violation,) = (v for v in report.violations if "faster" in v.what)
    assert violation.measured == report.max_cable_speed
    cable = int(violation.what.split()[1]) - 1
    row = structure_matrix(rig, Pose.level(violation.position))[:3, cable]
    direction = np.array([-1.0, -1.0, 0.0]) / math.sqrt(2.0)
    assert abs(row @ direction) * rig.motion.speed == pytest.approx(violation.measured)


def test_a_cable_near_its_pulleys_axis_is_reported_with_its_distance(gachon, scene_with) -> None:
    pulleys = {"radius_mm": 13.0, "feed_directions": [[0.0, 0.0, 1.0]] * 8}
    rig = Rig.from_dict({**gachon.as_dict(), "pulleys": pulleys})
    x, y, _ = rig.outlets[0] - rig.anchors[0]
    below = Pose.level([x - np.sign(x) * 0.04, y, 0.3])
    report = check_path(rig, scene_with(), [below, gachon.home], ends=False)
    (violation,) = (v for v in report.violations if "pulley's axis" in v.what)
    reach = axis_distances(rig, Pose.level(violation.position).apply(rig.anchors))
    cable = int(violation.what.split()[1]) - 1
    assert violation.measured == reach[cable] == reach.min()
    assert violation.limit == pytest.approx(4 * 0.013 + 0.005)


@pytest.mark.parametrize("name", ["gachon", "hall"])
@pytest.mark.parametrize(("shift", "turn"), [(0.002, 0.0), (0.002, 0.02), (0.0, 0.02), (0.2, 0.2)])
def test_no_value_changes_by_more_than_is_assumed_between_samples(
    name, shift, turn, gachon, hall, ready_scene
) -> None:
    rig = {"gachon": gachon, "hall": hall}[name]
    scene = ready_scene("environment_1" if name == "gachon" else "hall_pillar")
    rng = np.random.default_rng(9)
    for _ in range(25):
        position = rng.uniform(rig.workspace_lower, rig.workspace_upper)
        near = Pose(
            position + rng.uniform(-shift, shift, 3),
            Rotation.from_rotvec(rng.uniform(-turn, turn, 3)).as_matrix(),
        )
        check = _Check(rig, scene, PosePath(rig, [Pose.level(position), near]))
        at = check.path.marks[-1] * np.sort(np.append(rng.uniform(size=2), [0.0, 1.0]))
        poses = [check.path.pose(motion) for motion in at]
        margins = [capacity_margins(rig, scene, p.position[None], p.rotation)[0] for p in poses]
        if np.isfinite(margins).all():
            assert (abs(np.diff(margins)) <= np.diff(check._margin_change()(at))).all()
        own = [check.model.self_clearance(p).distance for p in poses]
        assert (abs(np.diff(own)) <= np.diff(check._self_change()(at)) + 1e-12).all()
        obstacle = np.array([check.model.smallest(p).distance for p in poses])
        if obstacle.min() > 0.0:
            assert (abs(np.diff(obstacle)) <= np.diff(at) + 1e-6).all()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), length=st.floats(0.0, 1.0), turn_deg=st.floats(0.1, 5.0))
def test_self_clearance_far_from_the_outlets_changes_no_faster_than_is_assumed(
    gachon, scene_with, seed, length, turn_deg
) -> None:
    """Outlets up to 40 m away: the lever arms are 300 times the platform's reach."""
    rig = hangar(gachon)
    rng = np.random.default_rng(seed)
    start = Pose.level(rng.uniform([-15.0, -15.0, 1.0], [15.0, 15.0, 19.0]))
    turned = Rotation.from_rotvec(np.radians(turn_deg) * unit(rng)).as_matrix()
    path = PosePath(rig, [start, Pose(start.position + length * unit(rng), turned)])
    check = _Check(rig, scene_with(), path)
    at = np.linspace(0.0, path.marks[-1], 200)
    own = [check.model.self_clearance(path.pose(motion)).distance for motion in at]
    changes = np.diff(check._self_change()(at))
    assert (abs(np.diff(own)) <= changes + 1e-12).all()


@pytest.mark.slow
def test_a_long_move_that_rotates_a_little_is_proved(gachon, scene_with) -> None:
    """10 m and 0.7°: the bound was that of a rotation all along, far below the clearance."""
    rig = hangar(gachon)
    goal = Pose([5.0, 0.0, 8.0], Rotation.from_euler("z", 0.7, degrees=True).as_matrix())
    scene = scene_with(clearance={"self_mm": 5.0})
    report = check_path(rig, scene, [Pose.level([-5.0, 0.0, 8.0]), goal], ends=False)
    assert "self clearance" not in kinds(report)
    assert report.proved_self_clearance == pytest.approx(
        report.self_clearance.nearest.distance, abs=1e-3
    )


def hangar(gachon: Rig) -> Rig:
    """A frame of 50 m by 50 m by 20 m about a platform of 200 mm, cables not crossed."""
    corners = np.array(list(product([-1, 1], repeat=3)))
    data = gachon.as_dict() | {
        "outlets_mm": (corners * [25000, 25000, 10000] + [0, 0, 10000]).tolist(),
        "anchors_mm": (corners * 100).tolist(),
        "workspace": {"lower_mm": [-20000, -20000, 0], "upper_mm": [20000, 20000, 20000]},
    }
    data["platform"] |= {"size_mm": [200] * 3, "home": {"position_mm": [0, 0, 8000]}}
    data["cables"] |= {"radius_mm": 3, "max_tension_n": 2000}
    return Rig.from_dict(data)


def unit(rng: np.random.Generator) -> np.ndarray:
    """A random direction."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def test_reported_cable_speed_is_that_of_the_fastest_cable(gachon, scene_with) -> None:
    scene = scene_with(goal={"position_mm": [0.0, 100.0, 445.0]})
    report = check_path(gachon, scene, [scene.start, scene.goal])
    rates = [
        np.abs(structure_matrix(gachon, interpolate(scene.start, scene.goal, t))[1]).max()
        for t in np.linspace(0, 1, 200)
    ]
    assert report.max_cable_speed == pytest.approx(0.020 * max(rates), rel=1e-2)


def test_a_verified_plan_cannot_be_made_without_the_check(gachon, document) -> None:
    plan = plan_from_document(document)
    report = check_path(gachon, plan.scene, plan.waypoints)
    with pytest.raises(TypeError, match=r"planner\.check\.verify"):
        VerifiedPlan(plan, report, object())


def test_a_report_is_plain_json(gachon, document) -> None:
    import json

    plan = plan_from_document(document)
    text = json.dumps(check_path(gachon, plan.scene, plan.waypoints).as_dict(), allow_nan=False)
    assert json.loads(text)["passed"] is True


@given(
    limit=st.floats(1e-4, 1e3),
    short=st.floats(1e-12, 0.9),
    unit=st.sampled_from(["mm", "mm/s", "°", "N"]),
    proves=st.booleans(),
)
def test_a_violation_never_shows_a_value_equal_to_its_limit(
    limit: float, short: float, unit: str, proves: bool
) -> None:
    """9.9999 mm of 10 mm was "10 mm (limit 10 mm)"."""
    below = limit * (1.0 - short)
    figures = (
        (limit * 2.0, limit, unit, np.zeros(3), below)
        if proves
        else (below, limit, unit, np.zeros(3))
    )
    sentence = Violation("too near", *figures).sentence()
    shown = dict(re.findall(r"(: |proved |limit )(-?[\d.e+-]+) ", sentence))
    assert float(shown["proved " if proves else ": "]) < float(shown["limit "])
