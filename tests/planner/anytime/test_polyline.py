"""Changes of a path: what is stored stays true, ends stay, and only cheaper ones are made."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner.anytime.local_search import PathChange, cost_of, measure, polish, replace
from planner.anytime.problem import CAPACITY, CLEARANCE, VERTEX, edge_allowed, edge_cost
from planner.costs import KinematicCost
from planner.kernels.primitives import seeded
from planner.settings import OBJECTIVES, Weights
from tests.planner.anytime.scenes_of_the_search import ends_of, polyline, problem, searched

MIXED = Weights(length=1.0, kinematic=0.5, clearance=0.5, capacity=1e-3)


@pytest.fixture(scope="module")
def asked(gachon, ready_scene):
    scene = ready_scene("environment_2")
    return {
        "scene": scene,
        **{name: problem(gachon, scene, weights) for name, weights in OBJECTIVES.items()},
        "mixed": problem(gachon, scene, MIXED),
    }


def first_path(asked, name, seed):
    search = searched(asked[name], asked["scene"], 1, seed)
    return search.first[: search.totals[4]].copy()


@pytest.mark.parametrize("name", ["length", "kinematic", "clearance", "capacity", "mixed"])
def test_polishing_keeps_ends_and_limits_and_knows_its_cost(asked, name) -> None:
    question = asked[name]
    line = polyline(first_path(asked, name, 4))
    cost = measure(question, line)
    question.terms[VERTEX] = 0.0
    for seed in range(12):
        polish(question, line, seeded(seed), 50)
        points = line.points[: line.counts[0]]
        assert np.array_equal(points[[0, -1]], ends_of(asked["scene"]))
        now = cost_of(question, line)
        assert now <= cost + 1e-12
        cost = now
        edges = list(itertools.pairwise(points))
        assert all(edge_allowed(question, tuple(a), tuple(b)) for a, b in edges)
    assert measure(question, polyline(points)) == pytest.approx(cost, abs=1e-12)


def test_the_cost_of_a_path_is_that_of_its_parts(asked) -> None:
    question = asked["mixed"]
    points = first_path(asked, "mixed", 2)
    halves = np.repeat(points, 2, axis=0)[:-1]
    halves[1::2] = (points[1:] + points[:-1]) / 2.0
    whole, parts = measure(question, polyline(points)), measure(question, polyline(halves))
    assert parts == pytest.approx(whole, rel=2e-3)  # sampled at other positions


def test_the_length_is_the_length(asked) -> None:
    points = first_path(asked, "length", 2)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert measure(asked["length"], polyline(points)) == pytest.approx(length, rel=1e-12)


def test_the_kinematic_integral_agrees_with_its_definition(asked, gachon) -> None:
    points, cost = first_path(asked, "kinematic", 2), KinematicCost(gachon, np.eye(3))
    for a, b in itertools.pairwise(points):
        got = edge_cost(asked["kinematic"], tuple(a), tuple(b))
        assert got == pytest.approx(cost.edge(a, b), rel=5e-3)


@given(st.integers(0, 10_000), st.integers(0, 2), st.integers(0, 99), st.integers(0, 99))
def test_a_change_is_made_when_it_saves_and_is_allowed_and_never_else(
    asked, seed, number, somewhere, further
) -> None:
    question = asked["length"]
    assert question.terms[CLEARANCE] == question.terms[CAPACITY] == 0.0
    question.terms[VERTEX] = 0.0
    points = first_path(asked, "length", 5)
    line = polyline(points)
    before = measure(question, line)
    first = somewhere % (len(points) - 1)
    last = first + 1 + further % (len(points) - 1 - first)
    rng = np.random.default_rng(seed)
    new = np.linspace(points[first], points[last], 4)[1 : 1 + number]
    new = new + rng.normal(scale=rng.choice([0.0, 0.01, 0.1]), size=(number, 3))
    wanted = np.concatenate([points[: first + 1], new, points[last:]])
    one, two = [tuple(p) for p in [*new, *np.zeros((2, 3))][:2]]
    done = replace(question, line, PathChange(first, last, number, one, two, False))
    parts = np.concatenate([points[first : first + 1], new, points[last : last + 1]])
    allowed = all(edge_allowed(question, tuple(a), tuple(b)) for a, b in itertools.pairwise(parts))
    saved = before - np.linalg.norm(np.diff(wanted, axis=0), axis=1).sum()
    if abs(saved) > 1e-12:
        assert done == (allowed and saved > 0.0)
    assert np.array_equal(line.points[: line.counts[0]], wanted if done else points)
    assert cost_of(question, line) == pytest.approx(before - (saved if done else 0.0), abs=1e-12)


def test_a_full_path_takes_no_more_vertices(asked) -> None:
    points = first_path(asked, "length", 5)
    line = polyline(points)._replace(points=points.copy())
    measure(asked["length"], line)
    detour = tuple(points[0]), tuple(points[1])
    assert not replace(asked["length"], line, PathChange(0, 1, 2, *detour, False))
    assert np.array_equal(line.points, points)
