"""Samplers draw from the regions the paper describes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner.sampling import AdaptiveSample, GoalBias, hypersphere_point
from planner.space import TranslationSpace
from planner.tree import Tree

START, GOAL = np.array([0.18, 0.18, 0.30]), np.array([-0.18, -0.18, 0.40])


@pytest.fixture
def space(gachon) -> TranslationSpace:
    return TranslationSpace(gachon, np.eye(3))


def test_before_any_failure_samples_lie_on_the_line_from_goal_to_start(space) -> None:
    sampler, tree = AdaptiveSample(space, START, GOAL, np.random.default_rng(1)), Tree(START)
    axis = (START - GOAL) / np.linalg.norm(START - GOAL)
    for _ in range(50):
        offset = sampler.draw(tree) - GOAL
        assert np.allclose(offset, (offset @ axis) * axis, atol=1e-12)
        assert -1e-12 <= offset @ axis <= np.linalg.norm(START - GOAL) + 1e-12


def test_forward_samples_lie_in_the_cone_through_the_failed_node(space) -> None:
    tree = Tree(START)
    failed = tree.add(np.array([0.05, 0.20, 0.45]), 0, 1.0)
    sampler = AdaptiveSample(space, START, GOAL, np.random.default_rng(2))
    sampler.tell(failed, False)
    sampler.tell(0, True)  # forward again, the cone stays open
    to_start, to_failed = START - GOAL, tree.points[failed] - GOAL
    cosine = to_start @ to_failed / np.linalg.norm(to_start) / np.linalg.norm(to_failed)
    widest = 0.0
    for _ in range(300):
        offset = sampler.draw(tree) - GOAL
        length = np.linalg.norm(offset)
        assert length <= np.linalg.norm(to_failed) + 1e-12
        angle = np.arccos(np.clip(offset @ to_start / length / np.linalg.norm(to_start), -1, 1))
        assert angle <= np.arccos(cosine) + 1e-9
        widest = max(widest, angle)
    assert widest > 0.8 * np.arccos(cosine)


def test_backward_samples_lie_outside_the_ball_about_the_tree(space) -> None:
    tree = Tree(START)
    failed = tree.add(np.array([0.10, 0.10, 0.35]), 0, 1.0)
    sampler = AdaptiveSample(space, START, GOAL, np.random.default_rng(3))
    for _ in range(10**4):
        sampler.tell(failed, False)  # a failure rate near 1: backward practically always
    centre = tree.points.mean(axis=0)
    radius = np.linalg.norm(centre - tree.points[failed])
    for _ in range(200):
        point = sampler.draw(tree)
        assert np.linalg.norm(point - centre) > radius
        assert np.all(point >= space.lower)
        assert np.all(point <= space.upper)


def test_failure_rate_counts_failures_since_the_last_success(space) -> None:
    sampler = AdaptiveSample(space, START, GOAL, np.random.default_rng(0))
    rates = []
    for success in (False, False, False, True, False):
        sampler.tell(0, success)
        rates.append(sampler.failure_rate)
    assert rates == [1 / 2, 2 / 3, 3 / 4, 0.0, 1 / 2]


def test_half_of_the_goal_biased_samples_are_the_goal(space) -> None:
    sampler, tree = GoalBias(space, GOAL, np.random.default_rng(4)), Tree(START)
    share = np.mean([np.array_equal(sampler.draw(tree), GOAL) for _ in range(2000)])
    assert 0.46 < share < 0.54


@given(st.lists(st.floats(-7, 7), min_size=1, max_size=5))
def test_hyperspherical_points_have_unit_length_in_any_dimension(angles: list[float]) -> None:
    point = hypersphere_point(np.array(angles))
    assert len(point) == len(angles) + 1
    assert np.linalg.norm(point) == pytest.approx(1.0)
