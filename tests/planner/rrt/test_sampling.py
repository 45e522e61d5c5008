"""Samplers draw from the regions the paper describes; rates and x_c follow their readings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.rrt.sampling import (
    backward,
    direction_by_angles,
    direction_in_volume,
    failure_rate,
    focus_node,
    forward,
    goal_bias,
    new_tallies,
    record_outcome,
)
from planner.rrt.tree import add, new_tree
from planner.rrt.variants import FAILURE_RATES, FOCUSES

START, GOAL = np.array([0.18, 0.18, 0.30]), np.array([-0.18, -0.18, 0.40])
LOWER, UPPER = np.array([-0.25, -0.25, 0.15]), np.array([0.25, 0.25, 0.65])
FAR_LOWER, FAR_UPPER = np.full(3, -9.0), np.full(3, 9.0)


def drawn_forward(focus: np.ndarray, by_volume: bool, count: int, **bounds) -> np.ndarray:
    lower, upper = bounds.get("lower", FAR_LOWER), bounds.get("upper", FAR_UPPER)
    random, points = np.random.default_rng(2), np.empty((count, 3))
    for point in points:
        forward(random, START, GOAL, focus, lower, upper, by_volume, point)
    return points


@pytest.mark.parametrize("by_volume", [False, True])
def test_before_any_failure_samples_lie_on_the_line_from_goal_to_start(by_volume) -> None:
    axis = (START - GOAL) / np.linalg.norm(START - GOAL)
    offsets = drawn_forward(START, by_volume, 50) - GOAL
    along = offsets @ axis
    assert np.allclose(offsets, along[:, None] * axis, atol=1e-8)
    assert along.min() >= -1e-12
    assert along.max() <= np.linalg.norm(START - GOAL) + 1e-12


@pytest.mark.parametrize("by_volume", [False, True])
def test_forward_samples_fill_the_cone_through_the_failed_node(by_volume) -> None:
    failed = np.array([0.05, 0.20, 0.45])
    to_start, to_failed = START - GOAL, failed - GOAL
    opening = np.arccos(to_start @ to_failed / np.linalg.norm(to_start) / np.linalg.norm(to_failed))
    offsets = drawn_forward(failed, by_volume, 4000) - GOAL
    lengths = np.linalg.norm(offsets, axis=1)
    assert lengths.max() <= np.linalg.norm(to_failed) + 1e-12
    angles = np.arccos(np.clip(offsets @ to_start / lengths / np.linalg.norm(to_start), -1, 1))
    assert angles.max() <= opening + 1e-9
    assert angles.max() > 0.95 * opening
    # Uniform radii have their median at half; a cone's volume has it at the cube root of half.
    share = np.median(lengths) / np.linalg.norm(to_failed)
    assert share == pytest.approx(0.5 ** (1 / 3) if by_volume else 0.5, abs=0.03)
    if by_volume:  # as many within an angle as the cap of the sphere has area
        within = np.mean(angles < opening / 2)
        assert within == pytest.approx((1 - np.cos(opening / 2)) / (1 - np.cos(opening)), abs=0.03)
    else:
        assert np.mean(angles < opening / 2) == pytest.approx(0.5, abs=0.03)


def test_forward_samples_outside_the_bounds_are_clipped_to_them() -> None:
    points = drawn_forward(np.array([0.2, -0.2, 0.6]), False, 500, lower=LOWER, upper=UPPER)
    assert np.all(points >= LOWER)
    assert np.all(points <= UPPER)


def test_backward_samples_lie_outside_the_ball_about_the_mean_of_all_nodes() -> None:
    tree = new_tree(START, 10)
    add(tree, np.array([0.10, 0.10, 0.35]), 0, 1.0)
    centre = (START + np.array([0.10, 0.10, 0.35])) / 2
    radius = np.linalg.norm(centre - tree.points[1])
    random, point = np.random.default_rng(3), np.empty(3)
    for _ in range(200):
        backward(random, tree, tree.points[1], LOWER, UPPER, point)
        assert np.linalg.norm(point - centre) > radius
        assert np.all((point >= LOWER) & (point <= UPPER))


def test_backward_samples_stay_in_bounds_where_the_ball_fills_them() -> None:
    tree = new_tree(np.full(3, 0.4), 10)
    far, point = np.full(3, 50.0), np.empty(3)
    backward(np.random.default_rng(3), tree, far, LOWER, UPPER, point)
    assert np.all((point >= LOWER) & (point <= UPPER))


def test_half_of_the_goal_biased_samples_are_the_goal_and_the_rest_fill_the_space() -> None:
    random, points = np.random.default_rng(4), np.empty((2000, 3))
    for point in points:
        goal_bias(random, GOAL, LOWER, UPPER, point)
    at_goal = np.all(points == GOAL, axis=1)
    assert 0.46 < at_goal.mean() < 0.54
    others = points[~at_goal]
    assert np.allclose(others.mean(axis=0), (LOWER + UPPER) / 2, atol=0.02)


@settings(max_examples=30)
@given(st.integers(2, 7), st.floats(0.0, np.pi), st.integers(0, 2**32 - 1))
def test_directions_have_unit_length_and_keep_the_opening_in_any_dimension(
    size: int, opening: float, seed: int
) -> None:
    """The last line of Eq. 10 must end in a sine: with the printed cosine this fails."""
    random, point = np.random.default_rng(seed), np.empty(size)
    draws = [direction_by_angles] + ([direction_in_volume] if size > 2 else [])
    for draw in draws:
        draw(random, opening, point)
        assert np.linalg.norm(point) == pytest.approx(1.0)
        if size > 2:
            assert np.arccos(np.clip(point[0], -1, 1)) <= opening + 1e-7


EVENTS = ((0, False), (1, False), (2, True), (1, True), (0, False), (0, True), (2, False))


@pytest.mark.parametrize(
    ("reading", "expected"),
    [
        ("k/(k+1)", [1 / 2, 2 / 3, 0, 0, 1 / 2, 0, 1 / 2]),
        ("k/(k+2)", [1 / 3, 2 / 4, 0, 0, 1 / 3, 0, 1 / 3]),
        ("tree", [1 / 1, 2 / 2, 2 / 3, 2 / 4, 3 / 5, 3 / 6, 4 / 7]),
        ("node", [1 / 1, 1 / 1, 0 / 1, 1 / 2, 2 / 2, 2 / 3, 1 / 2]),
    ],
)
def test_failure_rates_follow_their_reading(reading, expected) -> None:
    tallies, number, rates = new_tallies(5), FAILURE_RATES.index(reading), []
    assert failure_rate(tallies, number) == 0.0
    for node, success in EVENTS:
        record_outcome(tallies, node, success, 0)
        rates.append(failure_rate(tallies, number))
    assert rates == pytest.approx(expected)


@pytest.mark.parametrize(
    ("reading", "expected"),
    [
        ("last-failed", [0, 1, 1, 1, 0, 0, 2]),
        ("most-failed", [0, 1, 1, 1, 0, 0, 0]),
        # Rates: 1/1; 1/1; -; node 1 falls to 1/2; node 0 has 2/2; then 2/3; node 2 gets 1/2.
        ("highest-rate", [0, 1, 1, 0, 0, 0, 0]),
    ],
)
def test_the_focus_follows_its_reading(reading, expected) -> None:
    tallies, number, nodes = new_tallies(5), FOCUSES.index(reading), []
    assert focus_node(tallies) == 0  # the root: the cone is the line to the start
    for node, success in EVENTS:
        record_outcome(tallies, node, success, number)
        nodes.append(focus_node(tallies))
    assert nodes == expected


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), max_size=60))
def test_the_highest_rate_is_what_brute_force_finds(events) -> None:
    tallies, number = new_tallies(6), FOCUSES.index("highest-rate")
    counts = np.zeros((6, 2))
    for node, success in events:
        record_outcome(tallies, node, success, number)
        counts[node] += (1, not success)
        if counts[:, 1].any():
            rates = counts[:, 1] / np.maximum(counts[:, 0], 1)
            assert rates[focus_node(tallies)] == rates.max()
