"""The first path: two trees, one from each end, joined by edges of any length.

An exact test of a whole edge costs about as much as one of a point, so edges have no step length: a
sample is joined to the nearest node of one tree by one edge, and if that is allowed to the nearest
of the other. A sample that both trees reach completes the path.

Functions called for every sample are inlined: passing a problem takes as long as an edge test.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.anytime.problem import PathProblem, edge_allowed
from planner.collision.edges import row_of
from planner.kernels.jit import inlined, leaf
from planner.kernels.primitives import RandomState, Vector, minus, norm, uniform

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NODES = 2048
"""Room for nodes in each tree; a full tree grows no further but can still be joined."""
_FROM_INSIDE = 0.25
"""Part of the samples that are uniform in the workspace box."""

EDGES_TESTED, SAMPLES_DRAWN = 2, 3
"""Indices of `Trees.counts`, behind the numbers of nodes."""


class Trees(NamedTuple):
    """The trees of start and goal; kernels change them in place.

    Attributes:
        nodes: Shape (2, NODES, 3), [m].
        parents: Of each node, -1 for the root, shape (2, NODES).
        counts: Numbers of nodes in both trees, and of edge tests and samples so far, shape (4,);
            zeros at first.
        gap: The smallest distance ever between nodes of both trees, also of trees since restarted,
            shape (1,), [m].
    """

    nodes: Array
    parents: Integers
    counts: Integers
    gap: Array


@leaf
def connect(
    problem: PathProblem, ends: Array, state: RandomState, trees: Trees, samples: int, path: Array
) -> int:
    """Grows both trees until they meet; called again with the same trees it continues.

    Args:
        ends: Start and goal, shape (2, 3), [m].
        state: Of the random numbers; stepped.
        trees: Extended.
        samples: Most samples to draw.
        path: From start to goal, shape (MOST_ON_PATH, 3), written.

    Returns:
        The number of vertices of the path; 0 where none was found yet.
    """
    nodes, counts = trees.nodes, trees.counts
    if counts[0] == 0:
        _put(nodes[0], 0, row_of(ends[0]))
        _put(nodes[1], 0, row_of(ends[1]))
        trees.parents[0, 0], trees.parents[1, 0] = -1, -1
        counts[0], counts[1], counts[EDGES_TESTED] = 1, 1, counts[EDGES_TESTED] + 1
        if edge_allowed(problem, row_of(ends[0]), row_of(ends[1])):
            _put(path, 0, row_of(ends[0]))
            _put(path, 1, row_of(ends[1]))
            return 2
    for _ in range(samples):
        counts[SAMPLES_DRAWN] += 1
        wanted = _sample(problem, state)
        tree = counts[SAMPLES_DRAWN] & 1
        near = _extended(problem, trees, tree, wanted)
        if near < 0:
            continue
        far = _nearest(trees, 1 - tree, wanted)
        across = row_of(nodes[1 - tree, far])
        trees.gap[0] = min(trees.gap[0], norm(minus(across, wanted)))
        counts[EDGES_TESTED] += 1
        if edge_allowed(problem, across, wanted):
            first, second = (near, far) if tree == 0 else (far, near)
            return _joined(trees, first, wanted, second, path)
    return 0


@inlined
def _sample(problem: PathProblem, state: RandomState) -> Vector:
    """A point of the workspace, most often on its walls, edges or in its corners.

    Obstacles leave more room there: samples drawn from a box twice as wide and clamped to the walls
    see the ends 2 to 5 times as often in the paper's scenes.
    """
    wide = 1.0 if uniform(state) < _FROM_INSIDE else 2.0
    limits = problem.world.limits
    return (
        _drawn(state, wide, limits[0, 0], limits[1, 0]),
        _drawn(state, wide, limits[0, 1], limits[1, 1]),
        _drawn(state, wide, limits[0, 2], limits[1, 2]),
    )


@inlined
def _drawn(state: RandomState, wide: float, low: float, high: float) -> float:
    share = 0.5 + wide * (uniform(state) - 0.5)
    return low + min(max(share, 0.0), 1.0) * (high - low)


@inlined
def _extended(problem: PathProblem, trees: Trees, tree: int, wanted: Vector) -> int:
    """Grows one tree to a point: the node whose edge to the point is allowed, or -1."""
    nearest, counts = _nearest(trees, tree, wanted), trees.counts
    at = row_of(trees.nodes[tree, nearest])
    counts[EDGES_TESTED] += 1
    if not edge_allowed(problem, at, wanted):
        return -1
    if counts[tree] < NODES:
        new = counts[tree]
        _put(trees.nodes[tree], new, wanted)
        trees.parents[tree, new] = nearest
        counts[tree] = new + 1
    return nearest


@inlined
def _nearest(trees: Trees, tree: int, wanted: Vector) -> int:
    nodes = trees.nodes
    best, least = 0, np.inf
    for i in range(trees.counts[tree]):
        x, y, z = (
            nodes[tree, i, 0] - wanted[0],
            nodes[tree, i, 1] - wanted[1],
            nodes[tree, i, 2] - wanted[2],
        )
        squared = x * x + y * y + z * z
        if squared < least:
            best, least = i, squared
    return best


@leaf
def _joined(trees: Trees, first: int, between: Vector, second: int, path: Array) -> int:
    """Writes the path from the first root through a point to the second; 0 if it does not fit."""
    nodes, parents = trees.nodes, trees.parents
    length, node = 0, first
    while node >= 0:
        length, node = length + 1, parents[0, node]
    other, node = 0, second
    while node >= 0:
        other, node = other + 1, parents[1, node]
    if length + other + 1 > len(path):
        return 0
    node = first
    for i in range(length - 1, -1, -1):
        _put(path, i, row_of(nodes[0, node]))
        node = parents[0, node]
    _put(path, length, between)
    node = second
    for i in range(length + 1, length + 1 + other):
        _put(path, i, row_of(nodes[1, node]))
        node = parents[1, node]
    return length + 1 + other


@inlined
def _put(points: Array, index: int, point: Vector) -> None:
    points[index, 0], points[index, 1], points[index, 2] = point
