"""Poses in compiled code, and the straight moves between them.

A pose is a row of seven numbers: the position [m] and a unit quaternion (w, x, y, z). A move goes
straight while the platform turns at a steady rate about one axis, the shorter way; that is
`cdpr.poses.interpolate`, which `planner.check` and the executor use.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.vectors import Vector

Array = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]


@kernel
def relative(start: Array, end: Array) -> Quaternion:
    """The rotation from a pose to another in the frame of the first, the shorter way (w ≥ 0)."""
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
    """Length of a move, a radian of turning counted as so many metres, [m]."""
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
    put_turned(start, (share * turn[0], share * turn[1], share * turn[2]), found)


@kernel
def put_turned(start: Array, turn: Vector, found: Array) -> None:
    """Writes the quaternion of a pose turned by a rotation vector in its own frame, [rad]."""
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
