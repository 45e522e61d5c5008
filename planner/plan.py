"""From a goal to a sealed plan: search, post-processing, check, figures."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from cdpr.document_types import PoseDocument
from cdpr.errors import Fault, NoSolution
from cdpr.plan import sealed
from cdpr.plan_file import PlanDocument
from cdpr.poses import Array
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.check import check_path
from planner.check_report import CheckReport
from planner.cost import Cost, KinematicCost, LengthCost
from planner.endpoints import require_usable_ends
from planner.rrt_star import Progress, RrtStar, SearchResult
from planner.sampling import AdaptiveSample, GoalBias, Sampler
from planner.settings import ATTEMPT_WITH_ROOM, CLEARANCE_RESERVE, PlannerSettings
from planner.shortcut import cheapest_through, drawn_tight, shortcut
from planner.space import Space, TranslationSpace
from planner.validity import Validity

_SPREAD_POINTS = 40
_ROUNDS = 2
_FOR_FEWER_CORNERS = 0.003
"""Share of its cost that a finished path may lose to have fewer corners, at which a run slows."""


def make_plan(
    rig: Rig,
    scene: Scene,
    settings: PlannerSettings | None = None,
    progress: Progress | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> PlanDocument:
    """Plans a path from the scene's start to its goal.

    The same rig, scene and settings give the same path on every machine of the same libraries; the
    clock is read for the statistics alone.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start and goal.
        settings: Of the search; the defaults when left out.
        progress: Told how the search goes on.
        clock: Seconds, for the planning time.

    Returns:
        The plan, sealed with its hash, which has passed `planner.check.check_path`.

    Raises:
        BadInput: Start or goal cannot be used.
        NoSolution: The search ended at its limit.
        Fault: The finished path failed its check; that is a fault of this program.
    """
    began = clock()
    settings = settings or PlannerSettings()
    require_usable_ends(rig, scene)
    space = TranslationSpace(rig, scene.start.rotation)
    kinematic = KinematicCost(rig, space.rotation)
    cost: Cost = kinematic if settings.cost == "kinematic" else LengthCost()
    result, raw, validity = _searched(rig, scene, space, cost, settings, progress)
    path = _post_processed(raw, validity, cost, settings)
    poses = [space.pose(point) for point in path]
    report = check_path(rig, scene, poses)
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
            "planner": _planner(settings),
            "waypoints": [PoseDocument.of(pose) for pose in poses],
            "raw_path": [PoseDocument.of(space.pose(point)) for point in raw],
            "tree": _tree(space, result),
            "statistics": {
                "nodes": result.tree.count,
                "iterations": result.iterations,
                "edge_checks": validity.checks,
                "planning_time_s": max(0.0, clock() - began),
            },
            "quality": _quality(report, raw, kinematic.mean_along(path)),
        }
    )


def _searched(
    rig: Rig,
    scene: Scene,
    space: Space,
    cost: Cost,
    settings: PlannerSettings,
    progress: Progress | None,
) -> tuple[SearchResult, Array, Validity]:
    """Searches, in the rewiring mode first with room for the blends that round the corners.

    A blend leaves the path by up to the rig's blend tolerance, and toward the obstacle it goes
    around; without room the executor would have to make it small, and slow down. Where no path has
    that room, the search begins again without.
    """
    start, goal = space.coordinates(scene.start), space.coordinates(scene.goal)
    attempts = [(CLEARANCE_RESERVE, settings)]
    if settings.mode == "rewire":
        fewer = max(1, int(ATTEMPT_WITH_ROOM * settings.max_iterations))
        room = CLEARANCE_RESERVE + rig.motion.blend_tolerance
        attempts.insert(0, (room, replace(settings, max_iterations=fewer)))
    for reserve, attempt in attempts:
        validity = Validity(rig, scene, space, reserve)
        if not (validity.edge(start, start) and validity.edge(goal, goal)):
            continue
        random = np.random.default_rng(settings.seed)
        sampler: Sampler = (
            AdaptiveSample(space, start, goal, random)
            if settings.sampler == "adaptive"
            else GoalBias(space, goal, random)
        )
        search = RrtStar(validity, cost, sampler, attempt, random)
        result = search.search(start, goal, progress)
        if result.path is not None:
            return result, result.path, validity
    raise _no_solution(scene, validity, settings, result)


def _no_solution(
    scene: Scene, validity: Validity, settings: PlannerSettings, result: SearchResult
) -> NoSolution:
    refused = sorted(validity.rejections.items(), key=lambda item: -item[1])
    why = ", ".join(f"{count} for {reason}" for reason, count in refused) or "none"
    pairs = sorted(validity.obstacles.rejections.items(), key=lambda item: -item[1])[:3]
    if pairs:
        listed = ", ".join(f"{a} – {b} ({n})" for (a, b), n in pairs)
        why += f"; most often in the way: {listed}"
    best = result.best_distance * 1000.0
    return NoSolution(
        f"no path after {result.iterations} iterations; the tree came within {best:.1f} mm of the"
        f" goal with {result.tree.count} nodes",
        where=f"scene {scene.name}",
        why=f"edges refused: {why}",
        next_step="ask for less clearance, allow more iterations, try another seed, or move the"
        " goal or an obstacle",
        values={
            "best_distance_mm": best,
            "iterations": float(result.iterations),
            "nodes": float(result.tree.count),
            "seed": float(settings.seed),
        },
    )


def _post_processed(raw: Array, validity: Validity, cost: Cost, settings: PlannerSettings) -> Array:
    """Algorithm 3; in the rewiring mode the path is then drawn tight as well."""
    path = shortcut(raw, validity.edge, cost)
    if settings.mode == "paper" or len(path) == 2:
        return path
    length = float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    for _ in range(_ROUNDS):
        path = cheapest_through(path, validity.edge, cost, length / _SPREAD_POINTS)
        path = drawn_tight(path, validity.edge, cost)
    return shortcut(path, validity.edge, cost, _FOR_FEWER_CORNERS)


def _planner(settings: PlannerSettings) -> dict[str, Any]:
    return {
        "name": settings.sampler,
        "cost": settings.cost,
        "mode": settings.mode,
        "seed": settings.seed,
        "step_mm": settings.step * 1000.0,
        "neighbour_radius_mm": settings.neighbour_radius * 1000.0,
        "goal_radius_mm": settings.goal_radius * 1000.0,
        "max_iterations": settings.max_iterations,
    }


def _tree(space: Space, result: SearchResult) -> dict[str, Any]:
    positions = [space.pose(point).position for point in result.tree.points]
    return {
        "positions_mm": [[round(float(x) * 1000.0, 3) for x in p] for p in positions],
        "parents": [int(parent) for parent in result.tree.parents],
    }


def _quality(report: CheckReport, raw: Array, mean_cost: float) -> dict[str, Any]:
    closest = report.obstacle_clearance
    steps = np.linalg.norm(np.diff(raw, axis=0), axis=1)
    return {
        "length_mm": report.length * 1000.0,
        "raw_length_mm": float(steps.sum()) * 1000.0,
        "obstacle_clearance": closest.as_dict() if closest else None,
        "self_clearance": report.self_clearance.as_dict(),
        "mean_kinematic_cost": mean_cost,
        "min_tension_n": report.min_tension,
        "max_tension_n": report.max_tension,
    }
