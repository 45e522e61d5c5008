"""Everything an edge must keep, as one argument of compiled functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.exact.capacity import Load
from planner.exact.checks import ExactChecks, edge_problem
from planner.exact.compiled import kernel
from planner.exact.fields import World
from planner.exact.holding import Holding
from planner.exact.self_region import Robot
from planner.settings import MARGIN_RESERVE

Array = NDArray[np.float64]


class Limits(NamedTuple):
    """What edges of one rig at one orientation in one scene must keep; see `ExactChecks`."""

    world: World
    robot: Robot
    load: Load
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


def limits_of(checks: ExactChecks) -> Limits:
    """The same checks for compiled functions."""
    return Limits(checks.world, checks.robot, checks.load, checks.holding)


@kernel
def problem(limits: Limits, start: Array, end: Array) -> int:
    """Why the straight edge between two positions, shape (3,), is refused; 0 if it is not."""
    return edge_problem(limits.world, limits.robot, limits.load, limits.holding, start, end)
