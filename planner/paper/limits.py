"""Everything an edge must keep, compiled, with the reason why one is refused."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.exact.compiled import kernel
from planner.exact.edge import edge_clearance, in_workspace, obstacles_free, row_of
from planner.exact.fields import World
from planner.exact.self_edge import build_robot, self_edge_free
from planner.exact.self_region import Robot
from planner.exact.world import build_world

Array = NDArray[np.float64]

FREE, WORKSPACE, OBSTACLE, SELF, WRENCH = range(5)
REASONS = ("", "workspace", "obstacle clearance", "self clearance", "wrench feasibility")


class Limits(NamedTuple):
    """What edges of one rig at one orientation in one scene must keep.

    Attributes:
        world: Obstacles and workspace.
        robot: Self clearance.
    """

    world: World
    robot: Robot


def build_limits(rig: Rig, scene: Scene, rotation: Array, reserve: float) -> Limits:
    """The limits of ``scene`` with ``reserve`` [m] on top of its clearances.

    Args:
        rig: The robot.
        scene: Obstacles, clearances and load.
        rotation: Orientation that is kept, shape (3, 3).
        reserve: [m].
    """
    world = build_world(rig, scene, rotation, scene.obstacle_clearance + reserve)
    return Limits(world, build_robot(rig, world, scene.self_clearance + reserve))


@kernel
def problem(limits: Limits, start: Array, end: Array) -> int:
    """Why the straight edge between two positions, shape (3,), is refused; `FREE` if it is not."""
    before, after = row_of(start), row_of(end)
    if not (in_workspace(limits.world, before) and in_workspace(limits.world, after)):
        return WORKSPACE
    if not obstacles_free(limits.world, before, after):
        return OBSTACLE
    if not self_edge_free(limits.world, limits.robot, start, end):
        return SELF
    return FREE


@kernel
def blocked_by(limits: Limits, start: Array, end: Array) -> tuple[int, int]:
    """The body (m for the platform) and the obstacle that are nearest along an edge."""
    _, body, owner = edge_clearance(limits.world, start, end)
    return body, owner
