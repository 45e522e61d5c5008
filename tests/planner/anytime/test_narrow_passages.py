"""Gaps down to a fifth of a millimetre, from the suite that is measured against OMPL's planners."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from benchmarks.planner.passages import Passage, passages
from model.errors import NoSolution
from model.pose import Pose
from planner.anytime.path import advance, best_path, handle_of, optimal_route
from planner.anytime.problem import PathProblem, problem_of
from planner.anytime.state import new_search
from planner.check import check_path
from planner.costs import KinematicCost
from planner.edge_checks import FREE, ExactChecks
from planner.settings import CLEARANCE_RESERVE, OptimalSettings, Weights

SUITE = passages()
NARROWEST = [passage for passage in SUITE if passage.gap < 0.0003]
ROUNDS = 4


def problem(passage: Passage) -> PathProblem:
    cost = KinematicCost(passage.rig, passage.scene.start.rotation)
    return problem_of(passage.rig, passage.scene, Weights(length=1.0), cost)


def found(passage: Passage, seed: int) -> np.ndarray | None:
    search = new_search(passage.path[0], passage.path[-1], seed)
    advance(handle_of(problem(passage), search), ROUNDS)
    return best_path(search)


def name(passage: Passage) -> str:
    return passage.scene.name


@pytest.mark.parametrize("passage", SUITE, ids=name)
def test_every_passage_has_a_path_and_less_room_leaves_none_of_it(passage: Passage) -> None:
    asked = {"self_clearance": 0.005, "margin_reserve": 0.0}
    for room, is_free in ((0.0, True), (0.55 * passage.gap, False)):
        clearance = passage.scene.obstacle_clearance + CLEARANCE_RESERVE + room
        checks = ExactChecks(
            passage.rig, passage.scene, np.eye(3), obstacle_clearance=clearance, **asked
        )
        problems = [checks.problem(start, end) for start, end in pairwise(passage.path)]
        assert (set(problems) == {FREE}) == is_free


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("passage", SUITE, ids=name)
def test_a_path_is_found_in_the_first_rounds(passage: Passage, seed: int) -> None:
    assert found(passage, seed) is not None


@pytest.mark.parametrize("passage", NARROWEST, ids=name)
def test_paths_through_gaps_pass_the_check_and_follow_from_the_seed(passage: Passage) -> None:
    path = found(passage, 5)
    assert path is not None
    assert check_path(passage.rig, passage.scene, [Pose.level(point) for point in path]).passed
    again = found(passage, 5)
    assert again is not None
    assert np.array_equal(path, again)


def test_a_gap_that_is_closed_is_not_gone_through() -> None:
    passage = next(p for p in NARROWEST if p.name == "window")
    closed = passage.scene.changed(clearance=passage.scene.obstacle_clearance + 0.00011)
    cost = KinematicCost(passage.rig, np.eye(3))
    with pytest.raises(NoSolution):
        optimal_route(passage.rig, closed, OptimalSettings(rounds=6), cost)
