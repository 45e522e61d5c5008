"""Making a path cheaper by small random changes, each checked exactly.

A change takes about a microsecond to check, that many simple ones are tried: cutting a corner
between two positions on the path, moving one or two vertices by any distance, and moving a vertex
away and pulling it tight again, which lets it slide along what it touches.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.anytime.problem import (
    CAPACITY,
    CLEARANCE,
    VERTEX,
    PathProblem,
    edge_allowed,
    edge_cost,
    edge_lows,
    gained,
)
from planner.collision.edges import row_of
from planner.kernels.jit import leaf
from planner.kernels.primitives import (
    RandomState,
    Vector,
    along,
    below,
    direction,
    dot,
    minus,
    uniform,
)

# A path under improvement, and the only operation that changes it.
#
# Every improvement replaces some vertices by none, one or two others. It is made if the path gets
# cheaper and every new edge is allowed.


Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_VERTICES = 128
"""Room for the vertices of a path."""
_ROUND_OFF = 1e-13


class PathChange(NamedTuple):
    """Vertices to replace, and their replacements.

    Attributes:
        first: Index of the vertex before those replaced.
        last: Index of the vertex after them.
        number: Number of replacements, 0, 1 or 2.
        one: The first of them, [m].
        two: The second of them, [m].
        ends_known: Whether the edges to ``one`` and from ``two`` are parts of existing edges.
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
        edges: Cost of each edge, its smallest clearance [m] and margin [N] (infinite where they
            have no weight), indexed by its first vertex, shape (MOST_VERTICES, 3).
        counts: Vertices, and edge tests so far, shape (2,).
    """

    points: Array
    edges: Array
    counts: Integers


def polyline_of(points: Array) -> Polyline:
    """A polyline of vertices, shape (k, 3), [m], not yet measured, without spare capacity."""
    return Polyline(points.copy(), np.zeros((len(points), 3)), np.array([len(points), 0]))


@leaf
def measure(problem: PathProblem, line: Polyline) -> float:
    """Computes the values of all edges; returns the cost of the whole path."""
    for i in range(line.counts[0] - 1):
        start, end = row_of(line.points[i]), row_of(line.points[i + 1])
        clearance, margin = edge_lows(problem, start, end)
        line.edges[i, 0] = edge_cost(problem, start, end)
        line.edges[i, 1], line.edges[i, 2] = clearance, margin
    return cost_of(problem, line)


@leaf
def cost_of(problem: PathProblem, line: Polyline) -> float:
    """The cost of a path whose edges are measured."""
    total, clearance, margin = 0.0, math.inf, math.inf
    for i in range(line.counts[0] - 1):
        total += line.edges[i, 0]
        clearance = min(clearance, line.edges[i, 1])
        margin = min(margin, line.edges[i, 2])
    return total - gained(problem.terms, clearance, margin)


@leaf
def replace(problem: PathProblem, line: Polyline, change: PathChange) -> bool:
    """Makes a change if the path gets cheaper and every new edge is allowed."""
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
def _corner(line: Polyline, change: PathChange, i: int) -> Vector:
    """Vertex ``i`` of the changed part: the one before, the new ones, the one after."""
    if i == 0:
        return row_of(line.points[change.first])
    if i == change.number + 1:
        return row_of(line.points[change.last])
    return change.one if i == 1 else change.two


@leaf
def _gain(
    problem: PathProblem,
    line: Polyline,
    change: PathChange,
    lows: tuple[float, float, float, float, float, float],
) -> float:
    """The gain of a change in the smallest clearance and margin of the whole path."""
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
    before = gained(problem.terms, old_clearance, old_margin)
    return gained(problem.terms, clearance, margin) - before


@leaf
def _put(
    line: Polyline,
    change: PathChange,
    costs: Vector,
    lows: tuple[float, float, float, float, float, float],
) -> None:
    """Makes room for the new vertices, and writes them and the values of their edges.

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
def _move(line: Polyline, source: int, target: int) -> None:
    for column in range(3):
        line.points[target, column] = line.points[source, column]
        line.edges[target, column] = line.edges[source, column]


_LARGEST, _SMALLEST = 0.040, 5e-5
"""Moves of vertices, [m]: from a tenth of a typical path length to a negligible distance."""
_TIGHTENINGS = 7
_MOST_REPEATS, _ON = 12, 1.4
_CUT, _MOVE, _MOVE_TWO, _SLIDE, _DROP, _SPLIT = 0, 1, 2, 3, 4, 5
_NOWHERE = (0.0, 0.0, 0.0)


