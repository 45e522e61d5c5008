"""Planning as a whole: ends, seeds, modes, refusals, and plans that pass their check."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model import jit as machine_code
from model.clearance import ClearanceModel
from model.errors import BadInput, CdprError, Fault, NoSolution
from model.files.rig_file import RigDocument
from model.jit import KernelSet, compilation, is_compiled
from model.plan import plan_from_document
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig, rig_from_document
from model.scene import empty_scene, scene_from_document
from planner import planning
from planner.check import verify
from planner.check_report import PlanRejected
from planner.costs import capacity_margins, margin_reserve
from planner.endpoints import require_usable_ends
from planner.path import Route
from planner.planning import make_plan, plan_from_waypoints, plan_path
from planner.settings import (
    CLEARANCE_RESERVE,
    MARGIN_RESERVE,
    OptimalSettings,
    PlannerSettings,
)

QUICK = PlannerSettings(mode="paper")


def proved(rig, scene, settings):
    """The plan's document, after it passed its check and met its ends."""
    document = make_plan(rig, scene, settings)
    plan = verify(plan_from_document(document)).plan
    assert plan.waypoints[0].distance_to(scene.start) < 1e-6
    assert plan.waypoints[-1].distance_to(scene.goal) < 1e-6
    assert plan.raw_path[-1].distance_to(scene.goal) < 1e-6
    return document


@pytest.fixture(scope="module")
def rewired(gachon, ready_scene):
    """Plans of the default mode in an environment, for a cost, each made once."""

    @cache
    def plan(number, cost):
        return proved(gachon, ready_scene(f"environment_{number}"), PlannerSettings(cost=cost))

    return plan


@pytest.mark.parametrize(
    ("number", "clearance_mm", "sampler"),
    [
        (1, 20, "adaptive"),
        (1, 10, "goal-bias"),
        (2, 10, "adaptive"),
        (3, 20, "adaptive"),
        (3, 10, "goal-bias"),
    ],
)
def test_plans_of_the_paper_mode_pass_their_check(
    gachon, ready_scene, number, clearance_mm, sampler
) -> None:
    scene = ready_scene(f"environment_{number}").changed(clearance=clearance_mm / 1000)
    document = proved(gachon, scene, PlannerSettings(sampler=sampler, mode="paper", seed=1))
    assert document.quality.obstacle_clearance.distance_mm >= clearance_mm
    assert document.quality.length_mm <= document.quality.raw_length_mm


@pytest.mark.parametrize(
    ("number", "cost", "longest_mm"),
    [(1, "length", 660), (3, "length", 860), (2, "kinematic", 950)],
)
def test_the_rewiring_mode_comes_near_the_shortest_paths_known(
    rewired, number, cost, longest_mm
) -> None:
    """Source: polished shortest lengths at 10 mm are 628.5, 661.0 and 813.5 mm."""
    document = rewired(number, cost)
    assert document.planner.mode == "rewire"
    assert 628 <= document.quality.length_mm <= longest_mm


def test_the_kinematic_cost_makes_paths_of_lower_cost_integral(rewired) -> None:
    integrals = {}
    for cost in ("kinematic", "length"):
        quality = rewired(1, cost).quality
        integrals[cost] = quality.mean_kinematic_cost * quality.length_mm
    assert integrals["kinematic"] < 0.97 * integrals["length"]


def test_the_same_seed_gives_the_same_plan_and_another_seed_another(gachon, ready_scene) -> None:
    scene = ready_scene("environment_1")
    plans = [
        make_plan(gachon, scene, PlannerSettings(mode="paper", seed=s), clock=lambda: 0.0)
        for s in (5, 5, 6)
    ]
    assert plans[0] == plans[1]
    assert plans[0].hash == plans[1].hash
    assert plans[0].waypoints != plans[2].waypoints


