"""The cheapest path through a lattice, for when random first paths all pass on the wrong side.

Best-first search (A*) over the points at which the cost is known and their 26 neighbours. An edge
is tested only when its far end is about to be settled, so most edges are never tested.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.anytime.problem import KINEMATIC, LENGTH, PathProblem, edge_allowed, interpolated
from planner.collision.edges import row_of
from planner.kernels.jit import kernel
from planner.kernels.primitives import RandomState, Vector, minus, norm, uniform

# A binary heap in two arrays, smallest key first.


@kernel
def push(
    keys: Array,
    entries: Integers,
    count: int,
    key: float,
    value: float,
    first: int,
    second: int,
) -> tuple[Array, Integers, int]:
    """Adds an entry; returns the arrays, which grow when they are full, and the new count.

    Args:
        keys: Sort key of each entry and a value stored with it, shape (k, 2).
        entries: Two numbers of each entry, shape (k, 2).
        key: Sort key of the new entry.
        value: Value of the new entry.
        first: First number of the new entry.
        second: Second number of the new entry.
    """
    if count == len(keys):
        more_keys, more_entries = np.empty((2 * count, 2)), np.empty((2 * count, 2), dtype=np.int64)
        more_keys[:count], more_entries[:count] = keys, entries
        keys, entries = more_keys, more_entries
    at = count
    while at > 0:
        above = (at - 1) // 2
        if keys[above, 0] <= key:
            break
        _copy(keys, entries, above, at)
        at = above
    keys[at, 0], keys[at, 1] = key, value
    entries[at, 0], entries[at, 1] = first, second
    return keys, entries, count + 1


@kernel
def pop(keys: Array, entries: Integers, count: int) -> int:
    """Removes the first entry; returns the new count."""
    last = count - 1
    key, at = keys[last, 0], 0
    while True:
        below = 2 * at + 1
        if below >= last:
            break
        if below + 1 < last and keys[below + 1, 0] < keys[below, 0]:
            below += 1
        if keys[below, 0] >= key:
            break
        _copy(keys, entries, below, at)
        at = below
    _copy(keys, entries, last, at)
    return last


@kernel
def _copy(keys: Array, entries: Integers, source: int, target: int) -> None:
    keys[target, 0], keys[target, 1] = keys[source, 0], keys[source, 1]
    entries[target, 0], entries[target, 1] = entries[source, 0], entries[source, 1]


Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Shape = tuple[int, int, int]

_REACH = 2
"""Start and goal are joined to lattice points within this many steps."""
_ROOM = 4096
_OPEN = -2


@kernel
def lattice_path(
    problem: PathProblem,
    ends: Array,
    state: RandomState,
    stride: int,
    spread: float,
    points: Array,
    counts: Integers,
) -> int:
    """Finds the cheapest path by length and kinematic cost; nodes are grid points.

    Args:
        problem: Limits and costs; smallest clearance and margin are not counted.
        ends: Start and goal, shape (2, 3), [m].
        state: Of the random numbers; stepped.
        stride: Grid points per lattice step, along each axis.
        spread: Largest random increase of an edge's cost, as a part of it; for other paths.
        points: Vertices of the path, shape (k, 3), written.
        counts: The second number is incremented by each edge test, shape (2,).

    Returns:
        The number of vertices; 0 without a path, or without room for it.
    """
    shape = _shape(problem.kinematic, stride)
    size = shape[0] * shape[1] * shape[2]  # node index of the start; the goal's is one more
    parent = np.full(size + 2, _OPEN, dtype=np.int64)
    least = problem.terms[LENGTH] + problem.terms[KINEMATIC] * problem.kinematic.min()
    goal = row_of(ends[1])
    keys, entries = np.empty((_ROOM, 2)), np.empty((_ROOM, 2), dtype=np.int64)
    keys, entries, waiting = push(keys, entries, 0, 0.0, 0.0, size, -1)
    while waiting > 0:
        so_far, node, before = keys[0, 1], entries[0, 0], entries[0, 1]
        waiting = pop(keys, entries, waiting)
        if parent[node] != _OPEN:
            continue
        at = _point(problem, node, stride, shape, ends)
        if before >= 0:
            counts[1] += 1
            if not edge_allowed(problem, _point(problem, before, stride, shape, ends), at):
                continue
        parent[node] = before
        if node == size + 1:
            return _write_path(problem, parent, stride, shape, ends, points)
        weight = _weight(problem, at)
        low, high = _around(problem, at, stride, shape, _REACH if node == size else 1)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                for k in range(low[2], high[2] + 1):
                    other = (i * shape[1] + j) * shape[2] + k
                    if parent[other] != _OPEN:
                        continue
                    number = _numbers(problem, i, j, k, stride)
                    to, there = _position(problem, number), _weight_at(problem, number)
                    factor = (1.0 + spread * uniform(state)) * (weight + there) / 2.0
                    total = so_far + factor * norm(minus(to, at))
                    ahead = total + least * norm(minus(goal, to))
                    keys, entries, waiting = push(keys, entries, waiting, ahead, total, other, node)
        if _near(problem, at, goal, stride):
            total = so_far + (weight + _weight(problem, goal)) / 2.0 * norm(minus(goal, at))
            keys, entries, waiting = push(keys, entries, waiting, total, total, size + 1, node)
    return 0


@kernel
def _weight(problem: PathProblem, at: Vector) -> float:
    """Cost of a metre at a point."""
    cost = problem.terms[KINEMATIC]
    if cost > 0.0:
        cost *= interpolated(problem.grid, problem.kinematic, at)
    return problem.terms[LENGTH] + cost  # type: ignore[no-any-return]


@kernel
def _weight_at(problem: PathProblem, number: Shape) -> float:
    """Cost of a metre at a grid point."""
    kinematic = problem.terms[KINEMATIC] * problem.kinematic[number]
    return problem.terms[LENGTH] + kinematic  # type: ignore[no-any-return]


@kernel
def _shape(values: Array, stride: int) -> Shape:
    """Number of lattice points along each axis, the walls included."""
    return (
        (values.shape[0] + stride - 2) // stride + 1,
        (values.shape[1] + stride - 2) // stride + 1,
        (values.shape[2] + stride - 2) // stride + 1,
    )


@kernel
def _numbers(problem: PathProblem, i: int, j: int, k: int, stride: int) -> Shape:
    """The grid indices of a lattice point."""
    last = problem.kinematic.shape
    return (
        min(i * stride, last[0] - 1),
        min(j * stride, last[1] - 1),
        min(k * stride, last[2] - 1),
    )


@kernel
def _position(problem: PathProblem, number: Shape) -> Vector:
    grid = problem.grid
    return (
        grid[0, 0] + number[0] * grid[1, 0],
        grid[0, 1] + number[1] * grid[1, 1],
        grid[0, 2] + number[2] * grid[1, 2],
    )


@kernel
def _point(problem: PathProblem, node: int, stride: int, shape: Shape, ends: Array) -> Vector:
    size = shape[0] * shape[1] * shape[2]
    if node >= size:
        return row_of(ends[node - size])
    k, rest = node % shape[2], node // shape[2]
    return _position(problem, _numbers(problem, rest // shape[1], rest % shape[1], k, stride))


@kernel
def _around(
    problem: PathProblem, at: Vector, stride: int, shape: Shape, reach: int
) -> tuple[Shape, Shape]:
    """First and last lattice index within ``reach`` steps of a point, along each axis."""
    x = _nearest(problem, at[0], 0, stride)
    y = _nearest(problem, at[1], 1, stride)
    z = _nearest(problem, at[2], 2, stride)
    return (
        (max(x - reach, 0), max(y - reach, 0), max(z - reach, 0)),
        (min(x + reach, shape[0] - 1), min(y + reach, shape[1] - 1), min(z + reach, shape[2] - 1)),
    )


@kernel
def _nearest(problem: PathProblem, value: float, axis: int, stride: int) -> int:
    step = stride * problem.grid[1, axis]
    return int(math.floor((value - problem.grid[0, axis]) / step + 0.5))  # noqa: RUF046


@kernel
def _near(problem: PathProblem, at: Vector, goal: Vector, stride: int) -> bool:
    steps = 0.0
    for axis in range(3):
        steps = max(steps, abs(at[axis] - goal[axis]) / problem.grid[1, axis])
    return steps <= (_REACH + 0.5) * stride


@kernel
def _write_path(
    problem: PathProblem, parent: Integers, stride: int, shape: Shape, ends: Array, points: Array
) -> int:
    """Writes the path to the goal; 0 if it does not fit."""
    length, node = 0, len(parent) - 1
    while node >= 0:
        length, node = length + 1, parent[node]
    if length > len(points):
        return 0
    node = len(parent) - 1
    for i in range(length - 1, -1, -1):
        at = _point(problem, node, stride, shape, ends)
        points[i, 0], points[i, 1], points[i, 2] = at
        node = parent[node]
    return length
