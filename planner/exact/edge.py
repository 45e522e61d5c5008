"""Edges of pure translation: obstacles and workspace, exact from end to end.

For every pair of a body and a piece the planes made beforehand are tried; only where none of them
has the whole edge before it is the closed form asked. Cables over pulleys, whose exits move, go to
`planner.exact.moving_edge`, which also knows edges with rotation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.moving_edge import pulley_clearance, pulley_pair_free
from planner.exact.pair import cable_apart, cable_distance, platform_apart, platform_distance
from planner.exact.vectors import Vector, plus, row
from planner.exact.world import World

Array = NDArray[np.float64]

_AT_THE_WALL = 1e-9
"""How far past the workspace box a position may be, [m]: round-off of files and frames."""


@kernel
def edge_free(world: World, start: Array, end: Array) -> bool:
    """Whether the platform may be translated from ``start`` to ``end``, shape (3,) each, [m].

    It stays in the workspace box, and platform and cables keep the clearance to every obstacle.
    Never yes where that is untrue; no, too, where the distance is within round-off of the needed.
    """
    before = (start[0], start[1], start[2])
    after = (end[0], end[1], end[2])
    if not (in_workspace(world, before) and in_workspace(world, after)):
        return False
    return obstacles_free(world, before, after)


@kernel
def edges_free(world: World, starts: Array, ends: Array) -> NDArray[np.bool_]:
    """`edge_free` for many edges, shape (k, 3) each, [m]; shape (k,)."""
    free = np.empty(len(starts), dtype=np.bool_)
    for i in range(len(starts)):
        free[i] = edge_free(world, starts[i], ends[i])
    return free


@kernel
def points_free(world: World, positions: Array) -> NDArray[np.bool_]:
    """Whether the platform may be at positions, shape (k, 3), [m]; shape (k,)."""
    free = np.empty(len(positions), dtype=np.bool_)
    for i in range(len(positions)):
        free[i] = edge_free(world, positions[i], positions[i])
    return free


@kernel
def edge_clearance(world: World, start: Array, end: Array) -> tuple[float, int, int]:
    """The smallest distance of any body to any obstacle along an edge, exact.

    Args:
        world: Where.
        start: World frame, shape (3,), [m].
        end: Likewise.

    Returns:
        The distance between surfaces, [m], 0 or less where they touch and infinite without
        obstacles; the number of the body (m for the platform); the number of the obstacle.
    """
    before, after = row_of(start), row_of(end)
    bodies = len(world.radii)
    least, body_found, owner_found = np.inf, -1, -1
    for piece in range(len(world.kinds)):
        for body in range(bodies):
            radius = world.radii[body]
            pair = piece * bodies + body
            if _room_at_planes(world, pair, body, before, after) - radius >= least:
                continue
            if body == bodies - 1:
                found = platform_distance(world, piece, before, after, least)
            elif world.pulley > 0.0:
                found = pulley_clearance(world, piece, body, before, after, least + radius)
            else:
                arm = row(world.arms, body)
                found = cable_distance(
                    world,
                    piece,
                    row(world.outlets, body),
                    plus(before, arm),
                    plus(after, arm),
                    least + radius,
                )
            if found - radius < least:
                least, body_found, owner_found = found - radius, body, world.owners[piece]
    return least, body_found, owner_found


@kernel
def row_of(point: Array) -> Vector:
    """An array of shape (3,) as a vector."""
    return (point[0], point[1], point[2])


@kernel
def in_workspace(world: World, position: Vector) -> bool:
    """Whether a position, and nothing that is not a number, is in the workspace box."""
    for axis in range(3):
        if not (
            world.lower[axis] - _AT_THE_WALL <= position[axis] <= world.upper[axis] + _AT_THE_WALL
        ):
            return False
    return True


@kernel
def obstacles_free(world: World, before: Vector, after: Vector) -> bool:
    """Whether all bodies keep what they need to all obstacles between two positions."""
    bodies = len(world.needed)
    planes = world.planes
    for piece in range(len(world.kinds)):
        for body in range(bodies):
            pair = piece * bodies + body
            if world.pulley > 0.0 and body < bodies - 1:
                if not pulley_pair_free(world, piece, body, before, after):
                    return False
                continue
            proved = False
            for k in range(world.first_plane[pair], world.first_plane[pair + 1]):
                x, y, z, limit = planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3]
                if (
                    x * before[0] + y * before[1] + z * before[2] <= limit
                    and x * after[0] + y * after[1] + z * after[2] <= limit
                ):
                    proved = True
                    break
            if not proved and not _pair_free(world, piece, body, before, after):
                return False
    return True


@kernel
def _pair_free(world: World, piece: int, body: int, before: Vector, after: Vector) -> bool:
    needed = world.needed[body]
    if body == len(world.needed) - 1:
        return platform_apart(world, piece, before, after, needed)
    arm = row(world.arms, body)
    exit = row(world.outlets, body)
    return cable_apart(world, piece, exit, plus(before, arm), plus(after, arm), needed)


@kernel
def _room_at_planes(
    world: World, pair: int, body: int, before: Vector, after: Vector
) -> float:
    """A lower bound of the pair's distance, [m], the radius of the cable not taken off."""
    room = -np.inf
    if world.pulley > 0.0 and body < len(world.needed) - 1:
        return room  # the planes hold for exits that stay
    for k in range(world.first_plane[pair], world.first_plane[pair + 1]):
        normal = (world.planes[k, 0], world.planes[k, 1], world.planes[k, 2])
        reach = max(
            normal[0] * before[0] + normal[1] * before[1] + normal[2] * before[2],
            normal[0] * after[0] + normal[1] * after[1] + normal[2] * after[2],
        )
        by_anchor = world.planes[k, 3] + world.needed[body] - reach
        by_exit = world.planes[k, 4] - world.planes[k, 5]
        room = max(room, min(by_anchor, by_exit))
    return room
