"""All limits of an edge in one call: the exact checks as the planner calls them."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.collision.edges import edge_clearance, in_workspace, obstacles_free
from planner.collision.rotating_edges import rotating_edge_free
from planner.collision.self_collision_regions import Robot
from planner.collision.world import (
    build_robot,
    build_world,
    self_edge_free,
    self_rotating_edge_free,
)
from planner.kernels.jit import kernel
from planner.kernels.scene_arrays import World
from planner.wrench.capacity import LoadArrays, build_load
from planner.wrench.rotation import rotating_edge_held
from planner.wrench.translation import Holding, build_holding, edge_held

FREE: Final = 0
WORKSPACE: Final = 1
OBSTACLE: Final = 2
SELF: Final = 3
WRENCH: Final = 4
REASONS: Final = ("", "workspace", "obstacle clearance", "self clearance", "wrench feasibility")
"""Reasons why edges are refused, indexed by these numbers."""


@kernel
def edge_problem(
    world: World, robot: Robot, load: LoadArrays, holding: Holding, start: Array, end: Array
) -> int:
    """What forbids a translation: `FREE`, `WORKSPACE`, `OBSTACLE`, `SELF` or `WRENCH`.

    Never `FREE` where any limit is violated anywhere along the edge.

    Args:
        world: Rig, orientation and obstacles.
        load: What the cables must hold.
        holding: Where that is already proved.
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].
    """
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    if not (in_workspace(world, before) and in_workspace(world, after)):
        return WORKSPACE
    if not obstacles_free(world, before, after):
        return OBSTACLE
    if not self_edge_free(world, robot, start, end):
        return SELF
    if not edge_held(world, load, holding, start, end):
        return WRENCH
    return FREE


@kernel
def rotating_edge_problem(
    world: World,
    robot: Robot,
    load: LoadArrays,
    reserve: float,
    start: Array,
    end: Array,
    rotation: Array,
    turn: Array,
) -> int:
    """What forbids a straight move with a steady rotation; see `edge_problem`.

    Args:
        load: What the cables must hold.
        reserve: Smallest capacity margin, [N].
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].
        rotation: ``world_from_platform`` at the start, shape (3, 3).
        turn: Rotation vector from start to end, platform frame, shape (3,), [rad].
    """
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    if not (in_workspace(world, before) and in_workspace(world, after)):
        return WORKSPACE
    if not rotating_edge_free(world, start, end, rotation, turn):
        return OBSTACLE
    if not self_rotating_edge_free(world, robot, start, end, rotation, turn):
        return SELF
    if not rotating_edge_held(world, load, reserve, start, end, rotation, turn):
        return WRENCH
    return FREE


class ExactChecks:
    """The exact checks of one rig in one scene, for callers that are not compiled.

    Attributes:
        world: Rig and obstacles; this and the others are for compiled callers.
        robot: Self clearance, proved over the workspace as far as possible.
        load: What the cables must hold.
        holding: The cells of the workspace in which that is proved.
    """

    def __init__(
        self,
        rig: Rig,
        scene: Scene,
        rotation: Array,
        *,
        obstacle_clearance: float,
        self_clearance: float,
        margin_reserve: float,
    ) -> None:
        """Computes planes and proofs once.

        Args:
            rotation: Orientation under translation, ``world_from_platform``, shape (3, 3).
            obstacle_clearance: Of cables and platform to obstacles, [m].
            self_clearance: Between cables and of cables to the platform, [m].
            margin_reserve: Smallest allowed capacity margin, [N].

        Raises:
            BadInput: A clearance is negative or not finite.
        """
        self.world: World = build_world(rig, scene, rotation, obstacle_clearance)
        self.robot: Robot = build_robot(rig, self.world, self_clearance)
        self.load: LoadArrays = build_load(rig, scene, rotation)
        self.holding: Holding = build_holding(self.world, self.load, float(margin_reserve))

    def problem(self, start: ArrayLike, end: ArrayLike) -> int:
        """What forbids a translation between positions, shape (3,), [m]; see `edge_problem`."""
        args = (self.world, self.robot, self.load, self.holding)
        return int(edge_problem(*args, _own(start), _own(end)))

    def clearance(self, start: ArrayLike, end: ArrayLike) -> tuple[float, int, int]:
        """Smallest distance to an obstacle along a translation, [m], its body and obstacle."""
        distance, body, obstacle = edge_clearance(self.world, _own(start), _own(end))
        return float(distance), int(body), int(obstacle)


def _own(values: ArrayLike) -> Array:
    """A writable copy: read-only arrays would be compiled separately."""
    return np.array(values, dtype=np.float64, order="C")
