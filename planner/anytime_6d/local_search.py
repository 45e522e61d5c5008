"""Making a path of poses better by random changes, each checked exactly.

Corners are cut between two positions on the path; poses are moved and rotated by any amount, pulled
toward the move between their neighbours, left out or inserted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.anytime.problem import CAPACITY, CLEARANCE, KINEMATIC, gained
from planner.anytime_6d.problem import (
    RotatingProblem,
    move_allowed,
    move_length,
    move_lows,
    move_sum,
    put_between,
    put_rotated,
)
from planner.kernels.jit import kernel

# A path of poses under improvement, and the only operation that changes it.
#
# Every improvement replaces some poses by none, one or two others. It is made if the path gets
# cheaper and every new move is allowed.


MOST_POSES = 64
"""Room for the poses of a path."""
_ROUND_OFF = 1e-12
_POSE_PRICE = 2e-4
"""Least saving of an extra pose, as part of the cost: each is a corner that is run more slowly."""


class Line(NamedTuple):
    """A path of allowed moves; kernels change it in place.

    Attributes:
        poses: Start and goal included, shape (MOST_POSES, 7).
        moves: Cost of each move, its smallest clearance [m] and margin [N] (infinite where they
            have no weight), indexed by its first pose, shape (MOST_POSES, 3).
        counts: Poses, shape (1,).
    """

    poses: Array
    moves: Array
    counts: Integers


def new_line() -> Line:
    """An empty path with room for `MOST_POSES` poses."""
    return Line(np.zeros((MOST_POSES, 7)), np.zeros((MOST_POSES, 3)), np.zeros(1, dtype=np.int64))


def copied(line: Line) -> Line:
    """An independent copy."""
    return Line(line.poses.copy(), line.moves.copy(), line.counts.copy())


@kernel
def line_length(problem: RotatingProblem, line: Line) -> float:
    """Length, rotation counted, [m]."""
    total = 0.0
    for i in range(line.counts[0] - 1):
        total += move_length(line.poses[i], line.poses[i + 1], problem.objective.radian)
    return total


@kernel
def measure(problem: RotatingProblem, line: Line) -> float:
    """Computes the values of all moves; returns the cost of the whole path."""
    world, load, objective = problem.world, problem.load, problem.objective
    for i in range(line.counts[0] - 1):
        start, end, move = line.poses[i], line.poses[i + 1], line.moves[i]
        move[0] = move_sum(world, load, objective, start, end)
        move[1], move[2] = move_lows(world, load, objective, start, end)
    return line_cost(problem, line)


@kernel
def line_cost(problem: RotatingProblem, line: Line) -> float:
    """The cost of a path whose moves are measured."""
    clearance, margin = _lows(line, 0, 0)
    return _sums(line) - gained(problem.objective.weights, clearance, margin)


@kernel
def replace(
    problem: RotatingProblem,
    line: Line,
    first: int,
    last: int,
    new: Array,
    number: int,
    ends_known: bool,
    tallies: Integers,
) -> bool:
    """Replaces the poses between two by none, one or two, if that is better and allowed.

    Args:
        line: Path with measured moves; changed in place.
        first: Index of the pose before those replaced.
        last: Index of the pose after them.
        new: Replacements, shape (2, 7).
        ends_known: Whether the first and the last new move are parts of existing moves.
        tallies: See `move_allowed`.

    Returns:
        Whether the path was changed.
    """
    added = number - (last - first - 1)
    if line.counts[0] + added > len(line.poses):
        return False
    corners, worth = np.empty((4, 7)), np.empty((3, 3))
    corners[0], corners[number + 1] = line.poses[first], line.poses[last]
    corners[1 : number + 1] = new[:number]
    saved = -_POSE_PRICE * _sums(line) * added
    for i in range(first, last):
        saved += line.moves[i, 0]
    world, load, objective = problem.world, problem.load, problem.objective
    watched = objective.weights[CLEARANCE] > 0.0 or objective.weights[CAPACITY] > 0.0
    for i in range(number + 1):
        worth[i, 0] = move_sum(world, load, objective, corners[i], corners[i + 1])
        saved -= worth[i, 0]
    if not (watched or saved > _ROUND_OFF):
        return False
    for i in range(number + 1):
        known = ends_known and i != 1
        if not (known or move_allowed(problem, corners[i], corners[i + 1], tallies)):
            return False
    for i in range(number + 1):
        lows = move_lows(world, load, objective, corners[i], corners[i + 1])
        worth[i, 1], worth[i, 2] = lows
    if watched:
        saved += _gain(problem, line, first, last, worth[: number + 1])
        if not saved > _ROUND_OFF:
            return False
    _put(line, first, last, new[:number], worth[: number + 1])
    return True


@kernel
def _sums(line: Line) -> float:
    total = 0.0
    for i in range(line.counts[0] - 1):
        total += line.moves[i, 0]
    return total


@kernel
def _lows(line: Line, first: int, last: int) -> tuple[float, float]:
    """Smallest clearance and margin of the moves, except those from ``first`` to ``last``."""
    clearance, margin = math.inf, math.inf
    for i in range(line.counts[0] - 1):
        if i < first or i >= last:
            clearance, margin = min(clearance, line.moves[i, 1]), min(margin, line.moves[i, 2])
    return clearance, margin


@kernel
def _gain(problem: RotatingProblem, line: Line, first: int, last: int, worth: Array) -> float:
    """The gain of a change in the smallest clearance and margin of the whole path."""
    weights = problem.objective.weights
    before = gained(weights, *_lows(line, 0, 0))
    clearance, margin = _lows(line, first, last)
    for i in range(len(worth)):
        clearance, margin = min(clearance, worth[i, 1]), min(margin, worth[i, 2])
    return gained(weights, clearance, margin) - before


@kernel
def _put(line: Line, first: int, last: int, new: Array, worth: Array) -> None:
    """Makes room for the new poses, and writes them and the values of their moves."""
    old, added = line.counts[0], len(new) - (last - first - 1)
    if added > 0:
        for i in range(old - 1, last - 1, -1):
            line.poses[i + added], line.moves[i + added] = line.poses[i], line.moves[i]
    elif added < 0:
        for i in range(last, old):
            line.poses[i + added], line.moves[i + added] = line.poses[i], line.moves[i]
    line.counts[0] = old + added
    line.poses[first + 1 : first + 1 + len(new)] = new
    line.moves[first : first + len(worth)] = worth


Array = NDArray[np.float64]
Integers = NDArray[np.int64]

DRAWS = 10
"""Random numbers for each change."""
_LARGEST, _SMALLEST = 0.060, 2e-4
"""Sizes of changes, [m]."""
_MOST_REPEATS, _ON = 6, 1.5


@kernel
def polish(problem: RotatingProblem, line: Line, draws: Array, tallies: Integers) -> float:
    """Tries changes at random positions; returns the cost of the path afterwards.

    Args:
        line: Path with measured moves; changed in place.
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
def _may_bend(problem: RotatingProblem) -> bool:
    """Whether a bent path may beat a single move: not where the length alone counts."""
    weights = problem.objective.weights
    return bool(weights[KINEMATIC] + weights[CLEARANCE] + weights[CAPACITY] > 0.0)