@pytest.mark.parametrize(("mode", "steer"), [("paper", "full-step"), ("rewire", "to-sample")])
def test_a_plan_states_the_steps_its_search_took(gachon, ready_scene, rewired, mode, steer) -> None:
    settings = PlannerSettings(mode=mode, cost="length")
    document = rewired(1, "length")
    if mode == "paper":
        document = make_plan(gachon, ready_scene("environment_1"), settings)
    assert document.planner.readings.steer == steer
    nodes = np.array(document.tree.positions_mm)
    away_from_goal = np.linalg.norm(nodes - document.waypoints[-1].position_mm, axis=1) > 0.01
    nodes = nodes[away_from_goal]  # the goal is joined from within its radius
    off = [
        np.abs(np.linalg.norm(nodes[:k] - nodes[k], axis=1) - settings.step * 1e3).min()
        for k in range(1, len(nodes))
    ]
    assert (max(off) < 0.01) == (steer == "full-step")


def test_the_tree_of_a_plan_holds_its_raw_path(gachon, ready_scene) -> None:
    document = make_plan(gachon, ready_scene("environment_2"), QUICK)
    tree = document.tree
    assert len(tree.positions_mm) == len(tree.parents) == document.statistics.nodes
    assert tree.parents[0] == -1
    nodes = np.array(tree.positions_mm)
    for waypoint in document.raw_path:
        away = np.linalg.norm(nodes - waypoint.position_mm, axis=1)
        assert away.min() < 0.002


def test_progress_is_reported_with_iterations_and_distance(gachon, ready_scene) -> None:
    reported: list[tuple[int, int, float]] = []
    make_plan(gachon, ready_scene("environment_1"), QUICK, lambda *now: reported.append(now))
    assert reported
    assert [t[0] for t in reported] == sorted(t[0] for t in reported)
    assert all(0 <= distance < 0.6 for _, _, distance in reported)


@pytest.mark.parametrize("mode", ["paper", "rewire"])
def test_a_goal_at_the_start_is_a_plan_of_no_length(gachon, scene_with, mode) -> None:
    document = proved(gachon, scene_with(), PlannerSettings(mode=mode))
    assert document.quality.length_mm == 0.0
    assert len(document.waypoints) == 2
    assert document.quality.obstacle_clearance is None


@pytest.mark.parametrize("mode", ["paper", "rewire"])
def test_a_free_straight_line_is_the_plan(gachon, scene_with, mode) -> None:
    scene = scene_with(goal={"position_mm": [100.0, 50.0, 400.0]})
    document = proved(gachon, scene, PlannerSettings(mode=mode, cost="length"))
    assert document.quality.length_mm == pytest.approx(np.linalg.norm([100, 50, 45]), rel=1e-9)


def test_a_rotated_platform_keeps_its_orientation(gachon, scene_with) -> None:
    rotated = [float(np.cos(np.radians(0.5))), 0.0, 0.0, float(np.sin(np.radians(0.5)))]
    scene = scene_with(
        start={"position_mm": [0.0, 0.0, 445.0], "rotation_wxyz": rotated},
        goal={"position_mm": [60.0, 0.0, 445.0], "rotation_wxyz": rotated},
    )
    plan = plan_from_document(proved(gachon, scene, QUICK))
    assert all(w.angle_to(scene.start) < 1e-9 for w in plan.waypoints)


@pytest.mark.parametrize(
    ("start_mm", "words"),
    [
        ([-150, 0, 300], ["start", "touches obstacle_1", "overlap"]),
        ([-40, 0, 300], ["start", "platform", "obstacle_1"]),
        ([300, 0, 300], ["start", "50.0 mm outside the workspace", "x = 300.0 mm"]),
        ([0, 0, 100], ["start", "50.0 mm outside the workspace", "z = 100.0 mm"]),
    ],
)
def test_a_start_that_cannot_be_used_names_what_and_by_how_much(
    gachon, ready_scene, start_mm, words
) -> None:
    scene = ready_scene("environment_1")
    bad = scene.changed(start=Pose.level(np.array(start_mm) / 1000))
    with pytest.raises(BadInput) as refusal:
        make_plan(gachon, bad, QUICK)
    assert refusal.value.exit_code == 2
    assert all(word in str(refusal.value) for word in words)
    mirrored = scene.changed(goal=Pose.level(np.array(start_mm) / 1000))
    with pytest.raises(BadInput, match="goal"):
        make_plan(gachon, mirrored, QUICK)


def test_a_start_that_barely_touches_is_not_reported_as_no_overlap(gachon, ready_scene) -> None:
    bad = ready_scene("environment_1").changed(start=Pose.level([-0.045 - 1e-12, 0.0, 0.3]))
    with pytest.raises(BadInput, match="platform touches obstacle_1") as refusal:
        make_plan(gachon, bad, QUICK)
    assert "overlap" not in str(refusal.value)


