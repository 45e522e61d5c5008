"""Input of a compiled search of poses, its straight moves and their limits.

A pose is a row of seven numbers: the position [m] and a unit quaternion (w, x, y, z). A move goes
straight while the platform rotates at a steady rate about one axis by the smaller angle, as in
`model.pose.interpolate`, which `planner.check` and the executor use.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.statics.wrench_sets import rms_anchor_radius
from planner.anytime.problem import CAPACITY, CLEARANCE, KINEMATIC, LENGTH
from planner.collision.self_collision_regions import Robot
from planner.collision.swept_pair import points_distance, put_corners
from planner.costs import KinematicCost
from planner.edge_checks import FREE, rotating_edge_problem
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, dot, plus, rotated, row
from planner.kernels.scene_arrays import World, anchor, exit_point
from planner.settings import Weights
from planner.wrench.capacity import LoadArrays, load_at, margin_at, structure_columns

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Quaternion = tuple[float, float, float, float]


@kernel
def relative(start: Array, end: Array) -> Quaternion:
    """The rotation between poses, in the first one's frame, by at most half a turn (w ≥ 0)."""
    a, b, c, d = start[3], -start[4], -start[5], -start[6]
    w, x, y, z = end[3], end[4], end[5], end[6]
    real = a * w - b * x - c * y - d * z
    sign = 1.0 if real >= 0.0 else -1.0
    return (
        sign * real,
        sign * (a * x + b * w + c * z - d * y),
        sign * (a * y - b * z + c * w + d * x),
        sign * (a * z + b * y - c * x + d * w),
    )


@kernel
def rotation_between(start: Array, end: Array) -> Vector:
    """The rotation vector from a pose to another, in the frame of the first, [rad]."""
    w, x, y, z = relative(start, end)
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-12:
        return (2.0 * x, 2.0 * y, 2.0 * z)
    scale = 2.0 * math.atan2(sine, w) / sine
    return (scale * x, scale * y, scale * z)


