"""Planning with the platform free to turn: ends, seeds, refusals, and plans that pass."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from model.errors import BadInput, InvalidFile, NoSolution
from model.files.documents import PoseDocument
from model.files.plan_file import PlanDocument
from model.plan import load_plan, plan_facts, plan_from_document, save_plan
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene, empty_scene, load_scene
from model.statics.wrench_sets import rms_anchor_radius
from planner.anytime.path import CompiledSearch
from planner.anytime_6d.local_search import measure, new_line
from planner.anytime_6d.path import RotatingSearch, rotating_route
from planner.anytime_6d.problem import RotatingProblem
from planner.check import check_path, verify
from planner.costs import KinematicCost
from planner.path import Route
from planner.planning import make_plan
from planner.settings import OBJECTIVES, TurningSettings
from tests.configs import CONFIGS, GACHON, HALL
from tests.planner.anytime_6d.rotating_scenes import (
    Judge,
    problem_of,
    quaternion,
    row,
    turning,
    upside_down,
)

ROUNDS = TurningSettings(rounds=60)
RAMP = load_scene(CONFIGS / "turn.yaml")


def routed(
    scene: Scene, settings: TurningSettings, clock: Callable[[], float] = time.perf_counter
) -> Route:
    return rotating_route(
        GACHON, scene, settings, KinematicCost(GACHON, scene.start.rotation), clock=clock
    )


def proved(rig: Rig, scene: Scene, settings: TurningSettings) -> PlanDocument:
    """The plan's document, after it passed its check and met its ends."""
    document = make_plan(rig, scene, settings)
    plan = verify(plan_from_document(document)).plan
    for pose, wanted in ((plan.waypoints[0], scene.start), (plan.waypoints[-1], scene.goal)):
        assert pose.distance_to(wanted) < 1e-6
        assert pose.angle_to(wanted) < 1e-6
    return document


def test_the_example_scene_is_planned_and_an_independent_judge_finds_no_fault() -> None:
    document = proved(GACHON, RAMP, ROUNDS)
    judge, poses = Judge(GACHON, RAMP), plan_from_document(document).waypoints
    for start, end in itertools.pairwise(poses):
        assert judge.fault(start, end, 40) == ""
    assert document.quality.length_mm < 800.0
    assert document.planner.name == "turning"
    rotation = dict(plan_facts(document))["rotation"]
    tilt = float(rotation.removeprefix("tilted up to ").split("°")[0])
    assert 6.0 <= tilt <= 8.0
    assert "rotated up to" in rotation
    assert document.planner.rounds == [60]


def test_a_platform_frame_whose_z_axis_points_down_is_planned_like_any_other() -> None:
    rig = upside_down(GACHON)
    over = Rotation.from_quat([0.0, 1.0, 0.0, 0.0], scalar_first=True)
    ends = {}
    for name, pose in (("start", RAMP.start), ("goal", RAMP.goal)):
        turned = Pose(pose.position, (Rotation.from_matrix(pose.rotation) * over).as_matrix())
        ends[name] = PoseDocument.of(turned).model_dump()
    document = proved(rig, turning("turn", 180.0, 180.0, **ends), ROUNDS)
    assert document.quality.length_mm < 800.0


def test_the_same_seed_and_rounds_give_the_same_path_and_others_another() -> None:
    first, again = (routed(RAMP, ROUNDS) for _ in range(2))
    assert first.path.tolist() == again.path.tolist()
    assert first.edge_checks == again.edge_checks
    other = routed(RAMP, TurningSettings(seed=1, rounds=60))
    assert other.path.tolist() != first.path.tolist()


@pytest.mark.parametrize("name", ["length", "kinematic", "capacity"])
def test_rotation_never_costs_more_than_the_path_without_it(name) -> None:
    """Four rounds of that are done in the first of this; a repeated search finds the same path."""
    scene, weights = turning("environment_3", 8.0, 2.0), OBJECTIVES[name].normalized()
    kinematic = KinematicCost(GACHON, scene.start.rotation)
    settings = TurningSettings(weights=OBJECTIVES[name], seed=2, rounds=1)
    found, again = (routed(scene, settings).path for _ in range(2))
    assert found.tolist() == again.tolist()
    level = CompiledSearch(GACHON, scene, weights, kinematic, settings.seed)
    for _ in range(4):
        level.advance()
    path = np.zeros((len(level.path), 7))
    path[:, :3], path[:, 3] = level.path, 1.0
    cost, of_level = (_cost(problem_of(GACHON, scene, weights), poses) for poses in (found, path))
    assert cost <= of_level


