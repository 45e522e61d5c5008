"""A first path of poses: two trees, one from each end, that grow toward samples and each other.

A move to a sample is tried whole, then half of it, then a quarter: in free space long moves are
tested as fast as short ones, and shorter ones get into gaps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.anytime_6d.problem import RotatingProblem, move_allowed, put_between, put_rotated
from planner.kernels.jit import kernel

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NODES = 4096
"""Room for nodes in each tree; a full tree grows no further but can still be joined."""
DRAWS = 9
"""Random numbers for each sample."""
_SHARES = (1.0, 0.5, 0.25)
_INSIDE = 0.5
"""Part of the samples whose position is uniform in the workspace box; most of the others lie on its
walls, edges and corners, where obstacles leave more room."""
_BETWEEN_ENDS = 0.4
"""Part of the samples whose orientation lies on the shortest rotation from start to goal."""
_OVER = 1.3
"""Tilts and turns are drawn from a range larger by this factor and clamped to the limit."""


@kernel
def connect(
    problem: RotatingProblem,
    ends: Array,
    draws: Array,
    trees: Array,
    parents: Integers,
    counts: Integers,
    tallies: Integers,
    path: Array,
) -> int:
    """Grows both trees until they meet; called again with the same trees it continues.

    Args:
        ends: Start and goal, shape (2, 7).
        draws: Random numbers in 0 … 1, a row for a sample, shape (k, DRAWS).
        trees: Nodes, shape (2, NODES, 7), written.
        parents: Shape (2, NODES), written.
        counts: Nodes in both trees, and samples so far, shape (3,); zeros at first.
        tallies: See `move_allowed`.
        path: From start to goal, shape (j, 7), written.

    Returns:
        The number of poses of the path; 0 where none was found yet.
    """
    if counts[0] == 0:
        trees[0, 0], trees[1, 0] = ends[0], ends[1]
        parents[0, 0], parents[1, 0] = -1, -1
        counts[0], counts[1] = 1, 1
        if move_allowed(problem, ends[0], ends[1], tallies):
            path[0], path[1] = ends[0], ends[1]
            return 2
    wanted, met = np.empty(7), np.empty(7)
    for k in range(len(draws)):
        counts[2] += 1
        _sample(problem, ends, draws[k], wanted)
        tree = counts[2] & 1
        new, _ = _extended(problem, trees, parents, counts, tallies, tree, wanted)
        if new < 0:
            continue
        met[:] = trees[tree, new]
        other, whole = _extended(problem, trees, parents, counts, tallies, 1 - tree, met)
        if other >= 0 and whole:
            first, second = (new, other) if tree == 0 else (other, new)
            return _joined(trees, parents, first, second, path)
    return 0


@kernel
def _sample(problem: RotatingProblem, ends: Array, draw: Array, wanted: Array) -> None:
    """Writes a pose of the workspace within the rotation limits."""
    wide = 1.0 if draw[0] < _INSIDE else 2.0
    limits = problem.world.limits
    if draw[4] < _BETWEEN_ENDS:
        put_between(ends[0], ends[1], draw[5], wanted)
    else:
        tilt = problem.tilt * min(_OVER * math.sqrt(draw[5]), 1.0)
        turn = problem.turn * min(max(_OVER * (2.0 * draw[7] - 1.0), -1.0), 1.0)
        about = 2.0 * math.pi * draw[6]
        wanted[3], wanted[4], wanted[5], wanted[6] = (
            math.cos(tilt / 2.0),
            math.sin(tilt / 2.0) * math.cos(about),
            math.sin(tilt / 2.0) * math.sin(about),
            0.0,
        )
        put_rotated(wanted.copy(), (0.0, 0.0, turn), wanted)
    for axis in range(3):
        share = min(max(0.5 + wide * (draw[1 + axis] - 0.5), 0.0), 1.0)
        wanted[axis] = limits[0, axis] + share * (limits[1, axis] - limits[0, axis])


@kernel
def _extended(
    problem: RotatingProblem,
    trees: Array,
    parents: Integers,
    counts: Integers,
    tallies: Integers,
    tree: int,
    wanted: Array,
) -> tuple[int, bool]:
    """Grows one tree toward a pose; the new node, -1 without one, and whether it is that pose."""
    nearest = _nearest(problem, trees, tree, counts[tree], wanted)
    at = trees[tree, nearest]
    if counts[tree] == NODES:
        return nearest, False
    target = trees[tree, counts[tree]]
    for share in _SHARES:
        if share == 1.0:
            target[:] = wanted
        else:
            put_between(at, wanted, share, target)
        if move_allowed(problem, at, target, tallies):
            new = counts[tree]
            parents[tree, new] = nearest
            counts[tree] = new + 1
            return new, share == 1.0
    return -1, False


@kernel
def _nearest(problem: RotatingProblem, trees: Array, tree: int, count: int, wanted: Array) -> int:
    best, least = 0, np.inf
    scale = 8.0 * problem.objective.radian**2  # an angle squared is nearly 8 (1 - |q · q'|)
    for i in range(count):
        node, squared, cosine = trees[tree, i], 0.0, 0.0
        for axis in range(3):
            squared += (node[axis] - wanted[axis]) ** 2
        for axis in range(3, 7):
            cosine += node[axis] * wanted[axis]
        squared += scale * (1.0 - abs(cosine))
        if squared < least:
            best, least = i, squared
    return best


@kernel
def _joined(trees: Array, parents: Integers, first: int, second: int, path: Array) -> int:
    """Writes the path from the first root through two nodes at one pose to the second root."""
    length, node = 0, first
    while node >= 0:
        length, node = length + 1, parents[0, node]
    other, node = 0, parents[1, second]
    while node >= 0:
        other, node = other + 1, parents[1, node]
    if length + other > len(path):
        return 0
    node = first
    for i in range(length - 1, -1, -1):
        path[i] = trees[0, node]
        node = parents[0, node]
    node = parents[1, second]
    for i in range(length, length + other):
        path[i] = trees[1, node]
        node = parents[1, node]
    return length + other
