"""Costs and limits of edges, for compiled functions.

The cost is the length, or the integral of the kinematic cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.rig import Rig
from model.scene import Scene
from planner.collision.self_collision_regions import Robot
from planner.costs import KinematicCost
from planner.edge_checks import ExactChecks, edge_problem
from planner.kernels.jit import kernel
from planner.kernels.scene_arrays import World
from planner.settings import MARGIN_RESERVE
from planner.wrench.capacity import LoadArrays
from planner.wrench.translation import Holding

Array = NDArray[np.float64]

_SAMPLING = 0.010


class CostField(NamedTuple):
    """A cost per metre over positions.

    Attributes:
        lower: First point of the lattice, shape (3,), [m].
        spacing: Between its points, shape (3,), [m].
        values: Cost per metre at its points, shape (i, j, k); empty for a constant cost of 1.
    """

    lower: Array
    spacing: Array
    values: Array


def length_field() -> CostField:
    """The cost that is the length."""
    return CostField(np.zeros(3), np.ones(3), np.zeros((0, 0, 0)))


def kinematic_field(cost: KinematicCost) -> CostField:
    """The cost that is the line integral of c = γ_d + γ_f."""
    lattice = cost.lattice
    values = np.ascontiguousarray(cost.values.reshape(lattice.shape))
    return CostField(np.array(lattice.lower), np.array(lattice.spacing), values)


@kernel
def edge_cost(field: CostField, start: Array, end: Array) -> float:
    """Cost of a straight edge between positions, shape (3,): trapezoids of at most 10 mm."""
    dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if field.values.size == 0:
        return length
    parts = max(1, math.ceil(length / _SAMPLING))
    total = 0.0
    for k in range(parts + 1):
        share = k / parts
        value = _at(field, start[0] + share * dx, start[1] + share * dy, start[2] + share * dz)
        total += value / 2.0 if k in (0, parts) else value
    return length * total / parts


@kernel
def _at(field: CostField, x: float, y: float, z: float) -> float:
    """The cost per metre, trilinear between lattice points and constant outside."""
    values = field.values
    i, u = _cell(x, field.lower[0], field.spacing[0], values.shape[0])
    j, v = _cell(y, field.lower[1], field.spacing[1], values.shape[1])
    k, w = _cell(z, field.lower[2], field.spacing[2], values.shape[2])
    low = (values[i, j, k] * (1.0 - w) + values[i, j, k + 1] * w) * (1.0 - v)
    low += (values[i, j + 1, k] * (1.0 - w) + values[i, j + 1, k + 1] * w) * v
    high = (values[i + 1, j, k] * (1.0 - w) + values[i + 1, j, k + 1] * w) * (1.0 - v)
    high += (values[i + 1, j + 1, k] * (1.0 - w) + values[i + 1, j + 1, k + 1] * w) * v
    return low * (1.0 - u) + high * u  # type: ignore[no-any-return]


@kernel
def _cell(at: float, lower: float, spacing: float, points: int) -> tuple[int, float]:
    scaled = (at - lower) / spacing
    cell = min(max(math.floor(scaled), 0), points - 2)
    return cell, min(max(scaled - cell, 0.0), 1.0)


# All limits of an edge, as one argument of compiled functions.


class EdgeLimits(NamedTuple):
    """Limits of edges of one rig at one orientation in one scene; see `ExactChecks`."""

    world: World
    robot: Robot
    load: LoadArrays
    holding: Holding


def exact_checks(rig: Rig, scene: Scene, rotation: Array, reserve: float) -> ExactChecks:
    """The checks of ``scene`` with ``reserve`` [m] on top of its clearances.

    Args:
        rig: The robot.
        scene: Obstacles, clearances and load.
        rotation: Constant orientation, shape (3, 3).
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