def test_a_start_nearer_than_the_clearance_asked_for_states_both_figures(
    gachon, ready_scene
) -> None:
    scene = ready_scene("environment_1").changed(clearance=0.040)
    with pytest.raises(BadInput, match=r"cable 7 is 32\.22 mm from obstacle_1.*40\.05 mm"):
        make_plan(gachon, scene, QUICK)


def test_a_load_too_heavy_for_the_cables_is_bad_input(gachon, scene_with) -> None:
    with pytest.raises(BadInput, match="cannot hold the platform"):
        make_plan(gachon, scene_with(load={"payload_kg": 60.0}), QUICK)


def test_a_platform_too_light_below_its_outlets_is_not_advised_to_carry_less(
    gachon, scene_with
) -> None:
    """With smallest tensions of 5 N eight cables from a ceiling lift 0.4 kg."""
    corners = [(x, y) for x in (1, -1) for y in (1, -1)]
    outlets = [[a * x, b * y, 2000] for x, y in corners for a, b in ((1000, 900), (900, 1000))]
    anchors = [[65 * x, 65 * y, z] for x, y in corners for z in (-65, 65)]
    rig = Rig.from_dict({**gachon.as_dict(), "outlets_mm": outlets, "anchors_mm": anchors})
    with pytest.raises(BadInput, match="cannot hold the platform") as refusal:
        make_plan(rig, scene_with(), QUICK)
    assert "lower the smallest tensions, add weight" in refusal.value.next_step


def test_an_end_that_only_lacks_the_reserve_is_not_called_infeasible(gachon, scene_with) -> None:
    """The check accepts such a path: tensions within the limits exist, and its motion is gentle."""
    motion = gachon.document.motion.model_copy(update={"acceleration_mm_s2": 0.1})
    gentle = rig_from_document(gachon.document.model_copy(update={"motion": motion}))
    reserve, low, high = MARGIN_RESERVE * gachon.max_tension, 0.0, 60.0
    ends = {"goal": {"position_mm": [0.0, 0.0, 446.0]}}
    margin = -np.inf
    while not 0.2 * reserve < margin < 0.8 * reserve:
        payload = (low + high) / 2.0
        scene = scene_with(load={"payload_kg": payload}, **ends)
        margin = capacity_margins(gachon, scene, scene.start.position[None, :], np.eye(3))[0]
        low, high = (payload, high) if margin > 0.8 * reserve else (low, payload)
    with pytest.raises(BadInput, match="start the cables can hold the platform") as caught:
        make_plan(gentle, scene, OptimalSettings())
    assert (
        f"{margin:.2f} N, less than the planner's reserve of {reserve:.2f} N" in caught.value.what
    )
    assert caught.value.values == pytest.approx({"margin_n": margin, "required_n": reserve})
    assert "outside" not in caught.value.why
    own = plan_from_waypoints(gentle, scene, [scene.start, scene.goal])
    assert verify(own).report.proved_capacity_margin >= 0.0
    with pytest.raises(BadInput, match="but not accelerate it by its motion limits") as caught:
        make_plan(gachon, scene, OptimalSettings())
    assert "acceleration_mm_s2" in caught.value.next_step
    assert "plan_from_waypoints" not in caught.value.next_step
    with pytest.raises(PlanRejected, match="cannot accelerate the platform") as rejected:
        plan_from_waypoints(gachon, scene, [scene.start, scene.goal])
    assert "acceleration_mm_s2" in rejected.value.next_step


def test_an_end_with_margin_for_a_plan_without_rotation_has_it_as_a_remedy(hall, ready_scene):
    """What rotates needs more than twice the margin of what is carried level, on this robot."""
    scene = ready_scene("hall_pillar")
    reserves = [margin_reserve(hall, scene.load, turns=turns) for turns in (False, True)]
    low, high, margin = 0.0, 600.0, np.inf
    while not reserves[0] < margin < reserves[1]:
        force = (low + high) / 2.0
        load = scene.document.load.model_copy(update={"force_n": [force] * 3})
        loaded = scene_from_document(scene.document.model_copy(update={"load": load}))
        margin = capacity_margins(hall, loaded, scene.start.position[None, :], np.eye(3))[0]
        low, high = (force, high) if margin > reserves[1] else (low, force)
    with pytest.raises(BadInput, match="the cables can hold the platform") as caught:
        require_usable_ends(hall, loaded, free_rotation=True)
    assert "plan without `free_rotation=True`" in caught.value.next_step
    require_usable_ends(hall, loaded)


