"""The tree keeps costs true to its edges however it is rewired."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from planner.tree import ROOT, Tree


def edge(tree: Tree, a: int, b: int) -> float:
    return float(np.linalg.norm(tree.points[a] - tree.points[b]))


@given(st.integers(0, 2**32 - 1))
def test_costs_are_the_sums_of_edges_after_any_rewiring(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = Tree(rng.uniform(size=3))
    for _ in range(300):  # more than the arrays first hold
        parent = int(rng.integers(tree.count))
        point = rng.uniform(size=3)
        tree.add(point, parent, tree.costs[parent] + np.linalg.norm(point - tree.points[parent]))
    for _ in range(50):
        node, parent = (int(k) for k in rng.integers(1, tree.count, 2))
        above = parent
        while above not in (ROOT, node):
            above = int(tree.parents[above])
        if above == ROOT:  # the parent is not below the node
            tree.move(node, parent, float(tree.costs[parent]) + edge(tree, node, parent))
    for node in range(1, tree.count):
        parent = int(tree.parents[node])
        assert abs(tree.costs[node] - tree.costs[parent] - edge(tree, node, parent)) < 1e-9


@given(st.integers(0, 2**32 - 1))
def test_nearest_and_within_agree_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = Tree(rng.uniform(size=2))
    for _ in range(40):
        tree.add(rng.uniform(size=2), 0, 0.0)
    point = rng.uniform(size=2)
    distances = np.linalg.norm(tree.points - point, axis=1)
    assert distances[tree.nearest(point)] == distances.min()
    assert set(tree.within(point, 0.3).tolist()) == set(np.flatnonzero(distances <= 0.3).tolist())


def test_the_way_to_a_node_runs_from_the_root() -> None:
    tree = Tree(np.zeros(3))
    first = tree.add(np.ones(3), 0, 1.0)
    second = tree.add(2 * np.ones(3), first, 2.0)
    assert tree.way_to(second).tolist() == [[0] * 3, [1] * 3, [2] * 3]
