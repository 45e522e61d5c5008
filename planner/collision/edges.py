"""Edges of pure translation: obstacles and workspace, exact from end to end.

For every pair of a body and a piece, precomputed planes are tried. A plane with the whole edge
before it proves the pair; a part of the edge behind all planes of a core refutes it; only otherwise
is the closed form evaluated. Cables on pulleys, whose exit points move, go to
`planner.collision.rotating_edges`, which also handles edges with rotation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.collision.rotating_edges import pulley_clearance, pulley_pair_free
from planner.collision.swept_pair import (
    box_apart,
    cable_apart,
    cable_distance,
    platform_apart,
    platform_distance,
)
from planner.kernels.jit import inlined, kernel, leaf
from planner.kernels.primitives import Vector, plus
from planner.kernels.scene_arrays import BOX, Integers, World, arm, outlet

Array = NDArray[np.float64]

_AT_THE_WALL = 1e-9
"""Tolerance of the workspace box, [m]: round-off of files and frames."""
_ALL_FREE, _REFUTED = -1, -2


@leaf
def edge_free(world: World, start: Array, end: Array) -> bool:
    """Whether the platform may be translated from ``start`` to ``end``, shape (3,) each, [m].

    It stays in the workspace box, and platform and cables keep the clearance to every obstacle.
    Never True where that is violated; False also where a distance is within round-off of its limit.
    """
    before = (start[0], start[1], start[2])
    after = (end[0], end[1], end[2])
    if not (in_workspace(world, before) and in_workspace(world, after)):
        return False
    return obstacles_free(world, before, after)


@leaf
def edge_clearance(world: World, start: Array, end: Array) -> tuple[float, int, int]:
    """The smallest distance of any body to any obstacle along an edge, exact.

    Args:
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].

    Returns:
        The distance between surfaces, [m], 0 or less where they touch and infinite without
        obstacles; the index of the body (m for the platform); the index of the obstacle.
    """
    before, after = row_of(start), row_of(end)
    bodies = len(world.bodies)
    least, body_found, owner_found = np.inf, -1, -1
    for pair in range(len(world.pairs)):
        piece, body = world.pairs[pair, 0], world.pairs[pair, 1]
        radius = world.bodies[body, 1]
        if _room_at_planes(world, pair, before, after) - radius >= least:
            continue
        if body == bodies - 1:
            found = platform_distance(world, piece, before, after, least)
        elif world.pulley > 0.0:
            found = pulley_clearance(world, piece, body, before, after, least + radius)
        else:
            at = outlet(world, body)
            b, c = plus(before, arm(world, body)), plus(after, arm(world, body))
            found = cable_distance(world, piece, at, b, c, least + radius)
        if found - radius < least:
            least, body_found, owner_found = found - radius, body, world.spans[piece, 1]
    return least, body_found, owner_found


@leaf
def row_of(point: Array) -> Vector:
    """An array of shape (3,) as a vector."""
    return (point[0], point[1], point[2])


@leaf
def in_workspace(world: World, position: Vector) -> bool:
    """Whether a position is in the workspace box; False for NaN."""
    for axis in range(3):
        low, high = world.limits[0, axis] - _AT_THE_WALL, world.limits[1, axis] + _AT_THE_WALL
        if not low <= position[axis] <= high:
            return False
    return True


@inlined
def obstacles_free(world: World, before: Vector, after: Vector) -> bool:
    """Whether all bodies keep their distance to all obstacles between two positions."""
    if world.pulley > 0.0:
        return _free_over_pulleys(world, before, after)
    pair = 0
    while True:
        pair = _undecided(world.planes, world.pairs, pair, before, after)
        if pair < 0:
            return pair == _ALL_FREE
        piece, body = world.pairs[pair, 0], world.pairs[pair, 1]
        if world.spans[piece, 0] == BOX and body < len(world.cables):
            # Passing the whole world, a hundred words, would take longer than the comparison.
            if not box_apart(world.pieces, world.cables, world.bodies, piece, body, before, after):
                return False
        elif not _pair_free(world, piece, body, before, after):
            return False
        pair += 1


@leaf
def _undecided(planes: Array, pairs: Integers, first: int, before: Vector, after: Vector) -> int:
    """The next pair that the planes do not decide; else `_ALL_FREE` or `_REFUTED`."""
    for pair in range(first, len(pairs)):
        if _before_a_plane(planes, pairs[pair, 2], pairs[pair, 3], before, after):
            continue
        if _enters_core(planes, pairs[pair, 3], pairs[pair, 4], before, after):
            return _REFUTED
        return pair
    return _ALL_FREE


@leaf
def _before_a_plane(planes: Array, first: int, last: int, before: Vector, after: Vector) -> bool:
    """Whether any of the planes has the whole edge before it."""
    for k in range(first, last):
        x, y, z, limit = planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3]
        if (
            x * before[0] + y * before[1] + z * before[2] <= limit
            and x * after[0] + y * after[1] + z * after[2] <= limit
        ):
            return True
    return False


@leaf
def _enters_core(planes: Array, first: int, last: int, before: Vector, after: Vector) -> bool:
    """Whether some part of the edge is behind all of the planes."""
    low, high = 0.0, 1.0
    for k in range(first, last):
        x, y, z, limit = planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3]
        at_start = x * before[0] + y * before[1] + z * before[2] - limit
        at_end = x * after[0] + y * after[1] + z * after[2] - limit
        if at_start < 0.0:
            if at_end < 0.0:
                return False
            low = max(low, at_start / (at_start - at_end))
        elif at_end < 0.0:
            high = min(high, at_start / (at_start - at_end))
        if low > high:
            return False
    return first < last


@kernel
def _free_over_pulleys(world: World, before: Vector, after: Vector) -> bool:
    platform = len(world.cables)
    for pair in range(len(world.pairs)):
        piece, body = world.pairs[pair, 0], world.pairs[pair, 1]
        if body == platform:
            if not _pair_free(world, piece, body, before, after):
                return False
        elif not pulley_pair_free(world, pair, before, after):
            return False
    return True


@leaf
def _pair_free(world: World, piece: int, body: int, before: Vector, after: Vector) -> bool:
    """Whether a pair keeps its distance, with a fixed exit point."""
    needed = world.bodies[body, 0]
    if body == len(world.bodies) - 1:
        return platform_apart(world, piece, before, after, needed)
    b, c = plus(before, arm(world, body)), plus(after, arm(world, body))
    return cable_apart(world, piece, outlet(world, body), b, c, needed)


@leaf
def _room_at_planes(world: World, pair: int, before: Vector, after: Vector) -> float:
    """A lower bound of the pair's distance, [m], without subtracting the cable's radius."""
    room, body = -np.inf, world.pairs[pair, 1]
    if world.pulley > 0.0 and body < len(world.bodies) - 1:
        return room  # the planes hold for fixed exit points
    for k in range(world.pairs[pair, 2], world.pairs[pair, 3]):
        normal = (world.planes[k, 0], world.planes[k, 1], world.planes[k, 2])
        reach = max(
            normal[0] * before[0] + normal[1] * before[1] + normal[2] * before[2],
            normal[0] * after[0] + normal[1] * after[1] + normal[2] * after[2],
        )
        by_anchor = world.planes[k, 3] + world.bodies[body, 0] - reach
        by_exit = world.planes[k, 4] - world.planes[k, 5]
        room = max(room, min(by_anchor, by_exit))
    return room