def test_cables_that_act_in_too_few_directions_are_named(
    gachon, ready_scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = np.array([-np.inf])  # where the structure matrix is rank-deficient
    monkeypatch.setattr("planner.endpoints.capacity_margins", lambda *_: nothing)
    with pytest.raises(BadInput, match="cannot hold the platform at any tension") as caught:
        require_usable_ends(gachon, ready_scene("environment_1"))
    assert "too few directions" in caught.value.why


def test_infinite_values_of_an_error_are_null_in_json() -> None:
    values = {"margin_n": float("-inf"), "required_n": 0.1, "nodes": "3"}
    assert BadInput("no", values=values).as_dict()["values"] == {**values, "margin_n": None}


def test_start_and_goal_of_different_orientation_are_bad_input(gachon, scene_with) -> None:
    rotated = [float(np.cos(0.05)), 0.0, 0.0, float(np.sin(0.05))]
    scene = scene_with(goal={"position_mm": [0.0, 0.0, 445.0], "rotation_wxyz": rotated})
    with pytest.raises(BadInput, match=r"differ in orientation by 5\.73 deg") as caught:
        make_plan(gachon, scene, QUICK)
    assert "`planner='optimal'` and `free_rotation=True`" in str(caught.value)


def with_anchors(rig: Rig, anchors_mm: Sequence[Sequence[float]]) -> Rig:
    changes = {"anchors_mm": [list(anchor) for anchor in anchors_mm]}
    return rig_from_document(RigDocument.model_validate(rig.document.model_dump() | changes))


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.4, ["at no pose does cable", "39.0 mm inside", "at most 27.45 mm"]),
        (0.55, ["at no pose does cable", "mm inside", "at most 27.45 mm"]),
        (0.6, ["at the start cable", "touches platform", "correct the anchor"]),
    ],
)
def test_anchors_inside_the_platforms_box_are_named(gachon, scene_with, share, words) -> None:
    rig = with_anchors(gachon, share * 1e3 * gachon.anchors)
    with pytest.raises(BadInput) as refusal:
        make_plan(rig, scene_with(goal={"position_mm": [5.0, 0.0, 445.0]}), QUICK)
    assert all(word in str(refusal.value) for word in words)


@pytest.mark.parametrize(
    ("y_mm", "words", "reduced"),
    [(545.0, "its outlet is 0.67 mm from it", True), (524.3, "its outlet is in it", False)],
)
def test_an_obstacle_at_an_outlet_is_named_instead_of_the_start(
    gachon, scene_with, y_mm, words, reduced
) -> None:
    """A post of the frame beside outlet 1, at [-437, 524.3, …] mm."""
    box = {"size_mm": [40.0, 40.0, 900.0]}
    post = {"name": "post", "box": box, "position_mm": [-437.0, y_mm, 450.0]}
    with pytest.raises(
        BadInput, match=r"at no pose does cable 1 keep 10\.05 mm from post"
    ) as refusal:
        require_usable_ends(gachon, scene_with(post))
    assert words in refusal.value.what
    assert "move the start" not in refusal.value.next_step
    assert ("reduce clearance.obstacle_mm" in refusal.value.next_step) == reduced


def test_the_clearance_of_an_obstacle_is_named_as_every_verb_takes_it(gachon, scene_with) -> None:
    """A jog with `--clearance-mm` was sent to the scene file."""
    block = {"name": "block", "box": {"size_mm": [80.0] * 3}, "position_mm": [0.0, 0.0, 300.0]}
    with pytest.raises(BadInput, match=r"at the start .* block") as refusal:
        require_usable_ends(gachon, scene_with(block, clearance={"obstacle_mm": 100.0}))
    assert "clearance.obstacle_mm, or --clearance-mm of `cdpr plan`" in refusal.value.why
    assert "in Python clearance=," in refusal.value.why


