"""Input of a compiled search: where edges are allowed, and what they cost.

Its arrays are built from rig, scene and weights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.collision.edges import edge_clearance, in_workspace, obstacles_free
from planner.collision.self_collision_regions import Robot
from planner.collision.world import build_robot, build_world, is_open, self_edge_free
from planner.costs import KinematicCost, margin_reserve
from planner.kernels.jit import inlined, kernel, leaf, stored
from planner.kernels.primitives import Vector, along, minus, norm
from planner.kernels.scene_arrays import World
from planner.settings import CLEARANCE_RESERVE, Weights
from planner.space import Lattice, corners_and_weights
from planner.wrench.capacity import LoadArrays, build_load, margins
from planner.wrench.translation import Holding, box_held, build_holding, edge_held

# Trilinear interpolation on a regular lattice, compiled; `planner.space` is its definition.


@leaf
def interpolated(grid: Array, values: Array, point: Vector) -> float:
    """The value at a point; outside the lattice that of the nearest point on its border.

    Args:
        grid: Lower corner and spacing, shape (2, 3), [m].
        values: At the lattice's points, shape (i, j, k), each at least 2.
        point: World frame, [m].
    """
    x, i = _cell(point[0], grid[0, 0], grid[1, 0], values.shape[0])
    y, j = _cell(point[1], grid[0, 1], grid[1, 1], values.shape[1])
    z, k = _cell(point[2], grid[0, 2], grid[1, 2], values.shape[2])
    low = values[i, j, k] * (1.0 - z) + values[i, j, k + 1] * z
    high = values[i, j + 1, k] * (1.0 - z) + values[i, j + 1, k + 1] * z
    front = low * (1.0 - y) + high * y
    low = values[i + 1, j, k] * (1.0 - z) + values[i + 1, j, k + 1] * z
    high = values[i + 1, j + 1, k] * (1.0 - z) + values[i + 1, j + 1, k + 1] * z
    return front * (1.0 - x) + (low * (1.0 - y) + high * y) * x  # type: ignore[no-any-return]


@leaf
def _cell(value: float, lower: float, spacing: float, count: int) -> tuple[float, int]:
    """Position within a cell, 0 … 1, and the index of the cell, along one axis."""
    scaled = (value - lower) / spacing
    scaled = min(max(scaled, 0.0), count - 1.0)
    cell = min(int(scaled), count - 2)
    return scaled - cell, cell


LENGTH, KINEMATIC, CLEARANCE, CAPACITY, VERTEX, UNIT, LEAST_MARGIN = 0, 1, 2, 3, 4, 5, 6
"""Indices into `PathProblem.terms`."""

NO_MARGIN = -math.inf
"""As the least margin: interpolated margins are ignored."""
ASK_PROOF = math.inf
"""As the least margin: every edge is proved wrench-feasible, which takes long."""

_SAMPLING = 0.010
"""Spacing of samples of values on the grid, [m]: less than half of the grid's."""
_CLEARANCE_SAMPLING = 0.020
"""Spacing of positions at which the clearance of cables on pulleys is computed, [m]."""


class PathProblem(NamedTuple):
    """One question to the planner.

    Attributes:
        world: Obstacles and workspace, with the clearance that edges must keep.
        robot: The self clearance that edges must keep.
        load: The wrenches that must be held on edges.
        holding: Where in the workspace that is proved.
        grid: Lower corner of the lattice and its spacing, shape (2, 3), [m].
        kinematic: The cost c = γ_d + γ_f at the lattice's points, shape (i, j, k).
        margins: Capacity margins there, shape (i, j, k), [N].
        terms: Weights of length, ∫c ds, smallest clearance and smallest margin in the cost (the
            last two reduce it); least saving of an extra vertex; typical cost of a metre; and the
            least margin of interpolated samples of an edge, or `NO_MARGIN`, or `ASK_PROOF`,
            shape (7,).
    """

    world: World
    robot: Robot
    load: LoadArrays
    holding: Holding
    grid: Array
    kinematic: Array
    margins: Array
    terms: Array


