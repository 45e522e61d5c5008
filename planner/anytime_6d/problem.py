"""Input of a compiled search of poses, and the limits of a move."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.statics.wrench_sets import rms_anchor_radius
from planner.anytime_6d.moves import (
    matrix_of,
    move_length,
    pose_clearance,
    put_between,
    rotations_kept,
    turn_between,
)
from planner.collision.self_collision_regions import Robot
from planner.costs import KinematicCost
from planner.edge_checks import FREE, turning_edge_problem
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector
from planner.kernels.scene_arrays import World
from planner.settings import Weights
from planner.wrench.capacity import LoadArrays, load_at, margin_at, structure_columns

# The cost of moves that may rotate the platform: integrals along them, and their smallest values.
#
# All of it is computed at sampled poses of the move and only guides the search; `move_allowed`
# proves the limits.


LENGTH, KINEMATIC, CLEARANCE, CAPACITY = 0, 1, 2, 3
"""Indices into `Objective.weights`."""

_SAMPLING = 0.015
"""Spacing of poses at which c is computed, rotation counted, [m]."""
_LOW_SAMPLING = 0.020
"""Spacing of poses at which clearance and margin are computed, rotation counted, [m]."""


class Objective(NamedTuple):
    """The cost to minimise.

    Attributes:
        weights: Of length, ∫c ds, smallest clearance and smallest margin (the last two reduce the
            cost), shape (4,).
        extremes: Smallest and largest condition number, and inverse volume of the force set, by
            which c is scaled, shape (2, 2).
        triples: Three cables for each part of the volume, shape (k, 3).
        radian: Metres that a radian of rotation counts as.
    """

    weights: Array
    extremes: Array
    triples: Integers
    radian: float


def build_objective(weights: Weights, kinematic: KinematicCost) -> Objective:
    """The objective of a search; ``kinematic`` gives the scaling, of its one orientation."""
    triples = list(combinations(range(kinematic.rig.cable_count), 3))
    objective = Objective(
        weights=np.zeros(4),
        extremes=np.array(kinematic.extremes),
        triples=np.array(triples, dtype=np.int64),
        radian=float(rms_anchor_radius(kinematic.rig.anchors)),
    )
    set_weights(objective, weights)
    return objective


def set_weights(objective: Objective, weights: Weights) -> None:
    """Changes the weights in place."""
    objective.weights[:] = weights.length, weights.kinematic, weights.clearance, weights.capacity


@kernel
def pose_cost(
    world: World, load: LoadArrays, objective: Objective, rotation: Array, position: Vector
) -> float:
    """The cost c = γ_d + γ_f of a pose; its definition is `planner.costs.KinematicCost`.

    Where rotation makes an index better than its best value without rotation, that part is 0.
    """
    count = len(world.cables)
    columns = np.empty((count, 6))
    structure_columns(world, rotation, position, load.length, columns)
    total = 0.0
    for i in range(count):
        for k in range(6):
            total += columns[i, k]
    if not math.isfinite(total):
        return math.inf
    values = np.linalg.eigvalsh(columns.T @ columns)
    if not values[0] > 0.0:
        return math.inf
    cost = _scaled(objective.extremes[0], math.sqrt(values[5] / values[0]))
    volume = _force_volume(columns, objective.triples) * (load.high - load.low) ** 3
    return cost + _scaled(objective.extremes[1], 1.0 / volume)


@kernel
def _scaled(extremes: Array, value: float) -> float:
    low, high = extremes[0], extremes[1]
    return max(0.0, (value - low) / (high - low)) if high > low else 0.0


@kernel
def _force_volume(columns: Array, triples: Integers) -> float:
    """The sum of the determinants of every three unit vectors along cables."""
    volume = 0.0
    for t in range(len(triples)):
        a, b, c = columns[triples[t, 0]], columns[triples[t, 1]], columns[triples[t, 2]]
        volume += abs(
            a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
    return volume


@kernel
def move_sum(
    world: World, load: LoadArrays, objective: Objective, start: Array, end: Array
) -> float:
    """The cost of a move: weighted length and integral of c, [m]."""
    length = move_length(start, end, objective.radian)
    weight = objective.weights[KINEMATIC]
    if weight == 0.0 or length == 0.0:
        return float(objective.weights[LENGTH] * length)
    pose, total = np.empty(7), 0.0
    parts = math.ceil(length / _SAMPLING)
    for i in range(parts):  # midpoints of equal parts
        put_between(start, end, (i + 0.5) / parts, pose)
        at = (pose[0], pose[1], pose[2])
        total += pose_cost(world, load, objective, matrix_of(pose), at)
    return float((objective.weights[LENGTH] + weight * total / parts) * length)


@kernel
def move_lows(
    world: World, load: LoadArrays, objective: Objective, start: Array, end: Array
) -> tuple[float, float]:
    """Smallest clearance [m] and margin [N] of a move; infinite where they have no weight."""
    clearance, margin = math.inf, math.inf
    watches_clearance = objective.weights[CLEARANCE] > 0.0
    watches_margin = objective.weights[CAPACITY] > 0.0
    if not (watches_clearance or watches_margin):
        return clearance, margin
    pose = np.empty(7)
    parts = math.ceil(move_length(start, end, objective.radian) / _LOW_SAMPLING) + 1
    for i in range(parts + 1):
        put_between(start, end, i / parts, pose)
        at, rotation = (pose[0], pose[1], pose[2]), matrix_of(pose)
        if watches_clearance:
            clearance = pose_clearance(world, at, rotation, clearance)
        if watches_margin:
            margin = min(margin, margin_at(world, load_at(load, rotation), rotation, at))
    return clearance, margin


@kernel
def gained(objective: Objective, clearance: float, margin: float) -> float:
    """The amount by which a path's smallest clearance and margin reduce its cost."""
    gain = 0.0
    if objective.weights[CLEARANCE] > 0.0 and clearance < math.inf:
        gain += objective.weights[CLEARANCE] * clearance
    if objective.weights[CAPACITY] > 0.0 and margin < math.inf:
        gain += objective.weights[CAPACITY] * margin
    return gain


Array = NDArray[np.float64]
Integers = NDArray[np.int64]

ROTATION: Final = 5
"""A move beyond the rotation limits; the other reasons are those of `planner.edge_checks`."""

LARGEST_TURN = 2.9
"""Of one move, [rad]: nearer to a half turn, round-off could decide the direction of rotation."""


class RotatingProblem(NamedTuple):
    """One question to the planner.

    Attributes:
        world: Obstacles and workspace, with the clearance that moves must keep.
        robot: The self clearance that moves must keep.
        load: The wrenches that must be held.
        reserve: Smallest capacity margin, [N].
        tilt: Largest tilt, [rad].
        turn: Largest turn about the vertical, [rad].
        objective: The cost to minimise.
    """

    world: World
    robot: Robot
    load: LoadArrays
    reserve: float
    tilt: float
    turn: float
    objective: Objective


@kernel
def move_allowed(problem: RotatingProblem, start: Array, end: Array, tallies: Integers) -> bool:
    """Whether a move keeps every limit; counts the reason if not.

    Args:
        problem: The limits.
        start: A pose, shape (7,).
        end: A pose, shape (7,).
        tallies: Moves checked, by what forbids them, shape (6,); one is incremented.
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
