"""The tree keeps costs true to its edges however it is rewired."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from planner.rrt.tree import ROOT, Tree, add, move, nearest, new_tree, nodes_to, within


def edge(tree: Tree, a: int, b: int) -> float:
    return float(np.linalg.norm(tree.points[a] - tree.points[b]))


def grown(rng: np.random.Generator, nodes: int, dimension: int = 3) -> Tree:
    tree = new_tree(rng.uniform(size=dimension), nodes)
    for node in range(1, nodes):
        parent, point = int(rng.integers(node)), rng.uniform(size=dimension)
        cost = tree.costs[parent] + np.linalg.norm(point - tree.points[parent])
        add(tree, point, parent, cost)
    return tree


def children_by_links(tree: Tree, node: int) -> set[int]:
    found, child = set(), int(tree.links[node, 0])
    while child != ROOT:
        found.add(child)
        child = int(tree.links[child, 1])
    return found


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_costs_and_children_stay_true_after_any_rewiring(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = grown(rng, 80)
    for _ in range(60):
        node, parent = (int(k) for k in rng.integers(1, 80, 2))
        above = parent
        while above not in (ROOT, node):
            above = int(tree.parents[above])
        if above == ROOT:  # the parent is not below the node
            move(tree, node, parent, float(tree.costs[parent]) + edge(tree, node, parent))
    for node in range(1, 80):
        parent = int(tree.parents[node])
        assert abs(tree.costs[node] - tree.costs[parent] - edge(tree, node, parent)) < 1e-9
    for node in range(80):
        assert children_by_links(tree, node) == set(np.flatnonzero(tree.parents == node).tolist())


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6))
def test_nearest_within_and_mean_agree_with_brute_force(seed: int, dimension: int) -> None:
    rng = np.random.default_rng(seed)
    tree = grown(rng, 40, dimension)
    point, found = rng.uniform(size=dimension), np.empty(40, dtype=np.int64)
    distances = np.linalg.norm(tree.points - point, axis=1)
    assert distances[nearest(tree, point)] == distances.min()
    count = within(tree, point, 0.5, found)
    assert found[:count].tolist() == np.flatnonzero(distances <= 0.5).tolist()
    assert np.allclose(tree.total / tree.size[0], tree.points.mean(axis=0))


def test_the_path_to_a_node_runs_from_the_root() -> None:
    tree = new_tree(np.zeros(3), 4)
    first = add(tree, np.ones(3), 0, 1.0)
    add(tree, np.full(3, 5.0), 0, 1.0)
    second = add(tree, 2 * np.ones(3), first, 2.0)
    assert tree.points[nodes_to(tree, second)].tolist() == [[0] * 3, [1] * 3, [2] * 3]