def test_without_a_scene_the_self_clearance_is_that_of_a_scene_to_pass(gachon) -> None:
    """A jog with `scene=None` was told to reduce a clearance in the scene."""
    wide = replace(gachon, cable_radius=0.006)
    with pytest.raises(BadInput, match=r"at the start cable \d is .* mm from cable") as refusal:
        require_usable_ends(wide, empty_scene(wide))
    assert "the default clearance.self_mm plus" in refusal.value.why
    assert "`cdpr jog --scene FILE`, in Python scene=" in refusal.value.next_step
    assert "in the scene" not in str(refusal.value)


def test_cables_too_near_each_other_get_no_advice_about_obstacles(gachon, scene_with) -> None:
    """Crossing cables may be moved apart; those from one anchor are near whatever the pose."""
    crossing = replace(scene_with(), self_clearance=0.017)
    with pytest.raises(BadInput, match=r"cable \d is .* mm from cable \d") as refusal:
        require_usable_ends(gachon, crossing)
    assert "share" not in refusal.value.why
    assert "--clearance-mm" not in refusal.value.why
    assert refusal.value.next_step.startswith("move the start, or reduce clearance.self_mm")
    outlets = gachon.document.outlets_mm
    document = gachon.document.model_copy(update={"outlets_mm": [*outlets[1::-1], *outlets[2:]]})
    thick = replace(rig_from_document(document), cable_radius=0.003)
    with pytest.raises(BadInput, match=r"cable 1 touches cable 2") as refusal:
        require_usable_ends(thick, scene_with())
    assert "reduce" not in refusal.value.next_step
    assert refusal.value.next_step.endswith("are interchanged, correct the rig file")
    platform, anchors = gachon.document.platform, gachon.document.anchors_mm
    document = gachon.document.model_copy(
        update={
            "platform": platform.model_copy(update={"size_mm": [*platform.size_mm[:2], 20.0]}),
            "anchors_mm": [anchors[0], anchors[0], *anchors[2:]],
        }
    )
    shared = replace(scene_with(), self_clearance=0.012)
    with pytest.raises(BadInput, match=r"cable 1 is .* mm from cable 2") as refusal:
        require_usable_ends(rig_from_document(document), shared)
    assert "they share an anchor, and only the first 5.0 mm" in refusal.value.why
    assert refusal.value.next_step.startswith("declare a thicker platform box")
    assert "obstacle" not in refusal.value.next_step
    assert refusal.value.values["exempt_mm"] == pytest.approx(5.0)


def test_more_cables_than_can_be_planned_for_are_refused_at_once(gachon, scene_with) -> None:
    document = gachon.document
    outlets, anchors, winches = document.outlets_mm, document.anchors_mm, document.winches
    further = range(17)
    document = document.model_copy(
        update={
            "outlets_mm": [*outlets, *([x - 10.0 - i for x in outlets[i % 8]] for i in further)],
            "anchors_mm": [*anchors, *(anchors[i % 8] for i in further)],
            "winches": [
                *winches,
                *(winches[0].model_copy(update={"node_id": 9 + i}) for i in further),
            ],
        }
    )
    with pytest.raises(BadInput, match="25 cables are too many") as refusal:
        require_usable_ends(rig_from_document(document), scene_with())
    assert "the largest number is 24" in refusal.value.what
    assert ": 53130 bounds" in refusal.value.why


def test_anchors_a_little_inside_the_platforms_box_are_planned_with(gachon, scene_with) -> None:
    rig = with_anchors(gachon, 0.97 * 1e3 * gachon.anchors)
    proved(rig, scene_with(goal={"position_mm": [5.0, 0.0, 445.0]}), QUICK)


@given(
    share=st.floats(0.01, 1.0),
    at=st.tuples(*[st.floats(0.0, 1.0)] * 3),
    turn=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    clearance_mm=st.floats(0.0, 20.0),
)
def test_no_pose_would_pass_where_anchors_are_refused(
    gachon, share, at, turn, clearance_mm
) -> None:
    rig = with_anchors(gachon, share * 1e3 * gachon.anchors)
    position = rig.workspace_lower + np.array(at) * (rig.workspace_upper - rig.workspace_lower)
    pose = Pose(position, matrix_from_rotation_vector(turn))
    scene = empty_scene(rig).changed(start=pose, goal=pose)
    scene = replace(scene, self_clearance=clearance_mm * 1e-3)
    try:
        require_usable_ends(rig, scene)
    except BadInput as refusal:
        if refusal.what.startswith("at no pose"):
            near = ClearanceModel(rig, scene).self_clearance(pose)
            assert near.distance < scene.self_clearance + CLEARANCE_RESERVE


