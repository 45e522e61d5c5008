"""From a goal to a sealed plan: search, post-processing, check, figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import accumulate
from typing import Any, Literal

import numpy as np

from model.errors import (
    BadInput,
    CdprError,
    Fault,
    NoSolution,
    require_text,
    require_types,
    sequence_of,
)
from model.files.documents import PoseDocument
from model.files.plan_file import PlanDocument
from model.files.scene_file import StopDocument
from model.plan import Plan, plan_from_document, sealed
from model.pose import Array, Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Leg, Scene, legs_of, require_unaltered
from planner.check import check_path
from planner.check_report import CheckReport, PlanRejected
from planner.costs import KinematicCost
from planner.endpoints import (
    require_feasible_length,
    require_limits_not_searched,
    require_usable_ends,
)
from planner.kernels.jit import planner_compilation
from planner.path import Progress, Route
from planner.settings import (
    AnytimeSettings,
    OptimalSettings,
    PlannerSettings,
    Settings,
    TurningSettings,
    whole_number,
)
from planner.space import PoseSpace, Space, TranslationSpace

# The whole path through a scene: its legs planned one after the other, and joined.


_LONG = 1000.0
"""Milliseconds or rounds from which the progress of a search is reported."""


@dataclass(frozen=True, slots=True, eq=False)
class MultiSegmentPath:
    """A route through all stops.

    Attributes:
        route: From start to goal; its tree has a root for each leg.
        stops: Indices of the path's points at stops.
        iterations: Of each leg; see `Route`.
    """

    route: Route
    stops: tuple[int, ...]
    iterations: tuple[int, ...]


def plan_segments(
    rig: Rig,
    legs: Sequence[Leg],
    settings: Sequence[Settings],
    kinematic: KinematicCost,
    progress: Progress | None,
    clock: Callable[[], float],
) -> MultiSegmentPath:
    """Plans every leg with its own load.

    Args:
        legs: In order.
        settings: Planner and settings of each leg.
        kinematic: The cost of poses at the legs' orientation.
        progress: Called with the progress of each leg's search.

    Raises:
        NoSolution: A leg has no path, or its search ended at its limit; the error names the leg.
    """
    routes: list[Route] = []
    for leg, own in zip(legs, settings, strict=True):
        try:
            # Planners are imported only when used: their kernels take long to load.
            if isinstance(own, OptimalSettings):
                from planner.anytime.path import optimal_route

                routes.append(optimal_route(rig, leg.scene, own, kinematic, progress, clock))
            elif isinstance(own, TurningSettings):
                from planner.anytime_6d.path import rotating_route

                routes.append(rotating_route(rig, leg.scene, own, kinematic, progress, clock))
            else:
                from planner.rrt.path import paper_route

                routes.append(paper_route(rig, leg.scene, own, kinematic, progress))
        except NoSolution as error:
            if len(legs) > 1:
                error.what = f"from {leg.begin} to {leg.end}: {error.what}"
            raise
    return MultiSegmentPath(*_joined(routes), tuple(route.iterations for route in routes))


def settings_of_legs(settings: Settings, rounds: Sequence[int], count: int) -> Sequence[Settings]:
    """The settings of each leg; they differ only in rounds given for each.

    Raises:
        BadInput: Rounds are not one number for each leg, or the planner has none; or the scene has
            stops and the path a length limit.
    """
    if isinstance(settings, PlannerSettings):
        if rounds:
            raise BadInput("the paper's planners have no rounds", next_step="leave them out")
        return [settings] * count
    if count > 1 and settings.longest < np.inf:
        raise BadInput(
            "a path with stops (`via=` or the scene's) cannot have a limit on its length",
            why="each leg is planned on its own, without knowing the others' lengths",
            next_step="leave out `longest=`, or plan from stop to stop",
        )
    if not rounds:
        return [settings] * count
    if len(rounds) != count:
        raise BadInput(
            f"rounds are given for {len(rounds)} legs; the scene has {count}",
            next_step="give one number for all legs, or one for each",
        )
    return [replace(settings, rounds=own) for own in rounds]


def _joined(routes: Sequence[Route]) -> tuple[Route, tuple[int, ...]]:
    """The routes end to end, and the indices of the points where two of them meet."""
    lengths = [len(route.path) - 1 for route in routes]
    before = [0, *accumulate(len(route.nodes) for route in routes[:-1])]
    times = [route.search_time for route in routes if route.search_time is not None]
    joined = Route(
        path=_end_to_end([route.path for route in routes]),
        raw=_end_to_end([route.raw for route in routes]),
        nodes=np.concatenate([route.nodes for route in routes]),
        parents=np.concatenate(
            [
                np.where(r.parents < 0, -1, r.parents + n)
                for r, n in zip(routes, before, strict=True)
            ]
        ),
        iterations=sum(route.iterations for route in routes),
        edge_checks=sum(route.edge_checks for route in routes),
        search_time=sum(max(0.0, spent) for spent in times) if times else None,
    )
    return joined, tuple(accumulate(lengths[:-1]))


def _end_to_end(paths: Sequence[Array]) -> Array:
    """Paths whose ends meet as one path, each shared point once."""
    return np.concatenate([paths[0], *(path[1:] for path in paths[1:])])


def make_plan(
    rig: Rig,
    scene: Scene,
    settings: Settings | None = None,
    progress: Progress | None = None,
    clock: Callable[[], float] = time.perf_counter,
    *,
    rounds: Sequence[int] = (),
    done: Sequence[StopDocument] = (),
) -> PlanDocument:
    """Plans a path from the scene's start through its stops to its goal.

    The same rig, scene and settings give the same path with the same libraries and processor type.
    The clock only fills the statistics; but settings without a number of rounds continue until the
    budget is spent, and the plan then states the rounds that reproduce its path.

    Args:
        scene: Obstacles, clearances, load, start, stops and goal.
        settings: Planner and settings; the recommended planner when left out. A budget applies to
            each leg between stops.
        progress: Called with the progress of the search.
        clock: Seconds, for the planning time and the budget.
        rounds: Of each leg, instead of those in the settings.
        done: Stops that an earlier run visited; the plan only records them.

    Returns:
        The plan, sealed with its hash, which has passed `planner.check.check_path`.

    Raises:
        BadInput: Start, goal or a stop cannot be used, settings do not fit the legs, winches are
            too slow, or the path passes too near a pulley's swivel axis.
        NoSolution: There is no path, or the search ended at its limit.
        Fault: The finished path failed its check, which is a fault of this program.
    """
    began = clock()
    settings = settings or OptimalSettings()
    turns = isinstance(settings, TurningSettings)
    require_usable_ends(rig, scene, free_rotation=turns)
    if isinstance(settings, AnytimeSettings) and not scene.stops:
        require_feasible_length(scene, settings.longest)
    space: Space = PoseSpace(rig) if turns else TranslationSpace(rig, scene.start.rotation)
    kinematic = KinematicCost(rig, scene.start.rotation)
    legs = legs_of(scene)
    of_legs = settings_of_legs(settings, rounds, len(legs))
    path = plan_segments(rig, legs, of_legs, kinematic, progress, clock)
    route = path.route
    poses = [space.pose(point) for point in route.path]
    report = check_path(rig, scene, poses, path.stops)
    if not report.passed:
        require_limits_not_searched(rig, report)
        raise Fault(
            "the planned path failed its own check: "
            + "; ".join(v.sentence() for v in report.violations),
            where=f"plan for {rig.name} in {scene.name}",
            next_step="report it with the rig, the scene and the seed; no plan was written",
        )
    return sealed(
        {
            "rig_hash": rig.plan_hash,
            "scene_hash": scene.hash,
            "rig": rig.document,
            "scene": scene.document,
            "planner": _planner(of_legs[0], path),
            "waypoints": [PoseDocument.of(pose) for pose in poses],
            "stops": [
                {"name": stop.name, "waypoint": waypoint}
                for stop, waypoint in zip(scene.stops, path.stops, strict=True)
            ],
            "done": list(done),
            "raw_path": [PoseDocument.of(space.pose(point)) for point in route.raw],
            "tree": _tree(space, route),
            "statistics": {
                "nodes": len(route.nodes),
                "iterations": route.iterations,
                "edge_checks": route.edge_checks,
                "planning_time_s": max(0.0, clock() - began),
                "search_time_s": route.search_time,
            },
            "quality": _quality(report, route.raw, kinematic.mean_along_poses(poses)),
        }
    )


def plan_path(
    rig: Rig,
    scene: Scene,
    settings: Settings | None = None,
    listener: Listener = SILENT,
    *,
    rounds: Sequence[int] = (),
    done: Sequence[StopDocument] = (),
) -> PlanDocument:
    """As `make_plan`, with progress reports, also while the planner is compiled.

    Where code must be compiled, a short search is made first and its outcome discarded, so that the
    plan's figures do not count the compiler.
    """
    settings = settings or OptimalSettings()
    make = partial(make_plan, rig, scene, settings, rounds=rounds, done=done)
    with planner_compilation(_work(settings), listener) as compiled:
        if not compiled:
            with suppress(CdprError):
                make_plan(rig, scene, _short(settings))
            return make()
        if isinstance(settings, PlannerSettings):
            with listener.progress("planning", settings.max_iterations) as advance:
                return make(progress=lambda done, _most, _distance: advance(done))
        unit, scale = ("ms", 1e3) if settings.rounds is None else ("rounds", 1.0)
        total = scale * (settings.rounds or settings.budget)
        if total < _LONG:
            with listener.waiting("planning"):
                return make()
        with listener.progress(f"planning, {unit}", total) as advance:
            return make(progress=lambda done, _most, _cost: advance(scale * done))


def _short(settings: Settings) -> Settings:
    """The settings of a short search that compiles all that a longer one needs."""
    if isinstance(settings, PlannerSettings):
        return replace(settings, max_iterations=min(settings.max_iterations, 200))
    return replace(settings, rounds=1)


def _work(settings: Settings) -> Literal["paper", "turning", "optimal"]:
    if isinstance(settings, PlannerSettings):
        return "paper"
    return "turning" if isinstance(settings, TurningSettings) else "optimal"


def plan_from_waypoints(
    rig: Rig,
    scene: Scene,
    waypoints: Sequence[Pose],
    *,
    stops: Sequence[int] = (),
    author: str = "",
) -> Plan:
    """A plan from the waypoints of another planner, proved by the same check as ours.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start, stops and goal.
        waypoints: ``world_from_platform``, from the scene's start to its goal; between two the
            platform moves straight and rotates at a steady rate.
        stops: Index of the waypoint at each of the scene's stops.
        author: Free text that names the planner; kept in the plan file.

    Returns:
        The plan, which has passed `planner.check.check_path`.

    Raises:
        BadInput: There are fewer than two waypoints, or ``stops`` does not match the scene's stops.
        PlanRejected: With every violation: what, by how much and where.
    """
    waypoints = sequence_of("waypoints", waypoints)
    require_types((rig, Rig), (scene, Scene), *((pose, Pose) for pose in waypoints))
    require_unaltered(rig, scene)
    require_text(author=author)
    if len(waypoints) < 2:
        raise BadInput(
            f"a path needs two waypoints, not {len(waypoints)}",
            where=f"plan for {rig.name} in {scene.name}",
            next_step="start at scene.start and end at scene.goal",
        )
    stops = [whole_number("the waypoint of a stop", k) for k in sequence_of("stops", stops)]
    report = check_path(rig, scene, waypoints, stops)
    if not report.passed:
        raise PlanRejected(
            report,
            where=f"waypoints for {rig.name} in {scene.name}",
            next_step=f"{report.cure or 'change the waypoints'}; nothing has moved",
        )
    positions = np.array([pose.position for pose in waypoints])
    kinematic = KinematicCost(rig, scene.start.rotation)
    poses = [PoseDocument.of(pose) for pose in waypoints]
    marks = zip(scene.stops, stops, strict=True)
    return plan_from_document(
        sealed(
            {
                "rig_hash": rig.plan_hash,
                "scene_hash": scene.hash,
                "rig": rig.document,
                "scene": scene.document,
                "planner": {"name": "waypoints", "author": author},
                "waypoints": poses,
                "stops": [{"name": stop.name, "waypoint": index} for stop, index in marks],
                "raw_path": poses,
                "tree": {
                    "positions_mm": (positions * 1000.0).round(3).tolist(),
                    "parents": list(range(-1, len(poses) - 1)),
                },
                "statistics": {
                    "nodes": len(poses),
                    "iterations": 0,
                    "edge_checks": 0,
                    "planning_time_s": 0.0,
                },
                "quality": _quality(report, positions, kinematic.mean_along_poses(waypoints)),
            }
        )
    )


def _planner(settings: Settings, path: MultiSegmentPath) -> dict[str, Any]:
    if isinstance(settings, AnytimeSettings):
        return _anytime_planner(settings, path)
    return {
        "name": settings.sampler,
        "cost": settings.cost,
        "mode": settings.mode,
        "seed": settings.seed,
        "step_mm": settings.step * 1000.0,
        "neighbour_radius_mm": settings.neighbour_radius * 1000.0,
        "goal_radius_mm": settings.goal_radius * 1000.0,
        "max_iterations": settings.max_iterations,
        "readings": _readings(settings),
    }


def _anytime_planner(settings: AnytimeSettings, path: MultiSegmentPath) -> dict[str, Any]:
    longest = settings.longest
    return {
        "name": "turning" if isinstance(settings, TurningSettings) else "optimal",
        "weights": asdict(settings.weights),
        "seed": settings.seed,
        "rounds": list(path.iterations),
        "budget_ms": settings.budget * 1000.0 if settings.rounds is None else None,
        "longest_mm": longest * 1000.0 if longest < float("inf") else None,
    }


def _readings(settings: PlannerSettings) -> dict[str, Any]:
    readings = settings.readings
    return {
        "failure_rate": readings.failure_rate,
        "focus": readings.focus,
        "cone_draw": readings.cone_draw,
        "steer": readings.steer if settings.mode == "paper" else "to-sample",  # as RRT* steps
        "spacing_mm": readings.spacing * 1000.0,
        "goal_sight": readings.goal_sight,
    }


def _tree(space: Space, route: Route) -> dict[str, Any]:
    positions = [space.pose(point).position for point in route.nodes]
    return {
        "positions_mm": [[round(float(x) * 1000.0, 3) for x in p] for p in positions],
        "parents": [int(parent) for parent in route.parents],
    }


def _quality(report: CheckReport, raw: Array, mean_cost: float) -> dict[str, Any]:
    closest = report.obstacle_clearance
    steps = np.linalg.norm(np.diff(raw[:, :3], axis=0), axis=1)
    return {
        "length_mm": report.length * 1000.0,
        "raw_length_mm": float(steps.sum()) * 1000.0,
        "obstacle_clearance": closest.as_dict() if closest else None,
        "self_clearance": report.self_clearance.as_dict(),
        "mean_kinematic_cost": mean_cost,
        "min_tension_n": report.min_tension,
        "max_tension_n": report.max_tension,
    }
