"""Edges with moving exit points or rotation: swept hulls, an error bound, and bisection.

Over an interval of the edge each point of a cable is within a bound of the hull of the cable's ends
before and after, and each point of the platform within a bound of the hull of its corners: a point
at radius b that rotates by an angle θ at a steady rate is never farther than b θ² / 8 from the
point that moves straight at a steady rate, and one no faster than v never farther than v / 2. A
plane, or a distance of hulls, with that much extra room proves the interval; a pose in its middle
that is too near refutes the edge; else the interval is bisected.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.collision.swept_pair import points_apart, points_distance, put_corners
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, along, cross, dot, minus, norm, plus, rotated, row
from planner.kernels.scene_arrays import World, anchor, exit_point, exit_travel, half_size

Array = NDArray[np.float64]

_FINEST = 1e-9
"""Bound, [m], below which an interval that is neither proved nor refuted is refused."""
_MOST_PIECES = 4096
_DEEPEST = 64


@kernel
def rotating_edge_free(
    world: World, start: Array, end: Array, rotation: Array, turn: Array
) -> bool:
    """Whether the platform may move straight from ``start`` to ``end`` at a steady rotation.

    It stays in the workspace box, and platform and cables keep the clearance to every obstacle.
    Never True where that is violated; False also where a distance is within `_FINEST` of its limit.

    Args:
        world: Rig and obstacles; its own rotation is not used.
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].
        rotation: ``world_from_platform`` at the start, shape (3, 3).
        turn: Rotation vector from start to end, platform frame, shape (3,), [rad].
    """
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    for axis in range(3):
        low, high = world.limits[0, axis] - 1e-9, world.limits[1, axis] + 1e-9
        if not (low <= before[axis] <= high and low <= after[axis] <= high):
            return False
    if not (math.isfinite(turn[0]) and math.isfinite(turn[1]) and math.isfinite(turn[2])):
        return False
    for pair in range(len(world.pairs)):
        if not _pair_free(world, pair, before, after, rotation, turn):
            return False
    return True


@kernel
def pulley_pair_free(world: World, pair: int, before: Vector, after: Vector) -> bool:
    """Whether a cable on a pulley keeps its distance to a piece under translation."""
    return _pair_free(world, pair, before, after, world.platform[:3], np.zeros(3))


@kernel
def _pair_free(
    world: World,
    pair: int,
    before: Vector,
    after: Vector,
    rotation: Array,
    turn: Array,
) -> bool:
    """Whether one body keeps its distance to one piece; arguments as of `rotating_edge_free`."""
    piece, body = world.pairs[pair, 0], world.pairs[pair, 1]
    delta, needed = minus(after, before), world.bodies[body, 0]
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    lows, highs = np.empty(_DEEPEST), np.empty(_DEEPEST)
    lows[0], highs[0] = 0.0, 1.0
    waiting, tried = 1, 0
    while waiting > 0:
        waiting -= 1
        low, high = lows[waiting], highs[waiting]
        share, tried = high - low, tried + 1
        swept = _swept(world, body, before, delta, rotation, turn, low, high)
        bound = _bound(world, body, swept, share * norm(delta), share * angle)
        if bound < np.inf:
            if _plane_between(world, pair, swept, needed + bound):
                continue
            if points_apart(world, piece, swept, needed + bound):
                continue
        if bound < _FINEST or tried >= _MOST_PIECES or waiting + 2 > _DEEPEST:
            return False
        middle = (low + high) / 2.0
        still = _swept(world, body, before, delta, rotation, turn, middle, middle)
        if not points_apart(world, piece, still, needed):
            return False
        lows[waiting], highs[waiting] = middle, high
        lows[waiting + 1], highs[waiting + 1] = low, middle
        waiting += 2
    return True


@kernel
def pulley_clearance(
    world: World, piece: int, body: int, before: Vector, after: Vector, enough: float
) -> float:
    """Smallest distance of a cable on a pulley to a piece, [m], at most `_FINEST` too small.

    Where it is ``enough`` or more, any value from ``enough`` may be returned; minus infinity where
    the cable has no exit point somewhere on the edge; 0 or less where it touches.
    """
    delta, turn = minus(after, before), np.zeros(3)
    lows, highs = np.empty(_DEEPEST), np.empty(_DEEPEST)
    lows[0], highs[0] = 0.0, 1.0
    waiting, least, open_least = 1, enough, enough
    while waiting > 0:
        waiting -= 1
        low, high = lows[waiting], highs[waiting]
        swept = _swept(world, body, before, delta, world.platform[:3], turn, low, high)
        bound = _bound(world, body, swept, (high - low) * norm(delta), 0.0)
        if bound < np.inf:
            room = points_distance(world, piece, swept, least + bound) - bound
            if room >= least:
                continue
            if bound < _FINEST or (room <= 0.0 and bound < 1e-6):
                open_least = min(open_least, room)
                least = min(least, room)
                continue
        if waiting + 2 > _DEEPEST:
            return -np.inf
        middle = (low + high) / 2.0
        still = _swept(world, body, before, delta, world.platform[:3], turn, middle, middle)
        least = min(least, points_distance(world, piece, still, least))
        lows[waiting], highs[waiting] = middle, high
        lows[waiting + 1], highs[waiting + 1] = low, middle
        waiting += 2
    return least


@kernel
def _swept(
    world: World,
    body: int,
    before: Vector,
    delta: Vector,
    rotation: Array,
    turn: Array,
    low: float,
    high: float,
) -> Array:
    """Points of a body at two shares of the edge: exit, anchor, exit, anchor; or 16 corners."""
    if body == len(world.bodies) - 1:
        swept = np.empty((16, 3))
        put_corners(world, rotated_by(rotation, turn, low), along(before, delta, low), swept[:8])
        put_corners(world, rotated_by(rotation, turn, high), along(before, delta, high), swept[8:])
        return swept
    swept = np.empty((4, 3))
    arm = anchor(world, body)
    for i, share in enumerate((low, high)):
        at = plus(along(before, delta, share), rotated(rotated_by(rotation, turn, share), arm))
        swept[2 * i], swept[2 * i + 1] = exit_point(world, body, at), at
    return swept


@kernel
def _bound(world: World, body: int, swept: Array, travel: float, angle: float) -> float:
    """Bound of how far the body leaves the hull of its swept points, [m]."""
    if body == len(world.bodies) - 1:
        arm = norm(half_size(world))
        return arm * angle * angle / 8.0
    arm = norm(anchor(world, body))
    bend = arm * angle * angle / 8.0
    if world.pulley == 0.0:
        return bend
    start, end = row(swept, 1), row(swept, 3)
    return max(bend, exit_travel(world, body, start, end, travel + arm * angle) / 2.0)


@kernel
def _plane_between(world: World, pair: int, swept: Array, needed: float) -> bool:
    """Whether one of the pair's planes has all swept points before it, by ``needed``."""
    for k in range(world.pairs[pair, 2], world.pairs[pair, 3]):
        limit = world.planes[k, 4] - needed
        normal = (world.planes[k, 0], world.planes[k, 1], world.planes[k, 2])
        proved = True
        for i in range(len(swept)):
            if not dot(normal, row(swept, i)) <= limit:
                proved = False
                break
        if proved:
            return True
    return False


@kernel
def rotated_by(rotation: Array, turn: Array, share: float) -> Array:
    """``rotation`` times the rotation by a share of a rotation vector, shape (3, 3)."""
    angle = share * math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    if angle == 0.0:
        return rotation
    axis = (share * turn[0] / angle, share * turn[1] / angle, share * turn[2] / angle)
    sine, cosine = math.sin(angle), math.cos(angle)
    result = np.empty((3, 3))
    for i in range(3):
        line = (rotation[i, 0], rotation[i, 1], rotation[i, 2])
        # A row r times the matrix of a rotation is r rotated the opposite direction (Rodrigues).
        other, part = cross(line, axis), (1.0 - cosine) * dot(line, axis)
        for j in range(3):
            result[i, j] = cosine * line[j] + sine * other[j] + part * axis[j]
    return result