def _cost(problem: RotatingProblem, poses: Array) -> float:
    line = new_line()
    line.poses[: len(poses)], line.counts[0] = poses, len(poses)
    return float(measure(problem, line))


def test_a_path_without_rotation_that_is_not_allowed_here_is_not_used() -> None:
    """It keeps a smaller reserve of the capacity margin; this one even passes through a post."""

    class Blocked:
        checks = 3

        def __init__(self) -> None:
            self.path, self.rounds = np.array([scene.start.position, scene.goal.position]), 0

        def advance(self) -> None:
            self.rounds += 1

    scene = turning("environment_1", 8.0, 2.0)
    blocked = Blocked()
    ends = row(scene.start), row(scene.goal)
    search = RotatingSearch(problem_of(GACHON, scene), *ends, 0, blocked)  # type: ignore[arg-type]
    for _ in range(12):
        search.advance()
    assert search.path is not None
    assert len(search.path) > 2
    assert blocked.rounds == 4, "it is not asked again"


def test_more_rounds_are_never_worse_and_a_plan_with_a_budget_states_them() -> None:
    ticks = itertools.count()
    settings = TurningSettings(budget=0.040)
    found = routed(RAMP, settings, clock=lambda: 1e-3 * next(ticks))
    again = routed(RAMP, TurningSettings(rounds=found.iterations))
    assert again.path.tolist() == found.path.tolist()
    lengths = [routed(RAMP, TurningSettings(rounds=rounds)).path for rounds in (15, 40, 90)]
    sums = [_length(path) for path in lengths]
    assert sums == sorted(sums, reverse=True)


def _length(path: np.ndarray) -> float:
    """Length, rotation counted, by rotation vectors of the model."""
    poses = [Pose.from_quaternion(row[:3], row[3:]) for row in path]
    radian = rms_anchor_radius(GACHON.anchors)
    return sum(
        float(np.hypot(a.distance_to(b), radian * a.angle_to(b)))
        for a, b in itertools.pairwise(poses)
    )


def test_where_nothing_blocks_it_the_single_move_is_the_path() -> None:
    goal = {"position_mm": [60, 40, 430], "rotation_wxyz": quaternion(4.0, -3.0)}
    scene = turning("environment_1", 8.0, 2.0, goal=goal, obstacles=[])
    route = routed(scene, ROUNDS)
    assert route.iterations == 1
    level = make_plan(GACHON, scene.changed(goal=Pose.level([0.06, 0.04, 0.43])), ROUNDS)
    assert "rotation" not in dict(plan_facts(level))
    assert len(route.path) == 2


def test_a_stop_may_be_tilted_otherwise_than_start_and_goal() -> None:
    stop = {
        "name": "look",
        "kind": "pass",
        "position_mm": [150, 60, 400],
        "rotation_wxyz": quaternion(-3.0, 2.0),
    }
    goal = {"position_mm": [80, -120, 420], "rotation_wxyz": quaternion(0.0, 4.0)}
    scene = turning("environment_1", 8.0, 2.0, goal=goal, stops=[stop])
    document = proved(GACHON, scene, ROUNDS)
    met = plan_from_document(document).waypoints[document.stops[0].waypoint]
    assert met.angle_to(scene.stops[0].pose) < 1e-6
    assert len(document.planner.rounds) == 2


def test_a_platform_whose_cables_end_off_its_box_rotates_along_its_path(open_frame) -> None:
    document = proved(open_frame, RAMP, ROUNDS)
    assert document.quality.self_clearance.distance_mm >= 5.0


