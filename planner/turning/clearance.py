"""The distance of the whole robot to the obstacles at one pose, with any orientation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.exits import exit_point
from planner.exact.fields import World, anchor
from planner.exact.pair import place_corners, points_distance
from planner.exact.vectors import Vector, dot, plus, row, turned

Array = NDArray[np.float64]


@kernel
def pose_clearance(world: World, position: Vector, rotation: Array, enough: float) -> float:
    """Smallest distance of any body to any obstacle, [m]; 0 or less where they touch.

    From ``enough`` on any value at least that is returned. The definition is
    `cdpr.clearance.ClearanceModel`.

    Args:
        world: Where; its own rotation is not used.
        position: World frame, [m].
        rotation: ``world_from_platform``, shape (3, 3).
        enough: [m].
    """
    least, platform = enough, len(world.bodies) - 1
    corners, lines = np.empty((8, 3)), np.empty((platform, 2, 3))
    place_corners(world, rotation, position, corners)
    for cable in range(platform):
        at = plus(position, turned(rotation, anchor(world, cable)))
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
