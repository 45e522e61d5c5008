"""A path of poses under improvement, and the one way in which it is ever changed.

Everything that makes a path better asks for some of its poses to be replaced by none, one or two
others. The change is made when it makes the path cheaper and every new move is allowed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.turning.moves import move_length
from planner.turning.objective import CAPACITY, CLEARANCE, gained, move_lows, move_sum
from planner.turning.problem import Problem, move_allowed

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MOST_POSES = 64
"""Room for the poses of a path."""
_ROUND_OFF = 1e-12
_POSE_PRICE = 2e-4
"""What a pose more must save, as part of the sums: each is a corner that is run more slowly."""


class Line(NamedTuple):
    """A path of allowed moves; kernels change it in place.

    Attributes:
        poses: Start and goal included, shape (MOST_POSES, 7).
        moves: Of each move, by its first pose, what it adds to the sums in the cost, its smallest
            clearance [m] and margin [N] (infinite where they have no weight), shape
            (MOST_POSES, 3).
        counts: Poses, shape (1,).
    """

    poses: Array
    moves: Array
    counts: Integers


def new_line() -> Line:
    """Room for a path."""
    return Line(np.zeros((MOST_POSES, 7)), np.zeros((MOST_POSES, 3)), np.zeros(1, dtype=np.int64))


def copied(line: Line) -> Line:
    """A path that changes on its own."""
    return Line(line.poses.copy(), line.moves.copy(), line.counts.copy())


@kernel
def line_length(problem: Problem, line: Line) -> float:
    """Length, turning counted, [m]."""
    total = 0.0
    for i in range(line.counts[0] - 1):
        total += move_length(line.poses[i], line.poses[i + 1], problem.objective.radian)
    return total


@kernel
def measure(problem: Problem, line: Line) -> float:
    """Fills in what the moves are worth, and gives the cost of the whole path."""
    world, load, objective = problem.world, problem.load, problem.objective
    for i in range(line.counts[0] - 1):
        start, end, move = line.poses[i], line.poses[i + 1], line.moves[i]
        move[0] = move_sum(world, load, objective, start, end)
        move[1], move[2] = move_lows(world, load, objective, start, end)
    return line_cost(problem, line)


@kernel
def line_cost(problem: Problem, line: Line) -> float:
    """The cost of the whole path, its moves being measured."""
    clearance, margin = _lows(line, 0, 0)
    return _sums(line) - gained(problem.objective, clearance, margin)


@kernel
def replace(
    problem: Problem,
    line: Line,
    first: int,
    last: int,
    new: Array,
    number: int,
    ends_known: bool,
    tallies: Integers,
) -> bool:
    """Puts none, one or two poses in place of those between two, if that is better and allowed.

    Args:
        problem: Where.
        line: Changed in place, its moves being measured.
        first: Number of the pose before those that go.
        last: Number of the pose after them.
        new: What comes in their place, shape (2, 7).
        number: How many of these.
        ends_known: Whether the first and the last new move are parts of present moves.
        tallies: See `move_allowed`.

    Returns:
        Whether it was done.
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
    """Smallest clearance and margin of the moves, those from ``first`` to ``last`` left out."""
    clearance, margin = math.inf, math.inf
    for i in range(line.counts[0] - 1):
        if i < first or i >= last:
            clearance, margin = min(clearance, line.moves[i, 1]), min(margin, line.moves[i, 2])
    return clearance, margin


@kernel
def _gain(problem: Problem, line: Line, first: int, last: int, worth: Array) -> float:
    """What the change does for the smallest clearance and margin of the whole path."""
    before = gained(problem.objective, *_lows(line, 0, 0))
    clearance, margin = _lows(line, first, last)
    for i in range(len(worth)):
        clearance, margin = min(clearance, worth[i, 1]), min(margin, worth[i, 2])
    return gained(problem.objective, clearance, margin) - before


@kernel
def _put(line: Line, first: int, last: int, new: Array, worth: Array) -> None:
    """Makes room for the new poses, and writes them and what their moves are worth."""
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