@kernel
def move_length(start: Array, end: Array, radian: float) -> float:
    """Length of a move, a radian of rotation weighted as a length, [m]."""
    turn = rotation_between(start, end)
    squared = radian * radian * (turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    for axis in range(3):
        squared += (end[axis] - start[axis]) ** 2
    return math.sqrt(squared)


@kernel
def put_between(start: Array, end: Array, share: float, found: Array) -> None:
    """Writes the pose at a share of a move, shape (7,)."""
    turn = rotation_between(start, end)
    for axis in range(3):
        found[axis] = start[axis] + share * (end[axis] - start[axis])
    put_rotated(start, (share * turn[0], share * turn[1], share * turn[2]), found)


@kernel
def put_rotated(start: Array, turn: Vector, found: Array) -> None:
    """Writes the quaternion of a pose rotated by a rotation vector in its own frame, [rad]."""
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    scale = math.sin(angle / 2.0) / angle if angle > 1e-9 else 0.5
    w, x, y, z = math.cos(angle / 2.0), scale * turn[0], scale * turn[1], scale * turn[2]
    a, b, c, d = start[3], start[4], start[5], start[6]
    found[3] = a * w - b * x - c * y - d * z
    found[4] = a * x + b * w + c * z - d * y
    found[5] = a * y - b * z + c * w + d * x
    found[6] = a * z + b * y - c * x + d * w
    size = math.sqrt(found[3] ** 2 + found[4] ** 2 + found[5] ** 2 + found[6] ** 2)
    for k in range(3, 7):
        found[k] /= size


@kernel
def matrix_of(pose: Array) -> Array:
    """``world_from_platform`` of a pose, shape (3, 3)."""
    w, x, y, z = pose[3], pose[4], pose[5], pose[6]
    matrix = np.empty((3, 3))
    matrix[0, 0], matrix[0, 1] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z)
    matrix[0, 2], matrix[1, 0] = 2.0 * (x * z + w * y), 2.0 * (x * y + w * z)
    matrix[1, 1], matrix[1, 2] = 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    matrix[2, 0], matrix[2, 1] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)
    matrix[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return matrix


# The scene's rotation limits along a move; `model.pose` is the definition.


@kernel
def rotations_kept(tilt: float, turn: float, start: Array, end: Array) -> bool:
    """Whether tilt and turn stay within limits, [rad], all along a move between two poses."""
    first = 1.0 if start[3] >= 0.0 else -1.0
    cosine = first * (start[3] * end[3] + start[4] * end[4] + start[5] * end[5] + start[6] * end[6])
    last = 1.0 if cosine >= 0.0 else -1.0
    cosine = abs(cosine)
    if turn < math.pi:
        for pose, sign in ((start, first), (end, last)):
            if not sign * pose[3] > 0.0 or not 2.0 * math.atan2(abs(pose[6]), abs(pose[3])) <= turn:
                return False
    bound = math.sin(tilt / 2.0) ** 2 if tilt < math.pi else 2.0
    at_start, at_end = start[4] ** 2 + start[5] ** 2, end[4] ** 2 + end[5] ** 2
    if not max(at_start, at_end) <= bound:
        return False
    across_x = last * end[4] - cosine * first * start[4]
    across_y = last * end[5] - cosine * first * start[5]
    across_z = last * end[6] - cosine * first * start[6]
    across_w = last * end[3] - cosine * first * start[3]
    sine = math.sqrt(across_x**2 + across_y**2 + across_z**2 + across_w**2)
    if sine == 0.0:
        return True
    mean = (at_start + (across_x**2 + across_y**2) / (sine * sine)) / 2.0
    cosine_part = at_start - mean
    sine_part = first * (start[4] * across_x + start[5] * across_y) / sine
    peak = math.atan2(sine_part, cosine_part) % (2.0 * math.pi)
    if peak > 2.0 * math.atan2(sine, cosine):
        return True
    return bool(mean + math.hypot(cosine_part, sine_part) <= bound)


# The distance of the whole robot to the obstacles at one pose, with any orientation.


@kernel
def pose_clearance(world: World, position: Vector, rotation: Array, enough: float) -> float:
    """Smallest distance of any body to any obstacle, [m]; 0 or less where they touch.

    Where the distance is ``enough`` or more, ``enough`` is returned. The definition is
    `model.clearance.ClearanceModel`.

    Args:
        world: Rig and obstacles; its own rotation is not used.
        position: World frame, [m].
        rotation: ``world_from_platform``, shape (3, 3).
        enough: [m].
    """
    least, platform = enough, len(world.bodies) - 1
    corners, lines = np.empty((8, 3)), np.empty((platform, 2, 3))
    put_corners(world, rotation, position, corners)
    for cable in range(platform):
        at = plus(position, rotated(rotation, anchor(world, cable)))
        lines[cable, 0], lines[cable, 1] = exit_point(world, cable, at), at
    for pair in range(len(world.pairs)):
        piece, body = world.pairs[pair, 0], world.pairs[pair, 1]
        points, radius = lines[body] if body < platform else corners, world.bodies[body, 1]
        if _room_at_planes(world, pair, points) - radius < least:
            found = points_distance(world, piece, points, least + radius) - radius
            least = min(least, found)
    return least


@kernel
def _room_at_planes(world: World, pair: int, points: Array) -> float:
    """A lower bound of the distance of the hull of a body's points to a piece, [m]."""
    room = -np.inf
    for k in range(world.pairs[pair, 2], world.pairs[pair, 3]):
        normal = (world.planes[k, 0], world.planes[k, 1], world.planes[k, 2])
        reach = -np.inf
        for i in range(len(points)):
            reach = max(reach, dot(normal, row(points, i)))
        room = max(room, world.planes[k, 4] - reach)
    return room


# The cost of moves that may rotate the platform: integrals along them, and their smallest values.
#
# All of it is computed at sampled poses of the move and only guides the search; `move_allowed`
# proves the limits.


_SAMPLING = 0.015
"""Spacing of poses at which c is computed, rotation counted, [m]."""
_LOW_SAMPLING = 0.020
"""Spacing of poses at which clearance and margin are computed, rotation counted, [m]."""


class Objective(NamedTuple):
    """The cost to minimise.

    Attributes:
        weights: Of length, ∫c ds, smallest clearance and smallest margin (the last two reduce the
            cost), shape (4,), indexed as `planner.anytime.problem.PathProblem.terms`.
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


# The problem, and the limits of a move.

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
        start: A pose, shape (7,).
        end: A pose, shape (7,).
        tallies: Moves checked, by what forbids them, shape (6,); one is incremented.
    """
    if not rotations_kept(problem.tilt, problem.turn, start, end):
        tallies[ROTATION] += 1
        return False
    turn = np.array(rotation_between(start, end))
    if not turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2 <= LARGEST_TURN**2:
        tallies[ROTATION] += 1
        return False
    world, robot, load = problem.world, problem.robot, problem.load
    rotation = matrix_of(start)
    found = rotating_edge_problem(
        world, robot, load, problem.reserve, start[:3], end[:3], rotation, turn
    )
    tallies[found] += 1
    return found == FREE