@inlined
def edge_allowed(problem: PathProblem, start: Vector, end: Vector) -> bool:
    """Whether an edge keeps every limit: workspace, clearances, wrench feasibility."""
    world, robot = problem.world, problem.robot
    if not (in_workspace(world, start) and in_workspace(world, end)):
        return False
    if not obstacles_free(world, start, end):
        return False
    if is_open(world, robot, start, end) and not _keeps_off(problem, start, end):
        return False
    least = problem.terms[LEAST_MARGIN]
    if least == NO_MARGIN:
        return True
    margin = lowest_margin(problem.grid, problem.margins, start, end)
    if least < ASK_PROOF or margin < 0.0:  # clearly infeasible: not worth a proof
        return bool(margin >= least)
    return _is_held(problem, start, end)


@kernel
def _keeps_off(problem: PathProblem, start: Vector, end: Vector) -> bool:
    return self_edge_free(problem.world, problem.robot, np.array(start), np.array(end))


@kernel
def _is_held(problem: PathProblem, start: Vector, end: Vector) -> bool:
    before, after = np.array(start), np.array(end)
    return edge_held(problem.world, problem.load, problem.holding, before, after)


@leaf
def lowest_margin(grid: Array, margins: Array, start: Vector, end: Vector) -> float:
    """The smallest interpolated capacity margin at samples of an edge, [N]."""
    delta = minus(end, start)
    steps = math.ceil(norm(delta) / _SAMPLING) + 1
    least = math.inf
    for i in range(steps + 1):
        at = along(start, delta, i / steps)
        least = min(least, interpolated(grid, margins, at))
    return least


@leaf
def edge_cost(problem: PathProblem, start: Vector, end: Vector) -> float:
    """The cost of an edge: weighted length and integral of c, [m]."""
    delta = minus(end, start)
    length = norm(delta)
    cost = problem.terms[LENGTH] * length
    weight = problem.terms[KINEMATIC]
    if weight == 0.0:
        return float(cost)
    steps = math.ceil(length / _SAMPLING) + 1
    total = 0.0
    for i in range(steps):  # midpoints of equal parts
        at = along(start, delta, (i + 0.5) / steps)
        total += interpolated(problem.grid, problem.kinematic, at)
    return float(cost + weight * total * length / steps)


@leaf
def edge_lows(problem: PathProblem, start: Vector, end: Vector) -> tuple[float, float]:
    """Smallest clearance [m] and margin [N] of an edge; infinite where they have no weight."""
    clearance, margin = math.inf, math.inf
    if problem.terms[CLEARANCE] > 0.0:
        clearance = _clearance(problem.world, start, end)
    if problem.terms[CAPACITY] > 0.0:
        margin = lowest_margin(problem.grid, problem.margins, start, end)
    return clearance, margin


@kernel
def _clearance(world: World, start: Vector, end: Vector) -> float:
    """Smallest clearance of an edge, [m], for the cost: exact, or at samples with pulleys."""
    if world.pulley == 0.0:
        return float(edge_clearance(world, np.array(start), np.array(end))[0])
    delta, least = minus(end, start), math.inf
    steps = math.ceil(norm(delta) / _CLEARANCE_SAMPLING) + 1
    for i in range(steps + 1):
        at = np.array(along(start, delta, i / steps))
        least = min(least, edge_clearance(world, at, at)[0])
    return least


@leaf
def gained(weights: Array, clearance: float, margin: float) -> float:
    """The amount by which a path's smallest clearance and margin reduce its cost."""
    gain = 0.0
    if weights[CLEARANCE] > 0.0 and clearance < math.inf:
        gain += weights[CLEARANCE] * clearance
    if weights[CAPACITY] > 0.0 and margin < math.inf:
        gain += weights[CAPACITY] * margin
    return gain


# The arrays of the compiled search, built from rig, scene and weights.


