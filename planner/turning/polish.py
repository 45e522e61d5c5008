"""Making a path of poses shorter by random changes, each of which is exact.

Corners are cut between two places of the path, poses are moved and turned by any size or drawn
toward the move between their neighbours, left out, or put in. A change is made when it makes the
path shorter, with the turning in it, and every new move is allowed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.turning.moves import move_length, put_between, put_turned
from planner.turning.problem import Problem, move_allowed

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_POSES = 64
"""Room for the poses of a path."""
DRAWS = 10
"""Random numbers for each change."""
_LARGEST, _SMALLEST = 0.060, 2e-4
"""Sizes of changes, [m]."""
_MOST_REPEATS, _ON = 6, 1.5
_ROUND_OFF = 1e-12
_POSE_PRICE = 2e-4
"""What a pose more must save, as part of the path: each is a corner that is run more slowly."""


@kernel
def path_length(problem: Problem, path: Array, count: int) -> float:
    """Length of a path of so many poses, turning counted, [m]."""
    total = 0.0
    for i in range(count - 1):
        total += move_length(path[i], path[i + 1], problem.radian)
    return total


@kernel
def polish(problem: Problem, path: Array, count: int, draws: Array, tallies: Integers) -> int:
    """Tries changes at random places; returns the new number of poses.

    Args:
        problem: Where.
        path: Allowed moves, shape (MOST_POSES, 7), changed in place.
        count: Poses of it.
        draws: Random numbers in 0 … 1, a row for a change, shape (k, DRAWS).
        tallies: See `move_allowed`.
    """
    new = np.empty((2, 7))
    for k in range(len(draws)):
        draw = draws[k]
        kind = draw[0]
        if count < 3:  # a single move is the shortest way
            break
        if kind < 0.30:
            count = _cut(problem, path, count, draw, new, tallies)
        elif kind < 0.60 or (kind < 0.78 and count < 4):
            count = _moved(problem, path, count, 1, draw, new, tallies)
        elif kind < 0.78:
            count = _moved(problem, path, count, 2, draw, new, tallies)
        elif kind < 0.88:
            count = _drawn(problem, path, count, draw, new, tallies)
        elif kind < 0.95:
            first = int(draw[1] * (count - 2))
            last = first + 2 + int(draw[2] ** 2 * (count - 2 - first))
            last = min(last, count - 1)
            count = _replaced(problem, path, count, first, last, new, 0, False, tallies)
        else:
            first = int(draw[1] * (count - 1))
            put_between(path[first], path[first + 1], draw[2], new[0])
            _shift(problem, draw, _size(draw), new[0])
            count = _replaced(problem, path, count, first, first + 1, new, 1, False, tallies)
    return count


@kernel
def _size(draw: Array) -> float:
    """The size of a change, every scale equally often, [m]."""
    return _SMALLEST * math.exp(draw[3] * math.log(_LARGEST / _SMALLEST))


@kernel
def _cut(
    problem: Problem, path: Array, count: int, draw: Array, new: Array, tallies: Integers
) -> int:
    """A move from somewhere on one move to somewhere on a later one."""
    first = int(draw[1] * (count - 2))
    second = min(first + 1 + int(draw[2] ** 3 * (count - 2 - first)), count - 2)
    back, on = draw[3], draw[4]
    if draw[5] < 0.5:  # close to the corners, where most of what is left to gain is
        near = math.exp(-6.0 * draw[6])
        back, on = back * near, on * near
    put_between(path[first + 1], path[first], back, new[0])
    put_between(path[second], path[second + 1], on, new[1])
    return _replaced(problem, path, count, first, second + 1, new, 2, True, tallies)


@kernel
def _moved(
    problem: Problem,
    path: Array,
    count: int,
    number: int,
    draw: Array,
    new: Array,
    tallies: Integers,
) -> int:
    """One pose, or two in turn alike, are moved; where that was better, on ever more the same way.

    Two are moved where the move between them touches something.
    """
    k, size = int(draw[1] * (count - 1 - number)), _size(draw)
    for _ in range(_MOST_REPEATS):
        for i in range(number):
            new[i] = path[k + 1 + i]
            _shift(problem, draw, size, new[i])
        before = path_length(problem, path, count)
        count = _replaced(problem, path, count, k, k + 1 + number, new, number, False, tallies)
        if path_length(problem, path, count) >= before:
            break
        size *= _ON
    return count


@kernel
def _drawn(
    problem: Problem, path: Array, count: int, draw: Array, new: Array, tallies: Integers
) -> int:
    """A pose is drawn toward the move between its neighbours, or only turned that way."""
    k = 1 + int(draw[1] * (count - 2))
    radian = problem.radian
    before = move_length(path[k - 1], path[k], radian)
    after = move_length(path[k], path[k + 1], radian)
    if before + after == 0.0:
        return count
    put_between(path[k - 1], path[k + 1], before / (before + after), new[1])
    put_between(path[k], new[1], 1.0 if draw[2] < 0.2 else draw[3], new[0])
    if draw[4] < 0.5:
        new[0, :3] = path[k, :3]
    return _replaced(problem, path, count, k - 1, k + 1, new, 1, False, tallies)


@kernel
def _shift(problem: Problem, draw: Array, size: float, pose: Array) -> None:
    """Moves a pose by a size in a random direction: position, orientation or both."""
    height, around = 2.0 * draw[4] - 1.0, 2.0 * math.pi * draw[5]
    radius = math.sqrt(max(0.0, 1.0 - height * height))
    if draw[8] < 0.65:
        pose[0] += size * radius * math.cos(around)
        pose[1] += size * radius * math.sin(around)
        pose[2] += size * height
    if draw[8] > 0.35:
        height, around = 2.0 * draw[6] - 1.0, 2.0 * math.pi * draw[7]
        radius, angle = math.sqrt(max(0.0, 1.0 - height * height)), size / problem.radian
        turn = (
            angle * radius * math.cos(around),
            angle * radius * math.sin(around),
            angle * height,
        )
        put_turned(pose.copy(), turn, pose)


@kernel
def _replaced(
    problem: Problem,
    path: Array,
    count: int,
    first: int,
    last: int,
    new: Array,
    number: int,
    ends_known: bool,
    tallies: Integers,
) -> int:
    """Puts none, one or two poses in place of those between two, if that is shorter and allowed.

    Args:
        problem: Where.
        path: Changed in place.
        count: Poses of it.
        first: Number of the pose before those that go.
        last: Number of the pose after them.
        new: What comes in their place, shape (2, 7).
        number: How many of these.
        ends_known: Whether the first and the last new move are parts of present moves.
        tallies: See `move_allowed`.

    Returns:
        The number of poses then.
    """
    added = number - (last - first - 1)
    if count + added > len(path):
        return count
    saved = -_POSE_PRICE * path_length(problem, path, count) * added
    for i in range(first, last):
        saved += move_length(path[i], path[i + 1], problem.radian)
    corners = np.empty((4, 7))
    corners[0], corners[number + 1] = path[first], path[last]
    corners[1 : number + 1] = new[:number]
    for i in range(number + 1):
        saved -= move_length(corners[i], corners[i + 1], problem.radian)
    if not saved > _ROUND_OFF:
        return count
    for i in range(number + 1):
        if ends_known and i != 1:
            continue
        if not move_allowed(problem, corners[i], corners[i + 1], tallies):
            return count
    _make_room(path, count, last, added)
    for i in range(number):
        path[first + 1 + i] = new[i]
    return count + added


@kernel
def _make_room(path: Array, count: int, last: int, added: int) -> None:
    if added > 0:
        for i in range(count - 1, last - 1, -1):
            path[i + added] = path[i]
    elif added < 0:
        for i in range(last, count):
            path[i + added] = path[i]
