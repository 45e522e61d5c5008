"""Making a path cheaper by small random changes, each of which is exact.

An allowed change costs about a microsecond to find out, so many simple ones beat few clever ones:
cutting a corner between two places of the path, moving one or two vertices by any size, and moving
a vertex away and drawing it tight again, which lets it slide along what it touches.
"""

from __future__ import annotations

import math

from planner.exact.compiled import leaf
from planner.exact.edge import row_of
from planner.exact.vectors import Vector, along, dot, minus
from planner.optimal.polyline import Change, Polyline, replace
from planner.optimal.problem import Problem, edge_allowed
from planner.optimal.random import State, below, direction, uniform

_LARGEST, _SMALLEST = 0.040, 5e-5
"""Moves of vertices, [m]: from a tenth of a usual way to what no longer matters."""
_TIGHTENINGS = 7
_MOST_REPEATS, _ON = 12, 1.4
_CUT, _MOVE, _MOVE_TWO, _SLIDE, _DROP, _SPLIT = 0, 1, 2, 3, 4, 5
_NOWHERE = (0.0, 0.0, 0.0)


@leaf
def polish(problem: Problem, line: Polyline, state: State, trials: int) -> None:
    """Tries so many kinds of changes at random places.

    Where moving vertices was better, they are moved on by ever more the same way.
    """
    for _ in range(trials):
        kind, way, size = _kind(line, state), direction(state), _size(state)
        change = _drawn(line, state, kind, way, size)
        if kind == _SLIDE:
            change = _tightened(problem, line, change)
        repeats = _MOST_REPEATS if kind in (_MOVE, _MOVE_TWO) else 1
        for _ in range(repeats):
            if not replace(problem, line, change):
                break
            size *= _ON
            one, two = along(change.one, way, size), along(change.two, way, size)
            change = Change(change.first, change.last, change.number, one, two, False)


@leaf
def _kind(line: Polyline, state: State) -> int:
    """What to try next. Source of the shares: measured on the paper's scenes."""
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
def _size(state: State) -> float:
    """The size of a move, every scale equally often."""
    return _SMALLEST * math.exp(uniform(state) * math.log(_LARGEST / _SMALLEST))


@leaf
def _vertex(line: Polyline, k: int) -> Vector:
    return row_of(line.points[k])


@leaf
def _drawn(line: Polyline, state: State, kind: int, way: Vector, size: float) -> Change:
    """One change of a kind at a random place."""
    vertices = line.counts[0]
    if kind == _CUT:
        return _cut(line, state)
    if kind == _DROP:  # straight from a vertex to one of those after the next
        first = below(state, vertices - 2)
        last = first + 2 + int(uniform(state) ** 2 * (vertices - 2 - first))
        return Change(first, min(last, vertices - 1), 0, _NOWHERE, _NOWHERE, False)
    if kind == _SPLIT:
        k = below(state, vertices - 1)
        start, end = _vertex(line, k), _vertex(line, k + 1)
        at = along(start, minus(end, start), uniform(state))
        return Change(k, k + 1, 1, along(at, way, size), _NOWHERE, False)
    if kind == _MOVE_TWO:  # alike, as where an edge between them touches something
        k = 1 + below(state, vertices - 3)
        one, two = along(_vertex(line, k), way, size), along(_vertex(line, k + 1), way, size)
        return Change(k - 1, k + 2, 2, one, two, False)
    k = 1 + below(state, vertices - 2)
    return Change(k - 1, k + 1, 1, along(_vertex(line, k), way, size), _NOWHERE, False)


@leaf
def _cut(line: Polyline, state: State) -> Change:
    """A straight line from somewhere on one edge to somewhere on a later one."""
    edges = line.counts[0] - 1
    first = below(state, edges - 1)
    second = first + 1 + int(uniform(state) ** 3 * (edges - 1 - first))
    second = min(second, edges - 1)
    back, on = uniform(state), uniform(state)
    if uniform(state) < 0.5:  # close to the corners, where most of what is left to gain is
        near = math.exp(-6.0 * uniform(state))
        back, on = back * near, on * near
    a, b = _vertex(line, first), _vertex(line, first + 1)
    c, d = _vertex(line, second), _vertex(line, second + 1)
    one, two = along(b, minus(a, b), back), along(c, minus(d, c), on)
    return Change(first, second + 1, 2, one, two, True)


@leaf
def _tightened(problem: Problem, line: Polyline, change: Change) -> Change:
    """Draws a moved vertex toward the straight line of its neighbours, as far as allowed."""
    before, after = _vertex(line, change.first), _vertex(line, change.last)
    chord = minus(after, before)
    squared = dot(chord, chord)
    if squared == 0.0:
        return change
    share = min(max(dot(minus(change.one, before), chord) / squared, 0.0), 1.0)
    inward = minus(along(before, chord, share), change.one)
    low, high, middle = 0.0, 1.0, 0.0  # where it was moved to must be allowed, too
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
    return Change(change.first, change.last, 1, one, _NOWHERE, False)