_CELLS = (16, 16, 16)
_FEW = 64
"""Most unproved cells of the workspace for which smaller parts are tried."""
_PARTS = 4
_FAR_FROM_LIMIT = 5.0
"""Times the reserve: for margins as large as this, interpolation seldom misleads."""
_OF_AN_END = 0.9


def problem_of(rig: Rig, scene: Scene, weights: Weights, kinematic: KinematicCost) -> PathProblem:
    """The problem of a scene, with the reserves that `planner.settings` documents.

    Args:
        scene: Obstacles, clearances, load; its start gives the orientation.
        kinematic: The cost of poses at that orientation.
    """
    rotation = np.array(scene.start.rotation)
    world = build_world(rig, scene, rotation, scene.obstacle_clearance + CLEARANCE_RESERVE)
    load = build_load(rig, scene, rotation)
    lattice = kinematic.lattice
    key = [world.limits, world.platform, world.pulley, world.cables, *load]
    reserve = margin_reserve(rig, scene.load, turns=False)
    cells = stored("holding", [*key, reserve], _CELLS, lambda: _proved_cells(world, load, reserve))
    holding = Holding(reserve, cells, bool(cells.all()))
    capacity = np.zeros(lattice.shape)
    if weights.capacity > 0.0 or not holding.everywhere:
        points = lattice.points(np.arange(lattice.count))
        capacity = stored(
            "margins",
            [*key, lattice.lower, lattice.spacing],
            lattice.shape,
            lambda: margins(world, load, points).reshape(lattice.shape),
        )
    problem = PathProblem(
        world=world,
        robot=build_robot(rig, world, scene.self_clearance + CLEARANCE_RESERVE),
        load=load,
        holding=holding,
        grid=np.stack([lattice.lower, lattice.spacing]),
        kinematic=np.ascontiguousarray(kinematic.values.reshape(lattice.shape)),
        margins=np.ascontiguousarray(capacity),
        terms=np.zeros(7),
    )
    set_weights(problem, weights)
    ends = np.array([scene.start.position, scene.goal.position])
    problem.terms[LEAST_MARGIN] = _least_margin(holding, lattice, capacity, ends)
    return problem


def _least_margin(holding: Holding, lattice: Lattice, capacity: Array, ends: Array) -> float:
    """The least interpolated margin during a search; finished paths are always proved.

    Lower where an end, shape (2, 3), [m], has less, since a path has to leave it.
    """
    least = _FAR_FROM_LIMIT * holding.reserve
    if holding.everywhere or float(capacity.min()) >= least:
        return NO_MARGIN
    corners, weights = corners_and_weights(lattice, ends)
    there = np.sum(capacity.ravel()[corners] * weights, axis=1)
    return min(least, _OF_AN_END * float(there.min()))


def set_weights(problem: PathProblem, weights: Weights) -> None:
    """Changes the objective of a problem in place."""
    problem.terms[:4] = weights.length, weights.kinematic, weights.clearance, weights.capacity
    typical = float(problem.kinematic.mean())
    problem.terms[UNIT] = weights.length + weights.kinematic * typical


def _proved_cells(world: World, load: LoadArrays, reserve: float) -> NDArray[np.bool_]:
    """Proved cells of the workspace box; a few remaining ones are tried in smaller parts."""
    cells = build_holding(world, load, reserve).cells
    left = np.argwhere(~cells)
    if len(left) <= _FEW:
        size = (world.limits[1] - world.limits[0]) / _CELLS
        for cell in left:
            lower = world.limits[0] + cell * size
            cells[tuple(cell)] = _proved_in_parts(world, load, reserve, lower, size, 2)
    return cells


def _proved_in_parts(
    world: World, load: LoadArrays, reserve: float, lower: Array, size: Array, depth: int
) -> bool:
    if box_held(world, load, reserve, np.concatenate([lower, lower + size])):
        return True
    part = size / _PARTS
    return depth > 0 and all(
        _proved_in_parts(world, load, reserve, lower + np.array(k) * part, part, depth - 1)
        for k in np.ndindex(_PARTS, _PARTS, _PARTS)
    )
