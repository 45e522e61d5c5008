"""From a goal to a sealed plan: search, post-processing, check, figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cdpr.document_types import PoseDocument
from cdpr.errors import Fault
from cdpr.legs import legs_of
from cdpr.plan import sealed
from cdpr.plan_file import PlanDocument
from cdpr.poses import Array
from cdpr.rig import Rig
from cdpr.scene import Scene
from cdpr.scene_stops import StopDocument
from planner.anytime import AnytimeSettings
from planner.check import check_path
from planner.check_report import CheckReport
from planner.cost import KinematicCost
from planner.endpoints import require_usable_ends
from planner.optimal.settings import OptimalSettings
from planner.paper.readings import Readings
from planner.route import Progress, Route
from planner.space import PoseSpace, Space, TranslationSpace
from planner.turning.settings import TurningSettings
from planner.way import Settings, Way, settings_of_legs, way_through


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

    The same rig, scene and settings give the same path on every machine of the same libraries. The
    clock is read for the statistics alone; except that settings without a number of rounds
    go on until a budget is spent: the plan then tells the rounds, which give its path again.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start, stops and goal.
        settings: Which planner, and its settings; the planner we recommend when left out. A budget
            is that of each leg between stops.
        progress: Told how the search goes on.
        clock: Seconds, for the planning time and the budget.
        rounds: Of each leg, in place of those in the settings.
        done: Stops that a run before visited; the plan only remembers them.

    Returns:
        The plan, sealed with its hash, which has passed `planner.check.check_path`.

    Raises:
        BadInput: Start, goal or a stop cannot be used, or settings do not fit the legs.
        NoSolution: There is no path, or the search ended at its limit.
        Fault: The finished path failed its check; that is a fault of this program.
    """
    began = clock()
    settings = settings or OptimalSettings()
    turns = isinstance(settings, TurningSettings)
    require_usable_ends(rig, scene, free_rotation=turns)
    space: Space = PoseSpace(rig) if turns else TranslationSpace(rig, scene.start.rotation)
    kinematic = KinematicCost(rig, scene.start.rotation)
    legs = legs_of(scene)
    of_legs = settings_of_legs(settings, rounds, len(legs))
    way = way_through(rig, legs, of_legs, kinematic, progress, clock)
    route = way.route
    poses = [space.pose(point) for point in route.path]
    report = check_path(rig, scene, poses, way.stops)
    if not report.passed:
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
            "planner": _planner(of_legs[0], way),
            "waypoints": [PoseDocument.of(pose) for pose in poses],
            "stops": [
                {"name": stop.name, "waypoint": waypoint}
                for stop, waypoint in zip(scene.stops, way.stops, strict=True)
            ],
            "done": list(done),
            "raw_path": [PoseDocument.of(space.pose(point)) for point in route.raw],
            "tree": _tree(space, route),
            "statistics": {
                "nodes": len(route.nodes),
                "iterations": route.iterations,
                "edge_checks": route.edge_checks,
                "planning_time_s": max(0.0, clock() - began),
                "search_time_s": way.search_time,
            },
            "quality": _quality(report, route.raw, kinematic.mean_along_poses(poses)),
        }
    )


def _planner(settings: Settings, way: Way) -> dict[str, Any]:
    if isinstance(settings, AnytimeSettings):
        return _improving_planner(settings, way)
    return {
        "name": settings.sampler,
        "cost": settings.cost,
        "mode": settings.mode,
        "seed": settings.seed,
        "step_mm": settings.step * 1000.0,
        "neighbour_radius_mm": settings.neighbour_radius * 1000.0,
        "goal_radius_mm": settings.goal_radius * 1000.0,
        "max_iterations": settings.max_iterations,
        "readings": _readings(settings.readings),
    }


def _improving_planner(settings: AnytimeSettings, way: Way) -> dict[str, Any]:
    weights, longest = settings.weights, settings.longest
    return {
        "name": "turning" if isinstance(settings, TurningSettings) else "optimal",
        "weights": {
            "length": weights.length,
            "kinematic": weights.kinematic,
            "clearance": weights.clearance,
            "capacity": weights.capacity,
        },
        "seed": settings.seed,
        "rounds": list(way.rounds),
        "budget_ms": settings.budget * 1000.0 if settings.rounds is None else None,
        "longest_mm": longest * 1000.0 if longest < float("inf") else None,
    }


def _readings(readings: Readings) -> dict[str, Any]:
    return {
        "failure_rate": readings.failure_rate,
        "focus": readings.focus,
        "cone_draw": readings.cone_draw,
        "steer": readings.steer,
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