@kernel
def _size(draw: Array) -> float:
    """The size of a change, log-uniform, [m]."""
    return _SMALLEST * math.exp(draw[3] * math.log(_LARGEST / _SMALLEST))


@kernel
def _split(
    problem: RotatingProblem, line: Line, draw: Array, new: Array, tallies: Integers
) -> None:
    """Inserts a pose beside a random position on a move."""
    first = int(draw[1] * (line.counts[0] - 1))
    put_between(line.poses[first], line.poses[first + 1], draw[2], new[0])
    _shift(problem, draw, _size(draw), new[0])
    replace(problem, line, first, first + 1, new, 1, False, tallies)


@kernel
def _cut(problem: RotatingProblem, line: Line, draw: Array, new: Array, tallies: Integers) -> None:
    """Joins a position on one move to a position on a later one."""
    count, poses = line.counts[0], line.poses
    first = int(draw[1] * (count - 2))
    second = min(first + 1 + int(draw[2] ** 3 * (count - 2 - first)), count - 2)
    back, on = draw[3], draw[4]
    if draw[5] < 0.5:  # close to the corners, where most of the remaining gain is
        near = math.exp(-6.0 * draw[6])
        back, on = back * near, on * near
    put_between(poses[first + 1], poses[first], back, new[0])
    put_between(poses[second], poses[second + 1], on, new[1])
    replace(problem, line, first, second + 1, new, 2, True, tallies)


@kernel
def _moved(
    problem: RotatingProblem, line: Line, number: int, draw: Array, new: Array, tallies: Integers
) -> None:
    """Moves one pose, or two by the same change; repeats a success by growing amounts.

    Two are moved because the move between them may touch something.
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
def _drawn(
    problem: RotatingProblem, line: Line, draw: Array, new: Array, tallies: Integers
) -> None:
    """Pulls a pose, or only its orientation, toward the move between its neighbours."""
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
def _shift(problem: RotatingProblem, draw: Array, size: float, pose: Array) -> None:
    """Changes a pose by ``size`` in a random direction: position, orientation or both."""
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
        put_rotated(pose.copy(), turn, pose)
