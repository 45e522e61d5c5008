"""What a compiled search of poses is given, and what a move must keep."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.capacity import Load
from planner.exact.checks import FREE, turning_edge_problem
from planner.exact.compiled import kernel
from planner.exact.fields import World
from planner.exact.self_region import Robot
from planner.turning.limits import rotations_kept
from planner.turning.moves import matrix_of, turn_between
from planner.turning.objective import Objective

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

ROTATION: Final = 5
"""A move beyond the rotation limits; the other reasons are those of `planner.exact.checks`."""

LARGEST_TURN = 2.9
"""Of one move, [rad]: nearer to a half turn, round-off could decide which way is the shorter."""


class Problem(NamedTuple):
    """One question to the planner.

    Attributes:
        world: Obstacles and workspace, with the clearance that moves must keep.
        robot: The self clearance that moves must keep.
        load: The wrenches that must be held.
        reserve: Smallest capacity margin, [N].
        tilt: Largest tilt, [rad].
        turn: Largest turn about the vertical, [rad].
        objective: What is made small.
    """

    world: World
    robot: Robot
    load: Load
    reserve: float
    tilt: float
    turn: float
    objective: Objective


@kernel
def move_allowed(problem: Problem, start: Array, end: Array, tallies: Integers) -> bool:
    """Whether a move keeps everything asked for; counts why not.

    Args:
        problem: What is asked for.
        start: A pose, shape (7,).
        end: Likewise.
        tallies: Moves asked about, by what forbids them, shape (6,); one is stepped.
    """
    if not rotations_kept(problem.tilt, problem.turn, start, end):
        tallies[ROTATION] += 1
        return False
    turn = np.array(turn_between(start, end))
    if not turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2 <= LARGEST_TURN**2:
        tallies[ROTATION] += 1
        return False
    world, robot, load = problem.world, problem.robot, problem.load
    rotation = matrix_of(start)
    found = turning_edge_problem(
        world, robot, load, problem.reserve, start[:3], end[:3], rotation, turn
    )
    tallies[found] += 1
    return found == FREE
