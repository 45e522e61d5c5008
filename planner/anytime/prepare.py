"""From rig, scene and weights to the arrays that the compiled search reads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.anytime.problem import LEAST_MARGIN, NO_MARGIN, UNIT, PathProblem
from planner.array_cache import stored
from planner.collision.self_collision import build_robot
from planner.collision.world import build_world
from planner.costs import KinematicCost
from planner.kernels.scene_arrays import World
from planner.settings import CLEARANCE_RESERVE, MARGIN_RESERVE, Weights
from planner.space import Lattice, corners_and_weights
from planner.wrench.capacity import LoadArrays, build_load, margins
from planner.wrench.translation import Holding, box_held, build_holding

_CELLS = (16, 16, 16)
_FEW = 64
"""Cells of the workspace left unproved that are worth proving in smaller parts."""
_PARTS = 4
_FAR_FROM_LIMIT = 5.0
"""Times the reserve: where margins are as large as this, their interpolation misleads seldom."""
_OF_AN_END = 0.9


def problem_of(rig: Rig, scene: Scene, weights: Weights, kinematic: KinematicCost) -> PathProblem:
    """The problem of a scene, with the reserves that `planner.settings` documents.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load; its start gives the orientation.
        weights: Of what is made small.
        kinematic: The cost of poses at that orientation.
    """
    rotation = np.array(scene.start.rotation)
    world = build_world(rig, scene, rotation, scene.obstacle_clearance + CLEARANCE_RESERVE)
    load = build_load(rig, scene, rotation)
    lattice = kinematic.lattice
    key = [rig.plan_hash, scene.document.load.model_dump(mode="json"), rotation.tolist()]
    reserve = MARGIN_RESERVE * rig.max_tension
    cells = stored("holding", [*key, reserve], _CELLS, lambda: _proved_cells(world, load, reserve))
    holding = Holding(reserve, cells, bool(cells.all()))
    capacity = np.zeros(lattice.shape)
    if weights.capacity > 0.0 or not holding.everywhere:
        points = lattice.points(np.arange(lattice.count))
        capacity = stored(
            "margins",
            key,
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
    """What interpolated margins must keep while searching; finished paths are always proved.

    Less where an end, shape (2, 3), [m], has no more: a path has to leave it.
    """
    least = _FAR_FROM_LIMIT * holding.reserve
    if holding.everywhere or float(capacity.min()) >= least:
        return NO_MARGIN
    corners, weights = corners_and_weights(lattice, ends)
    there = np.sum(capacity.ravel()[corners] * weights, axis=1)
    return min(least, _OF_AN_END * float(there.min()))


def set_weights(problem: PathProblem, weights: Weights) -> None:
    """Changes what a problem makes small, in place."""
    problem.terms[:4] = weights.length, weights.kinematic, weights.clearance, weights.capacity
    typical = float(problem.kinematic.mean())
    problem.terms[UNIT] = weights.length + weights.kinematic * typical


def _proved_cells(world: World, load: LoadArrays, reserve: float) -> NDArray[np.bool_]:
    """Cells of the workspace box; where only few are left, those in smaller parts too."""
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
