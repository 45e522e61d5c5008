"""Why no path was found, in words: proved to be none, or not found in the time given."""

from __future__ import annotations

from collections import Counter

import numpy as np

from cdpr.clearance import PLATFORM, cable_name
from cdpr.errors import NoSolution
from cdpr.rig import Rig
from cdpr.scene import Scene
from planner.exact.checks import REASONS, edge_problem
from planner.exact.edge import edge_clearance
from planner.optimal.problem import Problem
from planner.optimal.search import BEST, Search
from planner.optimal.separation import is_separated
from planner.optimal.settings import OptimalSettings

_TRIED = 300


def no_path(
    rig: Rig, scene: Scene, problem: Problem, search: Search, settings: OptimalSettings
) -> NoSolution:
    """The error for a search that ended without a path.

    Args:
        rig: The robot.
        scene: Obstacles, start and goal.
        problem: What was asked.
        search: What was done.
        settings: Objective, seed and budget.
    """
    values: dict[str, float | str] = {
        "rounds": float(search.totals[0]),
        "seed": float(settings.seed),
    }
    where = f"scene {scene.name}"
    if search.costs[BEST] < np.inf:
        found = search.points[BEST, : search.counts[BEST, 0]]
        length = float(np.linalg.norm(np.diff(found, axis=0), axis=1).sum())
        straight = float(np.linalg.norm(search.ends[1] - search.ends[0]))
        return settings.too_long(where, length, straight, values)
    gap = _gap(search)
    values["best_distance_mm"] = gap * 1e3
    if is_separated(problem.world, search.ends[0], search.ends[1]):
        return NoSolution(
            "there is no path: the obstacles separate start and goal",
            where=where,
            why=f"proved by cells of the workspace that one cable or the platform forbids as a"
            f" whole, at {scene.obstacle_clearance * 1e3:g} mm clearance and 0.05 mm reserve;"
            f" {_in_the_way(rig, scene, problem, search)}",
            next_step="ask for less clearance, or move the goal or an obstacle",
            values={**values, "proved": "yes"},
        )
    return NoSolution(
        settings.not_found(int(search.totals[0]), gap),
        where=where,
        why=f"it is not proved that there is none; {_in_the_way(rig, scene, problem, search)}",
        next_step=f"{settings.longer}, ask for less clearance, try another seed, or move the"
        " goal or an obstacle",
        values=values,
    )


def _gap(search: Search) -> float:
    """Smallest distance between nodes of the two trees, [m]."""
    first, second = (search.trees[k, : search.grown[k]] for k in (0, 1))
    if not len(first) or not len(second):
        return float(np.linalg.norm(search.ends[1] - search.ends[0]))
    gaps = np.linalg.norm(first[:, None, :] - second[None, :, :], axis=-1)
    return float(gaps.min())


def _in_the_way(rig: Rig, scene: Scene, problem: Problem, search: Search) -> str:
    """What most often forbids edges from start and goal, by trying some."""
    random = np.random.default_rng(0)
    low, high = problem.world.limits
    reasons: Counter[str] = Counter()
    pairs: Counter[str] = Counter()
    for k in range(_TRIED):
        start, end = search.ends[k % 2], random.uniform(low, high)
        args = (problem.world, problem.robot, problem.load, problem.holding)
        reason = REASONS[edge_problem(*args, start, end)]
        reasons[reason] += 1
        if reason == "obstacle clearance":
            _, body, obstacle = edge_clearance(problem.world, start, end)
            name = PLATFORM if body == rig.cable_count else cable_name(body)
            pairs[f"{name} – {scene.obstacles[obstacle].name}"] += 1
    del reasons[""]
    if not reasons:
        return "no edge from start or goal was refused"
    listed = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
    text = f"of {_TRIED} edges tried from start and goal were refused for: {listed}"
    if pairs:
        named = ", ".join(f"{pair} ({count})" for pair, count in pairs.most_common(3))
        text += f"; most often in the way: {named}"
    return text