@pytest.mark.parametrize("mode", ["paper", "rewire"])
def test_no_path_within_the_limit_states_the_best_distance_and_why(
    gachon, ready_scene, mode
) -> None:
    settings = PlannerSettings(mode=mode, max_iterations=60)
    with pytest.raises(NoSolution) as nothing:
        make_plan(gachon, ready_scene("environment_3"), settings)
    assert nothing.value.exit_code == 1
    assert 0 < nothing.value.values["best_distance_mm"] < 520
    assert "obstacle clearance" in str(nothing.value)
    assert "cable" in str(nothing.value)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"sampler": "random"}, "sampler"),
        ({"cost": "time"}, "cost"),
        ({"mode": "fast"}, "mode"),
        ({"step": 0.0}, "step"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"goal_radius": float("nan")}, "goal_radius"),
        ({"seed": -1}, "seed"),
    ],
)
def test_unusable_settings_are_refused(wrong, word) -> None:
    with pytest.raises(BadInput, match=word):
        PlannerSettings(**wrong)


def test_pulleys_payload_and_disturbances_are_planned_and_checked(hall, ready_scene) -> None:
    document = proved(hall, ready_scene("hall_pillar"), QUICK)
    assert document.quality.obstacle_clearance.distance_mm >= 40
    assert len(document.waypoints) > 2  # the pillar blocks the straight line


@pytest.mark.slow
@pytest.mark.parametrize(("number", "clearance_mm"), [(1, 20), (2, 10), (3, 20)])
def test_plans_of_other_seeds_pass_their_check(gachon, ready_scene, number, clearance_mm) -> None:
    """Another seed each; `benchmarks/campaign.py` runs twenty."""
    scene = ready_scene(f"environment_{number}").changed(clearance=clearance_mm / 1000)
    document = proved(gachon, scene, PlannerSettings(seed=number + clearance_mm))
    assert document.quality.obstacle_clearance.distance_mm >= clearance_mm


def test_a_path_near_a_pulleys_axis_is_refused_by_cable_and_pose(hall, monkeypatch) -> None:
    """The search does not avoid the axis; its refusal is not a fault of this program."""
    document = hall.as_dict()
    document["outlets_mm"][4] = [0.0, 700.0, 2600.0]
    rig = Rig.from_dict(document)
    start, goal = (Pose.level([x, 0.45, 1.1]) for x in (0.5, -0.5))
    scene = empty_scene(rig).changed(start=start, goal=goal)
    line = np.array([start.position, goal.position])
    route = Route(line, line, nodes=line, parents=np.array([-1, 0]), iterations=1, edge_checks=1)
    found = planning.MultiSegmentPath(route, (), (1,))
    monkeypatch.setattr(planning, "plan_segments", lambda *_: found)
    with pytest.raises(BadInput, match=r"^.*cable 5 .* pulley's axis.*at \[.*, 450.0, 1100.0\] mm"):
        make_plan(rig, scene)


@pytest.mark.parametrize("refusal", [BadInput, NoSolution, Fault])
def test_a_refusal_of_the_path_made_while_compiling_does_not_matter(
    gachon, scene_with, monkeypatch, tmp_path, refusal: type[CdprError]
) -> None:
    """As of a short search's path near a pulley's axis, which more rounds avoid."""
    task, plan = KernelSet("optimal", (tmp_path,)), object()

    def make(rig, scene, settings, **options):
        if settings.rounds == 1:
            raise refusal("a path of one round")
        return plan

    monkeypatch.setattr(machine_code, "cache_folder", lambda *_: tmp_path)
    monkeypatch.setattr(
        planning, "planner_compilation", lambda _, listener: compilation(task, "", "", listener)
    )
    monkeypatch.setattr(planning, "make_plan", make)
    assert plan_path(gachon, scene_with(), OptimalSettings(rounds=2)) is plan
    assert is_compiled(task)