@pytest.mark.slow
def test_a_robot_with_pulleys_rotates_along_its_path_around_the_pillar() -> None:
    goal = {"position_mm": [-700, 0, 900], "rotation_wxyz": quaternion(0.0, 6.0, 2.0)}
    document = proved(HALL, turning("hall_pillar", 8.0, 4.0, goal=goal), ROUNDS)
    assert document.quality.obstacle_clearance is not None
    assert document.quality.obstacle_clearance.distance_mm >= 40.0


def test_without_limits_in_the_scene_the_next_step_is_stated() -> None:
    scene = load_scene(CONFIGS / "environment_1.yaml")
    with pytest.raises(BadInput, match="has no limits for rotation") as caught:
        make_plan(GACHON, scene, ROUNDS)
    limits = RAMP.document.rotation_limits  # those the documentation shows and explains
    wanted = f"{{tilt_deg: {limits.tilt_deg:g}, turn_deg: {limits.turn_deg:g}}}"
    assert f"`rotation_limits: {wanted}`" in str(caught.value)
    assert wanted in (CONFIGS.parent / "docs/turning.md").read_text()


def test_ends_of_different_orientation_need_the_option() -> None:
    with pytest.raises(BadInput, match="differ in orientation by 6 deg") as caught:
        make_plan(GACHON, RAMP)
    assert "`free_rotation=True`" in str(caught.value)


def test_a_search_that_finds_nothing_states_what_blocked_it() -> None:
    wall = [{"name": "wall", "box": {"size_mm": [20, 900, 900]}, "position_mm": [0, 0, 400]}]
    ends = {"start": {"position_mm": [200, 0, 400]}, "goal": {"position_mm": [-200, 0, 400]}}
    scene = turning("environment_1", 5.0, 2.0, obstacles=wall, **ends)
    with pytest.raises(NoSolution, match="no path after 3 rounds") as caught:
        routed(scene, TurningSettings(rounds=3))
    assert "obstacle clearance" in str(caught.value)
    assert caught.value.values["rounds"] == 3.0


def test_the_check_refuses_a_path_rotated_farther_than_the_scene_allows() -> None:
    far = Pose.from_quaternion([0.0, 0.0, 0.445], quaternion(0.0, 9.0))
    ends = {"start": {"position_mm": [0, 0, 445]}, "goal": {"position_mm": [0, 0, 445]}}
    scene = turning("environment_1", 8.0, 2.0, obstacles=[], **ends)
    report = check_path(GACHON, scene, [scene.start, far, scene.goal], ends=False)
    sentences = [violation.sentence() for violation in report.violations]
    assert any("tilted too far: 9 ° (limit 8 °)" in sentence for sentence in sentences)


def test_a_goal_beyond_the_limits_is_refused_with_its_key(tmp_path) -> None:
    text = (CONFIGS / "turn.yaml").read_text().replace("tilt_deg: 8", "tilt_deg: 4")
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InvalidFile, match="the goal is tilted by 6 deg") as caught:
        load_scene(path)
    assert "goal.rotation_wxyz" in str(caught.value)


def test_a_plan_survives_its_file(tmp_path) -> None:
    document = make_plan(GACHON, RAMP, ROUNDS)
    save_plan(document, tmp_path / "plan.json")
    plan = load_plan(tmp_path / "plan.json")
    assert verify(plan).report.proved_obstacle_clearance >= 0.010


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"budget": 0.0}, {"rounds": 0}])
def test_unusable_settings_are_refused(wrong) -> None:
    with pytest.raises(BadInput):
        TurningSettings(**wrong)


def test_ends_at_the_limit_with_six_decimals_are_planned_between() -> None:
    """As a user writes them: this quaternion tilts by 1.2e-6 rad more than 5 degrees."""
    scene = empty_scene(GACHON).as_dict() | {"rotation_limits": {"tilt_deg": 5.0, "turn_deg": 2.0}}
    tilted = [0.999048, 0.030844, 0.030844, 0.0]
    for end, position in (("start", [-40.0, 0.0, 400.0]), ("goal", [40.0, 20.0, 430.0])):
        scene[end] = {"position_mm": position, "rotation_wxyz": tilted}
    proved(GACHON, Scene.from_dict(scene), TurningSettings(rounds=6))
