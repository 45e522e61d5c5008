"""The proof that no path exists: given for a dividing post, never where a path is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import NoSolution
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene
from planner.anytime.infeasibility import FINENESSES, flood_reaches, is_separated
from planner.anytime.path import advance, handle_of
from planner.anytime.state import new_search
from planner.check import check_path
from planner.planning import make_plan
from planner.settings import OBJECTIVES, OptimalSettings
from tests.effort import cases
from tests.planner.anytime.scenes_of_the_search import (
    best_points,
    ends_of,
    post,
    problem,
    random_question,
    searched,
)

ACROSS = {
    "start": {"position_mm": [0.0, 200.0, 400.0]},
    "goal": {"position_mm": [0.0, -200.0, 400.0]},
}


@pytest.fixture(scope="module")
def divided(scene_with):
    """A post from floor to ceiling: in its shadows from the four corners no cable can be."""
    return scene_with(post(0.0, 0.0, 0.0, 1000.0), **ACROSS)


def test_a_post_from_floor_to_ceiling_is_proved_to_separate(gachon, divided) -> None:
    asked = problem(gachon, divided)
    assert is_separated(asked.world, *ends_of(divided))
    assert is_separated(asked.world, *ends_of(divided)[::-1])
    assert not len(best_points(searched(asked, divided, 30)))


def test_positions_on_the_same_side_are_not_called_separated(gachon, divided, scene_with) -> None:
    asked = problem(gachon, divided)
    near = np.array([[0.0, 0.2, 0.4], [0.03, 0.18, 0.45]])
    assert not is_separated(asked.world, *near)
    assert not is_separated(problem(gachon, scene_with(**ACROSS)).world, *ends_of(divided))


@pytest.mark.parametrize("seed", range(cases(30, 0.4)))
def test_nothing_is_called_separated_where_a_path_is_known(gachon, seed) -> None:
    scene = random_question(gachon, 100 + seed)
    if scene is None:
        pytest.skip("these obstacles leave no two free positions")
    asked = problem(gachon, scene)
    if len(best_points(searched(asked, scene, 10, seed))):
        assert not is_separated(asked.world, *ends_of(scene))


@settings(max_examples=10)  # a world is made for each
@given(st.floats(150.0, 420.0), st.integers(0, 100))
def test_a_low_post_is_never_called_a_wall_where_a_path_leads_over_it(
    gachon, scene_with, high, seed
) -> None:
    scene = scene_with(post(0.0, 0.0, 0.0, high), **ACROSS)
    asked = problem(gachon, scene)
    if len(best_points(searched(asked, scene, 6, seed))):
        words = (len(asked.world.spans) * len(asked.world.bodies) + 63) // 64
        for cells in FINENESSES:
            assert flood_reaches(asked.world, ends_of(scene), cells, words)


def test_finer_cells_forbid_no_less(gachon, divided) -> None:
    asked = problem(gachon, divided)
    reached = [flood_reaches(asked.world, ends_of(divided), cells, 1) for cells in FINENESSES]
    assert reached == sorted(reached, reverse=True)


def test_a_proved_wall_names_what_blocks_the_path(gachon, divided) -> None:
    with pytest.raises(NoSolution) as nothing:
        make_plan(gachon, divided, OptimalSettings(rounds=12))
    message = str(nothing.value)
    assert nothing.value.exit_code == 1
    assert "there is no path without rotation: the obstacles separate start and goal" in message
    assert "10 mm clearance" in message
    assert "post at 0 0" in message
    assert nothing.value.values["proved"] == "yes"


def test_the_proof_states_that_it_holds_without_rotation(gachon) -> None:
    """A tilted platform passes below a knob that blocks the level one."""
    document = gachon.as_dict()
    document["platform"]["size_mm"] = [130, 130, 20]
    document["workspace"] = {"lower_mm": [-110, -1, 444], "upper_mm": [110, 1, 446]}
    knob = {"name": "knob", "sphere": {"radius_mm": 5}, "position_mm": [0, 69.5, 454]}
    parts = {
        "schema_version": 1,
        "name": "rail",
        "start": {"position_mm": [-100, 0, 445]},
        "goal": {"position_mm": [100, 0, 445]},
        "clearance": {"obstacle_mm": 1, "self_mm": 2},
        "obstacles": [knob],
    }
    limits = {"rotation_limits": {"tilt_deg": 20, "turn_deg": 5}}
    rig, fixed, free = (
        Rig.from_dict(document),
        Scene.from_dict(parts),
        Scene.from_dict(parts | limits),
    )
    for scene, cure in (
        (fixed, "add rotation_limits to the scene and plan with"),
        (free, "plan with"),
    ):
        with pytest.raises(NoSolution, match="no path without rotation") as nothing:
            make_plan(rig, scene, OptimalSettings(rounds=12))
        assert nothing.value.next_step.startswith(f"{cure} `free_rotation=True`")
    tilted = [math.cos(math.radians(-3.0)), math.sin(math.radians(-3.0)), 0.0, 0.0]
    path = [
        fixed.start,
        *(Pose.from_quaternion(np.array([x, 0.0, 0.445]), tilted) for x in (-0.09, 0.09)),
        fixed.goal,
    ]
    assert check_path(rig, free, path).passed


def test_a_search_that_ends_too_early_says_that_nothing_is_proved(
    gachon, scene_with, monkeypatch
) -> None:
    """Every edge is refused, by a least margin that nothing has, but no obstacle separates."""
    from planner.anytime import path as routing

    def hopeless(*args):
        asked = problem(*args[:2])
        asked.world.limits[:] = ends_of(args[1])[0] - 1e-6, ends_of(args[1])[0] + 1e-6
        return asked

    monkeypatch.setattr(routing, "problem_of", hopeless)
    with pytest.raises(NoSolution) as nothing:
        make_plan(
            gachon, scene_with(post(0.0, 0.0, 0.0, 200.0), **ACROSS), OptimalSettings(rounds=9)
        )
    message = str(nothing.value)
    assert "no path after 9 rounds" in message
    assert "it is not proved that no path exists" in message
    assert "workspace" in message
    assert "such as `rounds=100`" in message
    assert "proved" not in nothing.value.values


def test_the_gap_reported_is_the_smallest_ever_and_so_never_grows(gachon, divided) -> None:
    """The trees are begun again after some samples; those before may have come closer."""
    asked, search = problem(gachon, divided), new_search(*ends_of(divided), 0)
    ever, begun_again, nodes = search.trees.gap[0], 0, 0
    assert ever == np.linalg.norm(np.subtract(*ends_of(divided)))
    for _ in range(12):
        advance(handle_of(asked, search), 1)
        trees = search.trees
        first, second = (trees.nodes[k, : trees.counts[k]] for k in (0, 1))
        begun_again, nodes = begun_again + (len(first) < nodes), len(first)
        now = np.linalg.norm(first[:, None] - second, axis=-1).min()
        ever = min(ever, now)
        assert search.trees.gap[0] <= ever + 1e-12
        if not begun_again:
            assert search.trees.gap[0] == pytest.approx(now)
    assert begun_again
    assert ever < now, "the last trees are not the closest, else this shows nothing"


def test_a_limit_below_the_shortest_path_is_reported(gachon, ready_scene) -> None:
    settings = OptimalSettings(weights=OBJECTIVES["kinematic"], rounds=20, longest=0.6)
    with pytest.raises(NoSolution, match=r"no path of at most 600\.0 mm was found") as nothing:
        make_plan(gachon, ready_scene("environment_1"), settings)
    assert "the straight line 518.8 mm" in str(nothing.value)
    assert nothing.value.values["found_mm"] > 600.0
