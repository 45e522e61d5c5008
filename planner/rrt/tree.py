"""The search tree as plain arrays: nodes, parents, costs, and children as linked lists."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.kernels.jit import kernel

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

ROOT = -1


class Tree(NamedTuple):
    """A tree of points in an n-dimensional space, with room for a fixed number of nodes.

    Attributes:
        size: Number of nodes, shape (1,); node 0 is the root.
        points: Shape (capacity, n).
        parents: Of each node, -1 for the root, shape (capacity,).
        costs: From the root to each node, shape (capacity,).
        links: First child and next sibling of each node, -1 for none, shape (capacity, 2).
        total: Sum of all points, shape (n,).
    """

    size: Integers
    points: Array
    parents: Integers
    costs: Array
    links: Integers
    total: Array


def new_tree(root: Array, capacity: int) -> Tree:
    """A tree of one node at ``root``, shape (n,), with room for ``capacity`` nodes."""
    tree = Tree(
        size=np.ones(1, dtype=np.int64),
        points=np.empty((capacity, len(root))),
        parents=np.empty(capacity, dtype=np.int64),
        costs=np.empty(capacity),
        links=np.empty((capacity, 2), dtype=np.int64),
        total=np.array(root, dtype=np.float64),
    )
    tree.points[0], tree.parents[0], tree.costs[0], tree.links[0] = root, ROOT, 0.0, ROOT
    return tree


@kernel
def squared_distance(points: Array, node: int, point: Array) -> float:
    """Squared distance of a node to a point, shape (n,)."""
    total = 0.0
    for axis in range(len(point)):
        away = points[node, axis] - point[axis]
        total += away * away
    return total


@kernel
def nearest(tree: Tree, point: Array) -> int:
    """The node nearest to a point, shape (n,)."""
    points, size = tree.points, tree.size[0]
    best, least = 0, np.inf
    for node in range(size):
        away = squared_distance(points, node, point)
        if away < least:
            best, least = node, away
    return best


@kernel
def within(tree: Tree, point: Array, radius: float, found: Integers) -> int:
    """Writes the nodes within ``radius`` of a point to ``found``; returns their number."""
    points, size, count = tree.points, tree.size[0], 0
    for node in range(size):
        if squared_distance(points, node, point) <= radius * radius:
            found[count] = node
            count += 1
    return count


@kernel
def add(tree: Tree, point: Array, parent: int, cost: float) -> int:
    """Adds a node and returns its index; ``cost`` is from the root."""
    node = tree.size[0]
    tree.points[node] = point
    tree.total[:] += point
    tree.costs[node] = cost
    tree.links[node, 0] = ROOT
    _hang(tree, node, parent)
    tree.size[0] = node + 1
    return node  # type: ignore[no-any-return]


@kernel
def move(tree: Tree, node: int, parent: int, cost: float) -> None:
    """Gives a node another parent and propagates the change of cost to all its descendants."""
    links, old = tree.links, tree.parents[node]
    if links[old, 0] == node:
        links[old, 0] = links[node, 1]
    else:
        before = links[old, 0]
        while links[before, 1] != node:
            before = links[before, 1]
        links[before, 1] = links[node, 1]
    _hang(tree, node, parent)
    change = cost - tree.costs[node]
    current = node
    while True:
        tree.costs[current] += change
        if links[current, 0] != ROOT:
            current = links[current, 0]
            continue
        while current != node and links[current, 1] == ROOT:
            current = tree.parents[current]
        if current == node:
            return
        current = links[current, 1]


@kernel
def _hang(tree: Tree, node: int, parent: int) -> None:
    tree.parents[node] = parent
    tree.links[node, 1] = tree.links[parent, 0]
    tree.links[parent, 0] = node


@kernel
def nodes_to(tree: Tree, node: int) -> Integers:
    """The nodes from the root to ``node``, shape (k,)."""
    count, current = 1, node
    while tree.parents[current] != ROOT:
        current = tree.parents[current]
        count += 1
    path = np.empty(count, dtype=np.int64)
    current = node
    for k in range(count - 1, -1, -1):
        path[k] = current
        current = tree.parents[current]
    return path
