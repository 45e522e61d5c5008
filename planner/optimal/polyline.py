"""A path under improvement, and the one way in which it is ever changed.

Everything that makes a path better asks for some of its vertices to be replaced by none, one or
two others. The change is made when it makes the path cheaper and every new edge is allowed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import leaf
from planner.exact.edge import row_of
from planner.exact.vectors import Vector
from planner.optimal.problem import (
    CAPACITY,
    CLEARANCE,
    VERTEX,
    Problem,
    edge_allowed,
    edge_cost,
    edge_lows,
    gained,
)

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_VERTICES = 128
"""Room for the vertices of a path."""
_ROUND_OFF = 1e-13


class Change(NamedTuple):
    """Vertices to be replaced, and by what.

    Attributes:
        first: Number of the vertex before those that go.
        last: Number of the vertex after them.
        number: How many come in their place, 0, 1 or 2.
        one: The first of them, [m].
        two: The second of them, [m].
        ends_known: Whether the edges to ``one`` and from ``two`` are parts of present edges.
    """

    first: int
    last: int
    number: int
    one: Vector
    two: Vector
    ends_known: bool


class Polyline(NamedTuple):
    """A path of allowed edges; kernels change it in place.

    Attributes:
        points: Vertices, start and goal included, shape (MOST_VERTICES, 3), [m].
        edges: Of each edge, by its first vertex, what it adds to the sums in the cost, its
            smallest clearance [m] and margin [N] (infinite where they have no weight), shape
            (MOST_VERTICES, 3).
        counts: Vertices, and edge tests so far, shape (2,).
    """

    points: Array
    edges: Array
    counts: Integers


def polyline_of(points: Array) -> Polyline:
    """A polyline of vertices, shape (k, 3), [m], not measured and with no room for more."""
    return Polyline(points.copy(), np.zeros((len(points), 3)), np.array([len(points), 0]))


@leaf
def measure(problem: Problem, line: Polyline) -> float:
    """Fills in what the edges are worth, and gives the cost of the whole path."""
    for i in range(line.counts[0] - 1):
        start, end = row_of(line.points[i]), row_of(line.points[i + 1])
        clearance, margin = edge_lows(problem, start, end)
        line.edges[i, 0] = edge_cost(problem, start, end)
        line.edges[i, 1], line.edges[i, 2] = clearance, margin
    return cost_of(problem, line)


@leaf
def cost_of(problem: Problem, line: Polyline) -> float:
    """The cost of the whole path, its edges being measured."""
    total, clearance, margin = 0.0, math.inf, math.inf
    for i in range(line.counts[0] - 1):
        total += line.edges[i, 0]
        clearance = min(clearance, line.edges[i, 1])
        margin = min(margin, line.edges[i, 2])
    return total - gained(problem, clearance, margin)


@leaf
def replace(problem: Problem, line: Polyline, change: Change) -> bool:
    """Makes a change, if it makes the path cheaper and every new edge is allowed."""
    added = change.number - (change.last - change.first - 1)
    if line.counts[0] + added > len(line.points):
        return False
    saved = -problem.terms[VERTEX] * added
    for i in range(change.first, change.last):
        saved += line.edges[i, 0]
    costs = (0.0, 0.0, 0.0)
    for i in range(change.number + 1):
        at, to = _corner(line, change, i), _corner(line, change, i + 1)
        costs = (costs[1], costs[2], edge_cost(problem, at, to))
        saved -= costs[2]
    watched = problem.terms[CLEARANCE] > 0.0 or problem.terms[CAPACITY] > 0.0
    if not watched and saved <= _ROUND_OFF:
        return False
    for i in range(change.number + 1):
        if change.ends_known and i != 1:
            continue
        line.counts[1] += 1
        if not edge_allowed(problem, _corner(line, change, i), _corner(line, change, i + 1)):
            return False
    lows = (math.inf, math.inf, math.inf, math.inf, math.inf, math.inf)
    if watched:
        for i in range(change.number + 1):
            found = edge_lows(problem, _corner(line, change, i), _corner(line, change, i + 1))
            lows = (lows[2], lows[3], lows[4], lows[5], found[0], found[1])
        saved += _gain(problem, line, change, lows)
        if saved <= _ROUND_OFF:
            return False
    _put(line, change, costs, lows)
    return True


@leaf
def _corner(line: Polyline, change: Change, i: int) -> Vector:
    """Vertex ``i`` of the changed part: the one before, the new ones, the one after."""
    if i == 0:
        return row_of(line.points[change.first])
    if i == change.number + 1:
        return row_of(line.points[change.last])
    return change.one if i == 1 else change.two


@leaf
def _gain(
    problem: Problem,
    line: Polyline,
    change: Change,
    lows: tuple[float, float, float, float, float, float],
) -> float:
    """What the change does for the smallest clearance and margin of the whole path."""
    clearance, margin = math.inf, math.inf
    old_clearance, old_margin = math.inf, math.inf
    for i in range(line.counts[0] - 1):
        old_clearance = min(old_clearance, line.edges[i, 1])
        old_margin = min(old_margin, line.edges[i, 2])
        if i < change.first or i >= change.last:
            clearance = min(clearance, line.edges[i, 1])
            margin = min(margin, line.edges[i, 2])
    clearance = min(clearance, lows[0], lows[2], lows[4])
    margin = min(margin, lows[1], lows[3], lows[5])
    return gained(problem, clearance, margin) - gained(problem, old_clearance, old_margin)


@leaf
def _put(
    line: Polyline,
    change: Change,
    costs: Vector,
    lows: tuple[float, float, float, float, float, float],
) -> None:
    """Makes room for the new vertices, and writes them and what their edges are worth.

    The last numbers of ``costs`` and ``lows`` are those of the last new edge.
    """
    first, count, old = change.first, change.number, line.counts[0]
    shift = count - (change.last - first - 1)
    if shift > 0:
        for i in range(old - 1, change.last - 1, -1):
            _move(line, i, i + shift)
    elif shift < 0:
        for i in range(change.last, old):
            _move(line, i, i + shift)
    line.counts[0] = old + shift
    if count >= 1:
        line.points[first + 1, 0], line.points[first + 1, 1], line.points[first + 1, 2] = change.one
    if count == 2:
        line.points[first + 2, 0], line.points[first + 2, 1], line.points[first + 2, 2] = change.two
    for i in range(count + 1):
        k = i + 2 - count
        line.edges[first + i, 0] = costs[k]
        line.edges[first + i, 1], line.edges[first + i, 2] = lows[2 * k], lows[2 * k + 1]


@leaf
def _move(line: Polyline, place: int, to: int) -> None:
    for column in range(3):
        line.points[to, column] = line.points[place, column]
        line.edges[to, column] = line.edges[place, column]
