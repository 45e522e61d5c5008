"""Poses in compiled code, and the straight moves between them.

A pose is a row of seven numbers: the position [m] and a unit quaternion (w, x, y, z). A move goes
straight while the platform rotates at a steady rate about one axis by the smaller angle, as in
`model.pose.interpolate`, which `planner.check` and the executor use.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.collision.swept_pair import points_distance, put_corners
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, dot, plus, rotated, row
from planner.kernels.scene_arrays import World, anchor, exit_point

Array = NDArray[np.float64]
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
def turn_between(start: Array, end: Array) -> Vector:
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
    turn = turn_between(start, end)
    squared = radian * radian * (turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    for axis in range(3):
        squared += (end[axis] - start[axis]) ** 2
    return math.sqrt(squared)


@kernel
def put_between(start: Array, end: Array, share: float, found: Array) -> None:
    """Writes the pose at a share of a move, shape (7,)."""
    turn = turn_between(start, end)
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
    bound = math.sin(tilt / 2.0) ** 2
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
