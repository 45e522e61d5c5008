"""The path through the lattice against Dijkstra's algorithm of SciPy over the same edges."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from planner.anytime.lattice_path import lattice_path
from planner.anytime.problem import edge_allowed, interpolated
from planner.kernels.primitives import seeded
from planner.settings import OBJECTIVES
from tests.planner.anytime.scenes_of_the_search import ends_of, problem

STRIDE = 4


def lattice_points(asked, stride):
    """Lattice points with those on all walls, their costs, and their numbers along the axes."""
    shape = asked.kinematic.shape
    axes = [sorted({*range(0, n, stride), n - 1}) for n in shape]
    numbers = np.array(list(product(*axes)))
    ranks = np.array(list(product(*(range(len(a)) for a in axes))))
    points = asked.grid[0] + numbers * asked.grid[1]
    return points, asked.kinematic[tuple(numbers.T)], ranks


def cheapest(asked, ends, name):
    """Cost of the cheapest path by SciPy: all neighbours joined, ends to points two steps away."""
    points, costs, ranks = lattice_points(asked, STRIDE)
    price = (lambda c: 1.0 + 0.0 * c) if name == "length" else (lambda c: c)
    count = len(points)
    rows, columns, weights = [], [], []

    def join(a, b, at_a, at_b, price_a, price_b):
        if edge_allowed(asked, tuple(at_a), tuple(at_b)):
            rows.append(a)
            columns.append(b)
            weights.append((price_a + price_b) / 2.0 * np.linalg.norm(at_b - at_a))

    where = {tuple(rank): n for n, rank in enumerate(ranks.tolist())}
    for n, rank in enumerate(ranks.tolist()):
        for step in product((-1, 0, 1), repeat=3):
            other = where.get(tuple(np.add(rank, step)))
            if other is not None and other > n:
                join(n, other, points[n], points[other], price(costs[n]), price(costs[other]))
    for k, end in enumerate(ends):
        here = price(interpolated(asked.grid, asked.kinematic, tuple(end)))
        away = np.abs(points - end) / (STRIDE * asked.grid[1])
        if k == 0:  # the start's lattice point is rounded to, then two steps are taken
            middle = np.floor((end - asked.grid[0]) / (STRIDE * asked.grid[1]) + 0.5)
            near = np.abs(ranks - middle).max(axis=1) <= 2
        else:
            near = away.max(axis=1) <= 2.5
        for n in np.flatnonzero(near):
            join(count + k, n, end, points[n], here, price(costs[n]))
    size = count + 2
    graph = coo_array((weights, (rows, columns)), shape=(size, size)).tocsr()
    return dijkstra(graph, directed=False, indices=count)[count + 1]


@pytest.mark.parametrize("name", ["length", "kinematic"])
@pytest.mark.parametrize("number", [1, 3])
def test_it_is_as_cheap_as_the_cheapest_path_by_scipy(gachon, ready_scene, number, name) -> None:
    scene = ready_scene(f"environment_{number}")
    asked, ends = problem(gachon, scene, OBJECTIVES[name]), ends_of(scene)
    points, counts = np.zeros((128, 3)), np.zeros(2, dtype=np.int64)
    found = lattice_path(asked, ends, seeded(1), STRIDE, 0.0, points, counts)
    path = points[:found]
    assert np.array_equal(path[[0, -1]], ends)
    assert all(edge_allowed(asked, tuple(a), tuple(b)) for a, b in pairwise(path))
    price = np.ones(found)
    if name == "kinematic":
        price = np.array([interpolated(asked.grid, asked.kinematic, tuple(p)) for p in path])
    cost = ((price[1:] + price[:-1]) / 2.0 * np.linalg.norm(np.diff(path, axis=0), axis=1)).sum()
    assert cost == pytest.approx(cheapest(asked, ends, name), rel=1e-12)
    assert counts[1] > 0


def test_raised_costs_give_other_paths_that_are_allowed(gachon, ready_scene) -> None:
    scene = ready_scene("environment_1")
    asked, ends, state = problem(gachon, scene), ends_of(scene), seeded(2)
    seen = set()
    for _ in range(6):
        points, counts = np.zeros((128, 3)), np.zeros(2, dtype=np.int64)
        found = lattice_path(asked, ends, state, 2, 1.0, points, counts)
        path = points[:found]
        pairs = pairwise(path)
        assert all(edge_allowed(asked, tuple(a), tuple(b)) for a, b in pairs)
        seen.add(path.tobytes())
    assert len(seen) > 3


def test_a_path_that_does_not_fit_is_none(gachon, ready_scene) -> None:
    scene = ready_scene("environment_1")
    asked, counts = problem(gachon, scene), np.zeros(2, dtype=np.int64)
    assert lattice_path(asked, ends_of(scene), seeded(1), 1, 0.0, np.zeros((3, 3)), counts) == 0
