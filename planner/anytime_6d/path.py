"""From start to goal with the platform free to turn: rounds until the budget is spent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from model.errors import BadInput, NoSolution
from model.rig import Rig
from model.scene import Scene
from planner.anytime_6d.problem import RotatingProblem, build_objective
from planner.anytime_6d.rounds import RotatingSearch
from planner.collision.self_collision import build_robot
from planner.collision.world import build_world
from planner.costs import KinematicCost
from planner.edge_checks import REASONS
from planner.path import LEAST_ROUNDS_WITH_LIMIT, LengthLimit, Progress, Route
from planner.settings import (
    CLEARANCE_RESERVE,
    LEAST_ROUNDS,
    MARGIN_RESERVE,
    TurningSettings,
    Weights,
)
from planner.space import PoseSpace
from planner.wrench.capacity import build_load

Clock = Callable[[], float]

_TELL_EVERY = 20
_ROTATION_ROUND_OFF = 5e-8
"""Added to the rotation limits, [rad]: half of what the check leaves for round-off in files."""


@dataclass(frozen=True, slots=True, eq=False)
class TurningRoute:
    """A route, and what it takes to find it again.

    Attributes:
        route: The path in `planner.space.PoseSpace`.
        rounds: How many were done; `TurningSettings.rounds` repeats them.
        search_time: [s].
    """

    route: Route
    rounds: int
    search_time: float


def turning_problem(
    rig: Rig, scene: Scene, weights: Weights, kinematic: KinematicCost
) -> RotatingProblem:
    """The problem of a scene, with the reserves that `planner.settings` documents.

    Raises:
        BadInput: The scene has no rotation limits.
    """
    limits = scene.rotation_limits
    if limits is None:
        raise BadInput(
            "the scene has no limits for rotation",
            where=f"scene {scene.name}",
            why="--free-rotation searches orientations within the scene's rotation_limits",
            next_step="add a line such as `rotation_limits: {tilt_deg: 10, turn_deg: 30}`",
        )
    rotation = np.array(scene.start.rotation)
    world = build_world(rig, scene, rotation, scene.obstacle_clearance + CLEARANCE_RESERVE)
    return RotatingProblem(
        world=world,
        robot=build_robot(rig, world, scene.self_clearance + CLEARANCE_RESERVE),
        load=build_load(rig, scene, rotation),
        reserve=MARGIN_RESERVE * rig.max_tension,
        tilt=limits.tilt + _ROTATION_ROUND_OFF,
        turn=limits.turn + _ROTATION_ROUND_OFF,
        objective=build_objective(weights, kinematic),
    )


def turning_route(
    rig: Rig,
    scene: Scene,
    settings: TurningSettings,
    kinematic: KinematicCost,
    progress: Progress | None = None,
    clock: Clock = time.perf_counter,
) -> TurningRoute:
    """Searches and improves.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, rotation limits, start and goal.
        settings: Objective, seed and budget.
        kinematic: The cost of poses at the start's orientation, which gives its scaling.
        progress: Called with the time spent [s] and the budget, or rounds, and the cost.
        clock: Seconds; decides when a budget is spent.

    Raises:
        BadInput: The scene has no rotation limits.
        NoSolution: No path was found, or none is short enough.
    """
    problem = turning_problem(rig, scene, settings.weights, kinematic)
    space = PoseSpace(rig)
    start, goal = space.coordinates(scene.start), space.coordinates(scene.goal)
    _load(RotatingSearch(problem, start, goal, settings.seed), settings.weights)
    search, began = RotatingSearch(problem, start, goal, settings.seed), clock()
    limit = None
    if settings.longest < math.inf:
        limit = LengthLimit(settings.longest, _unit(settings.weights, kinematic))
    spent = 0.0
    while not _is_over(settings, search, spent):
        search.advance()
        if limit is not None:
            _tell_limit(limit, search, settings.weights)
        spent = clock() - began
        if progress is not None and search.rounds % _TELL_EVERY == 0:
            settings.tell(progress, search.rounds, spent, search.cost)
    path = search.path if limit is None else limit.path
    if path is None:
        raise _no_path(scene, search, settings)
    route = Route(
        path=path,
        raw=search.first,
        nodes=search.first,
        parents=np.arange(-1, len(search.first) - 1, dtype=np.int64),
        iterations=search.rounds,
        edge_checks=int(search.tallies.sum()),
    )
    return TurningRoute(route, search.rounds, clock() - began)


def _load(search: RotatingSearch, weights: Weights) -> None:
    """Calls what the rounds call: machine code is made, or loaded, when it is called first."""
    search.advance()
    search.cost_by(weights)


def _unit(weights: Weights, kinematic: KinematicCost) -> float:
    """What a metre of a usual path costs."""
    return weights.length + weights.kinematic * float(kinematic.values.mean())


def _tell_limit(limit: LengthLimit, search: RotatingSearch, weights: Weights) -> None:
    """Passes the best path to the limit, and applies the price that it sets."""
    path = search.path
    if path is None:
        return
    if limit.after_round(path, search.length, lambda: search.cost_by(weights)):
        search.weigh(replace(weights, length=weights.length + limit.price))


def _is_over(settings: TurningSettings, search: RotatingSearch, spent: float) -> bool:
    if settings.weights.is_length and search.cost <= search.shortest * (1.0 + 1e-12):
        return True
    least = LEAST_ROUNDS if settings.longest == math.inf else LEAST_ROUNDS_WITH_LIMIT
    return settings.is_over(search.rounds, spent, least)


def _no_path(scene: Scene, search: RotatingSearch, settings: TurningSettings) -> NoSolution:
    names = (*REASONS, "rotation limits")
    refused = [
        (int(count), name)
        for count, name in zip(search.tallies, names, strict=True)
        if name and count
    ]
    listed = ", ".join(f"{name} ({count})" for count, name in sorted(refused, reverse=True))
    gap = search.gap()
    values: dict[str, float | str] = {
        "rounds": float(search.rounds),
        "seed": float(settings.seed),
        "best_distance_mm": gap * 1e3,
    }
    if search.path is not None:
        return settings.too_long(f"scene {scene.name}", search.length, search.shortest, values)
    return NoSolution(
        settings.not_found(search.rounds, gap),
        where=f"scene {scene.name}",
        why=f"it is not proved that no path exists; moves were refused for: {listed}",
        next_step=f"{settings.longer}, reduce the clearance, widen rotation_limits, try"
        " another seed, or move the goal or an obstacle",
        values=values,
    )
