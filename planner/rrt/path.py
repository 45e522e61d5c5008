"""From start to goal with the paper's planner: search, then Algorithm 3 and what goes beyond it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from model.errors import NoSolution
from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.costs import Cost, KinematicCost, LengthCost
from planner.path import Progress, Route
from planner.rrt.search import PaperPlanner, SearchResult
from planner.settings import ATTEMPT_WITH_ROOM, CLEARANCE_RESERVE, PlannerSettings
from planner.shortcut import cheapest_through, drawn_tight

_SPREAD_POINTS = 40
_ROUNDS = 2
_FOR_FEWER_CORNERS = 0.003
"""Share of its cost that a finished path may lose to have fewer corners, at which a run slows."""


def paper_route(
    rig: Rig,
    scene: Scene,
    settings: PlannerSettings,
    kinematic: KinematicCost,
    progress: Progress | None = None,
) -> Route:
    """Searches, in the rewiring mode first with room for the blends that round the corners.

    A blend leaves the path by up to the rig's blend tolerance, and toward the obstacle it goes
    around; without room the executor would have to make it small, and slow down. Where no path has
    that room, the search begins again without.

    Raises:
        NoSolution: The search ended at its limit.
    """
    start, goal = np.array(scene.start.position), np.array(scene.goal.position)
    attempts = [(CLEARANCE_RESERVE, 1.0)]
    if settings.mode == "rewire":
        room = CLEARANCE_RESERVE + rig.motion.blend_tolerance
        attempts.insert(0, (room, ATTEMPT_WITH_ROOM))
    iterations = checks = 0
    for reserve, share in attempts:
        most = max(1, int(share * settings.max_iterations) - iterations)
        attempt = replace(settings, max_iterations=most)
        planner = PaperPlanner(rig, scene, attempt, reserve, kinematic)
        if reserve > CLEARANCE_RESERVE and not (
            planner.edge(start, start) and planner.edge(goal, goal)
        ):
            continue
        random = np.random.default_rng(settings.seed)
        result = planner.search(start, goal, random, progress)
        iterations += result.iterations
        if result.path is not None:
            return Route(
                path=_post_processed(result.path, planner, kinematic),
                raw=result.path,
                nodes=result.points,
                parents=result.parents,
                iterations=iterations,
                edge_checks=checks + planner.checks,
            )
        checks += planner.checks
    raise _no_solution(scene, settings, result, iterations)


def _post_processed(raw: Array, planner: PaperPlanner, kinematic: KinematicCost) -> Array:
    """Algorithm 3; in the rewiring mode the path is then drawn tight as well."""
    path = planner.shortcut(raw)
    if planner.settings.mode == "paper" or len(path) == 2:
        return path
    cost: Cost = kinematic if planner.settings.cost == "kinematic" else LengthCost()
    length = float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    for _ in range(_ROUNDS):
        path = cheapest_through(path, planner.edge, cost, length / _SPREAD_POINTS)
        path = drawn_tight(path, planner.edge, cost)
    return planner.shortcut(path, _FOR_FEWER_CORNERS)


def _no_solution(
    scene: Scene, settings: PlannerSettings, result: SearchResult, iterations: int
) -> NoSolution:
    refused = sorted(result.refused.items(), key=lambda item: -item[1])
    why = ", ".join(f"{count} for {reason}" for reason, count in refused) or "none"
    pairs = sorted(result.in_the_way.items(), key=lambda item: -item[1])[:3]
    if pairs:
        listed = ", ".join(f"{a} – {b} ({n})" for (a, b), n in pairs)
        why += f"; most often in the way: {listed}"
    best = result.best_distance * 1000.0
    return NoSolution(
        f"no path after {iterations} iterations; the tree came within {best:.1f} mm of the"
        f" goal with {len(result.points)} nodes",
        where=f"scene {scene.name}",
        why=f"edges refused: {why}",
        next_step="reduce the clearance, allow more iterations, try another seed, or move the"
        " goal or an obstacle",
        values={
            "best_distance_mm": best,
            "iterations": float(iterations),
            "nodes": float(len(result.points)),
            "seed": float(settings.seed),
        },
    )
