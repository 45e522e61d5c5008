"""Post-processing: never through an obstacle, never costlier, same ends; a disc in a plane."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.rrt.path import LengthCost, cheapest_through, pull_tight

COST = LengthCost()


def is_free(a: np.ndarray, b: np.ndarray) -> bool:
    """Outside a disc of radius 0.3 about the origin, decided exactly."""
    along = b - a
    size = along @ along
    t = np.clip(-(a @ along) / size, 0.0, 1.0) if size else 0.0
    return float(np.linalg.norm(a + t * along)) >= 0.3


def length(path: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def wandering_path(seed: int) -> np.ndarray:
    """A free path of many nodes from left to right of the disc."""
    rng = np.random.default_rng(seed)
    path, goal = [np.array([-0.5, 0.0])], np.array([0.5, 0.0])
    while len(path) < 200:
        if len(path) > 10 and is_free(path[-1], goal):
            return np.array([*path, goal])
        step = path[-1] + rng.normal(0.02, 0.08, 2)
        if is_free(path[-1], step):
            path.append(step)
    angles = np.linspace(np.pi, 0.0, 40)
    return 0.5 * np.column_stack([np.cos(angles), np.sin(angles)])


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_every_step_keeps_ends_and_freedom_and_never_costs_more(seed: int) -> None:
    path = wandering_path(seed)
    for made in (
        cheapest_through(path, is_free, COST, 0.05),
        pull_tight(path, is_free, COST),
    ):
        assert np.array_equal(made[0], path[0])
        assert np.array_equal(made[-1], path[-1])
        assert all(is_free(a, b) for a, b in pairwise(made))
        assert length(made) <= length(path) + 1e-9


def test_drawing_tight_comes_within_two_percent_of_the_shortest_path() -> None:
    angles = np.linspace(np.pi, 0.0, 30)
    path = 0.5 * np.column_stack([np.cos(angles), np.sin(angles)])
    tight = path
    for _ in range(2):
        tight = pull_tight(cheapest_through(tight, is_free, COST, 0.03), is_free, COST)
    # Two tangents to the disc and the arc between them.
    tangent = np.sqrt(0.5**2 - 0.3**2)
    shortest = 2 * tangent + 0.3 * (np.pi - 2 * np.arccos(0.3 / 0.5))
    assert length(tight) == pytest.approx(shortest, rel=0.02)
