"""RRTConnect as in OMPL, compiled and with our edge test: no call from Python is counted.

Source: Kuffner & LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000;
in OMPL's form: steps of at most a range, and the other tree is extended until it is stopped.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.anytime.problem import PathProblem, edge_allowed
from planner.anytime.state import Handle
from planner.collision.edges import row_of
from planner.kernels.jit import inlined, kernel, leaf
from planner.kernels.primitives import RandomState, Vector, along, minus, norm, seeded, uniform

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_NODES = 50_000
_MANY, _MOST_SAMPLES = 2000, 100_000
_STOPPED, _ADVANCED, _REACHED = 0, 1, 2


class Trees(NamedTuple):
    """Both trees, that of the start first.

    Attributes:
        nodes: Shape (2, _NODES, 3), [m].
        counts: Nodes in both, and which one is extended next, shape (3,).
        state: Of the random numbers.
    """

    nodes: Array
    counts: Integers
    state: RandomState


def new_trees(start: Array, goal: Array, seed: int) -> Trees:
    """Trees of a start and a goal, shape (3,), [m]."""
    nodes = np.zeros((2, _NODES, 3))
    nodes[0, 0], nodes[1, 0] = start, goal
    return Trees(nodes, np.array([1, 1, 0]), seeded(seed))


@kernel
def trees_handle(problem: PathProblem, trees: Trees) -> Handle:
    """Both as one reference.

    Not by `planner.anytime.path.handle_of`: its cached code would then name a type of this module.
    """
    return Handle(problem, trees)


@kernel
def trees_met(handle: Handle, longest: float, samples: int) -> bool:
    """`connected`, with the problem and the trees as one reference."""
    return connected(handle.problem, handle.search, longest, samples)


@leaf
def connected(problem: PathProblem, trees: Trees, longest: float, samples: int) -> bool:
    """Draws at most ``samples``; whether the trees have met. ``longest`` step in [m]."""
    limits, counts = problem.world.limits, trees.counts
    for _ in range(samples):
        wanted = (
            limits[0, 0] + uniform(trees.state) * (limits[1, 0] - limits[0, 0]),
            limits[0, 1] + uniform(trees.state) * (limits[1, 1] - limits[0, 1]),
            limits[0, 2] + uniform(trees.state) * (limits[1, 2] - limits[0, 2]),
        )
        tree = counts[2]
        counts[2] = 1 - tree
        if _extended(problem, trees, tree, wanted, longest) == _STOPPED:
            continue
        new = row_of(trees.nodes[tree, counts[tree] - 1])
        found = _ADVANCED
        while found == _ADVANCED:
            found = _extended(problem, trees, 1 - tree, new, longest)
        if found == _REACHED:
            return True
    return False


def mean_first_us(problem: PathProblem, start: Array, goal: Array, longest: float) -> float:
    """Mean processor time until the trees meet, [µs]; arguments as of `connected`."""
    trees = new_trees(start, goal, 0)
    _many(problem, trees, longest, 1)
    begin = time.process_time()
    found = _many(problem, trees, longest, _MANY)
    spent = time.process_time() - begin
    return spent / _MANY * 1e6 if found == _MANY else np.inf


@leaf
def _many(problem: PathProblem, trees: Trees, longest: float, times: int) -> int:
    found = 0
    for _ in range(times):
        trees.counts[0], trees.counts[1], trees.counts[2] = 1, 1, 0
        if connected(problem, trees, longest, _MOST_SAMPLES):
            found += 1
    return found


@inlined
def _extended(problem: PathProblem, trees: Trees, tree: int, wanted: Vector, longest: float) -> int:
    nodes, counts = trees.nodes[tree], trees.counts
    if counts[tree] == len(nodes):
        return _STOPPED
    best, least = 0, np.inf
    for i in range(counts[tree]):
        x, y, z = nodes[i, 0] - wanted[0], nodes[i, 1] - wanted[1], nodes[i, 2] - wanted[2]
        squared = x * x + y * y + z * z
        if squared < least:
            best, least = i, squared
    at = row_of(nodes[best])
    delta = minus(wanted, at)
    distance = norm(delta)
    to = wanted if distance <= longest else along(at, delta, longest / distance)
    if not edge_allowed(problem, at, to):
        return _STOPPED
    new = counts[tree]
    nodes[new, 0], nodes[new, 1], nodes[new, 2] = to
    counts[tree] = new + 1
    return _REACHED if distance <= longest else _ADVANCED
