"""Everything an edge must keep, as one argument of compiled functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.rig import Rig
from model.scene import Scene
from planner.collision.self_collision_regions import Robot
from planner.edge_checks import ExactChecks, edge_problem
from planner.kernels.jit import kernel
from planner.kernels.scene_arrays import World
from planner.settings import MARGIN_RESERVE
from planner.wrench.capacity import LoadArrays
from planner.wrench.translation import Holding

Array = NDArray[np.float64]


class EdgeLimits(NamedTuple):
    """What edges of one rig at one orientation in one scene must keep; see `ExactChecks`."""

    world: World
    robot: Robot
    load: LoadArrays
    holding: Holding


def exact_checks(rig: Rig, scene: Scene, rotation: Array, reserve: float) -> ExactChecks:
    """The checks of ``scene`` with ``reserve`` [m] on top of its clearances.

    Args:
        rig: The robot.
        scene: Obstacles, clearances and load.
        rotation: Orientation that is kept, shape (3, 3).
        reserve: [m].
    """
    return ExactChecks(
        rig,
        scene,
        rotation,
        obstacle_clearance=scene.obstacle_clearance + reserve,
        self_clearance=scene.self_clearance + reserve,
        margin_reserve=MARGIN_RESERVE * rig.max_tension,
    )


def limits_of(checks: ExactChecks) -> EdgeLimits:
    """The same checks for compiled functions."""
    return EdgeLimits(checks.world, checks.robot, checks.load, checks.holding)


@kernel
def problem(limits: EdgeLimits, start: Array, end: Array) -> int:
    """Why the straight edge between two positions, shape (3,), is refused; 0 if it is not."""
    return edge_problem(limits.world, limits.robot, limits.load, limits.holding, start, end)
