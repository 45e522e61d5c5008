"""Making a path of poses better by random changes, each of which is exact.

Corners are cut between two places of the path, poses are moved and turned by any size or drawn
toward the move between their neighbours, left out, or put in.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.turning.line import Line, line_cost, replace
from planner.turning.moves import move_length, put_between, put_turned
from planner.turning.objective import CAPACITY, CLEARANCE, KINEMATIC
from planner.turning.problem import Problem

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

DRAWS = 10
"""Random numbers for each change."""
_LARGEST, _SMALLEST = 0.060, 2e-4
"""Sizes of changes, [m]."""
_MOST_REPEATS, _ON = 6, 1.5


@kernel
def polish(problem: Problem, line: Line, draws: Array, tallies: Integers) -> float:
    """Tries changes at random places; returns what the path costs then.

    Args:
        problem: Where.
        line: Changed in place, its moves being measured.
        draws: Random numbers in 0 … 1, a row for a change, shape (k, DRAWS).
        tallies: See `move_allowed`.
    """
    new, split = np.empty((2, 7)), _may_bend(problem)
    for k in range(len(draws)):
        draw = draws[k]
        kind, count = draw[0], line.counts[0]
        if kind >= 0.95 or count < 3:
            if count < 3 and not split:
                break
            _split(problem, line, draw, new, tallies)
        elif kind < 0.30:
            _cut(problem, line, draw, new, tallies)
        elif kind < 0.60 or (kind < 0.78 and count < 4):
            _moved(problem, line, 1, draw, new, tallies)
        elif kind < 0.78:
            _moved(problem, line, 2, draw, new, tallies)
        elif kind < 0.88:
            _drawn(problem, line, draw, new, tallies)
        else:
            first = int(draw[1] * (count - 2))
            last = first + 2 + int(draw[2] ** 2 * (count - 2 - first))
            replace(problem, line, first, min(last, count - 1), new, 0, False, tallies)
    return line_cost(problem, line)


@kernel
def _may_bend(problem: Problem) -> bool:
    """Whether more than a single move may be better than it: not where the length alone counts."""
    weights = problem.objective.weights
    return bool(weights[KINEMATIC] + weights[CLEARANCE] + weights[CAPACITY] > 0.0)


@kernel
def _size(draw: Array) -> float:
    """The size of a change, every scale equally often, [m]."""
    return _SMALLEST * math.exp(draw[3] * math.log(_LARGEST / _SMALLEST))


@kernel
def _split(problem: Problem, line: Line, draw: Array, new: Array, tallies: Integers) -> None:
    """A pose beside a place of a move."""
    first = int(draw[1] * (line.counts[0] - 1))
    put_between(line.poses[first], line.poses[first + 1], draw[2], new[0])
    _shift(problem, draw, _size(draw), new[0])
    replace(problem, line, first, first + 1, new, 1, False, tallies)


@kernel
def _cut(problem: Problem, line: Line, draw: Array, new: Array, tallies: Integers) -> None:
    """A move from somewhere on one move to somewhere on a later one."""
    count, poses = line.counts[0], line.poses
    first = int(draw[1] * (count - 2))
    second = min(first + 1 + int(draw[2] ** 3 * (count - 2 - first)), count - 2)
    back, on = draw[3], draw[4]
    if draw[5] < 0.5:  # close to the corners, where most of what is left to gain is
        near = math.exp(-6.0 * draw[6])
        back, on = back * near, on * near
    put_between(poses[first + 1], poses[first], back, new[0])
    put_between(poses[second], poses[second + 1], on, new[1])
    replace(problem, line, first, second + 1, new, 2, True, tallies)


@kernel
def _moved(
    problem: Problem, line: Line, number: int, draw: Array, new: Array, tallies: Integers
) -> None:
    """One pose, or two in turn alike, are moved; where that was better, on ever more the same way.

    Two are moved where the move between them touches something.
    """
    k, size = int(draw[1] * (line.counts[0] - 1 - number)), _size(draw)
    for _ in range(_MOST_REPEATS):
        for i in range(number):
            new[i] = line.poses[k + 1 + i]
            _shift(problem, draw, size, new[i])
        if not replace(problem, line, k, k + 1 + number, new, number, False, tallies):
            break
        size *= _ON


@kernel
def _drawn(problem: Problem, line: Line, draw: Array, new: Array, tallies: Integers) -> None:
    """A pose is drawn toward the move between its neighbours, or only turned that way."""
    k, poses = 1 + int(draw[1] * (line.counts[0] - 2)), line.poses
    radian = problem.objective.radian
    before = move_length(poses[k - 1], poses[k], radian)
    after = move_length(poses[k], poses[k + 1], radian)
    if before + after == 0.0:
        return
    put_between(poses[k - 1], poses[k + 1], before / (before + after), new[1])
    put_between(poses[k], new[1], 1.0 if draw[2] < 0.2 else draw[3], new[0])
    if draw[4] < 0.5:
        new[0, :3] = poses[k, :3]
    replace(problem, line, k - 1, k + 1, new, 1, False, tallies)


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
        radius, angle = math.sqrt(max(0.0, 1.0 - height * height)), size / problem.objective.radian
        turn = (
            angle * radius * math.cos(around),
            angle * radius * math.sin(around),
            angle * height,
        )
        put_turned(pose.copy(), turn, pose)