@leaf
def polish(problem: PathProblem, line: Polyline, state: RandomState, trials: int) -> None:
    """Tries random kinds of changes at random positions.

    A successful move of vertices is repeated in the same direction by growing distances.
    """
    for _ in range(trials):
        kind, heading, size = _kind(line, state), direction(state), _size(state)
        change = _drawn(line, state, kind, heading, size)
        if kind == _SLIDE:
            change = _tightened(problem, line, change)
        repeats = _MOST_REPEATS if kind in (_MOVE, _MOVE_TWO) else 1
        for _ in range(repeats):
            if not replace(problem, line, change):
                break
            size *= _ON
            one, two = along(change.one, heading, size), along(change.two, heading, size)
            change = PathChange(change.first, change.last, change.number, one, two, False)


@leaf
def _kind(line: Polyline, state: RandomState) -> int:
    """The kind of change to try. Source of the shares: measured on the paper's scenes."""
    choice = uniform(state)
    if line.counts[0] < 3 or choice < 0.05:
        return _SPLIT
    if choice < 0.35:
        return _CUT
    if choice < 0.60:
        return _MOVE
    if choice < 0.75:
        return _SLIDE
    if choice < 0.93 and line.counts[0] > 3:
        return _MOVE_TWO
    return _DROP


@leaf
def _size(state: RandomState) -> float:
    """The size of a move, log-uniform."""
    return _SMALLEST * math.exp(uniform(state) * math.log(_LARGEST / _SMALLEST))


@leaf
def _vertex(line: Polyline, k: int) -> Vector:
    return row_of(line.points[k])


@leaf
def _drawn(
    line: Polyline, state: RandomState, kind: int, heading: Vector, size: float
) -> PathChange:
    """A change of the given kind at a random position."""
    vertices = line.counts[0]
    if kind == _CUT:
        return _cut(line, state)
    if kind == _DROP:  # straight from a vertex to one of those after the next
        first = below(state, vertices - 2)
        last = first + 2 + int(uniform(state) ** 2 * (vertices - 2 - first))
        return PathChange(first, min(last, vertices - 1), 0, _NOWHERE, _NOWHERE, False)
    if kind == _SPLIT:
        k = below(state, vertices - 1)
        start, end = _vertex(line, k), _vertex(line, k + 1)
        at = along(start, minus(end, start), uniform(state))
        return PathChange(k, k + 1, 1, along(at, heading, size), _NOWHERE, False)
    if kind == _MOVE_TWO:  # both by the same vector: the edge between them may touch something
        k = 1 + below(state, vertices - 3)
        one, two = (
            along(_vertex(line, k), heading, size),
            along(_vertex(line, k + 1), heading, size),
        )
        return PathChange(k - 1, k + 2, 2, one, two, False)
    k = 1 + below(state, vertices - 2)
    return PathChange(k - 1, k + 1, 1, along(_vertex(line, k), heading, size), _NOWHERE, False)


@leaf
def _cut(line: Polyline, state: RandomState) -> PathChange:
    """A straight line from somewhere on one edge to somewhere on a later one."""
    edges = line.counts[0] - 1
    first = below(state, edges - 1)
    second = first + 1 + int(uniform(state) ** 3 * (edges - 1 - first))
    second = min(second, edges - 1)
    back, on = uniform(state), uniform(state)
    if uniform(state) < 0.5:  # close to the corners, where most of the remaining gain is
        near = math.exp(-6.0 * uniform(state))
        back, on = back * near, on * near
    a, b = _vertex(line, first), _vertex(line, first + 1)
    c, d = _vertex(line, second), _vertex(line, second + 1)
    one, two = along(b, minus(a, b), back), along(c, minus(d, c), on)
    return PathChange(first, second + 1, 2, one, two, True)


@leaf
def _tightened(problem: PathProblem, line: Polyline, change: PathChange) -> PathChange:
    """Pulls a moved vertex toward the line between its neighbours, as far as allowed."""
    before, after = _vertex(line, change.first), _vertex(line, change.last)
    chord = minus(after, before)
    squared = dot(chord, chord)
    if squared == 0.0:
        return change
    share = min(max(dot(minus(change.one, before), chord) / squared, 0.0), 1.0)
    inward = minus(along(before, chord, share), change.one)
    low, high, middle = 0.0, 1.0, 0.0  # the moved vertex itself must be allowed too
    for _ in range(_TIGHTENINGS):
        line.counts[1] += 2
        at, allowed = along(change.one, inward, middle), True
        for end in range(2):
            neighbour = after if end == 1 else before
            if allowed and not edge_allowed(problem, neighbour, at):
                allowed = False
        if allowed:
            low = middle
        elif middle == 0.0:
            return change
        else:
            high = middle
        middle = (low + high) / 2.0
    one = along(change.one, inward, low)
    return PathChange(change.first, change.last, 1, one, _NOWHERE, False)
