"""From start to goal with the paper's planner: search, then Algorithm 3 and what goes beyond it.

Beyond Algorithm 3, the cheapest path through points of the path is found and its corners are pulled
tight. Edges keep all their limits, and no step makes a path costlier except the last, which saves
corners for up to 0.3 % of the cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from model.errors import NoSolution
from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.costs import KinematicCost
from planner.path import Progress, Route
from planner.rrt.search import PaperPlanner, SearchResult
from planner.settings import ATTEMPT_WITH_ROOM, CLEARANCE_RESERVE, PlannerSettings

IsFree = Callable[[Array, Array], bool]


class Cost(Protocol):
    """A cost of straight edges between coordinates."""

    def edge(self, start: Array, end: Array) -> float:
        """Cost of the straight edge from ``start`` to ``end``, shape (n,) each."""

    def edges(self, starts: Array, end: Array) -> Array:
        """Costs of straight edges from many points, shape (k, n), to one; shape (k,)."""


class LengthCost:
    """The length of an edge, [m]."""

    def edge(self, start: Array, end: Array) -> float:
        """Length of the edge, [m]."""
        return float(np.linalg.norm(end - start))

    def edges(self, starts: Array, end: Array) -> Array:
        """Lengths of the edges, shape (k,), [m]."""
        lengths: Array = np.linalg.norm(end - starts, axis=1)
        return lengths


def cheapest_through(path: Array, is_free: IsFree, cost: Cost, spacing: float) -> Array:
    """The cheapest path from start to end through points spread over a path.

    Unlike Algorithm 3, which jumps as far as it can, this is a shortest-path search over all pairs
    of points.

    Args:
        path: Allowed from node to node, shape (k, n).
        is_free: Whether an edge is allowed.
        spacing: Distance of the points spread over the edges, [m].
    """
    points = _spread(path, spacing)
    best = np.append(0.0, np.full(len(points) - 1, np.inf))
    parent = np.zeros(len(points), dtype=np.int64)
    for j in range(1, len(points)):
        totals = best[:j] + cost.edges(points[:j], points[j])
        for i in np.argsort(totals, kind="stable").tolist():
            if i == j - 1 or is_free(points[i], points[j]):
                best[j], parent[j] = totals[i], i
                break
    kept = [len(points) - 1]
    while kept[-1] != 0:
        kept.append(int(parent[kept[-1]]))
    return points[kept[::-1]]


#: Sizes of the moves tried, largest first, [m].
_STEPS = (0.02, 0.01, 0.005, 0.002)


def pull_tight(path: Array, is_free: IsFree, cost: Cost) -> Array:
    """Moves corners, one coordinate direction at a time, while the path gets cheaper.

    Args:
        path: Allowed from node to node, shape (k, n).
        is_free: Whether an edge is allowed.
    """
    tight = path.copy()
    for step in _STEPS:
        for _ in range(10):
            moved = [_move_corner(tight, k, step, is_free, cost) for k in range(1, len(tight) - 1)]
            if not any(moved):
                break
    return tight


def _move_corner(path: Array, k: int, step: float, is_free: IsFree, cost: Cost) -> bool:
    """Tries to move one corner, in place: along its bisector and along the axes."""
    before, corner, after = path[k - 1], path[k].copy(), path[k + 1]
    now = cost.edge(before, corner) + cost.edge(corner, after)
    inward = (before + after) / 2.0 - corner
    size = float(np.linalg.norm(inward))
    directions = np.concatenate([np.eye(len(corner)), -np.eye(len(corner))])
    if size > 0.0:
        directions = np.concatenate([inward[None, :] / size, directions])
    tried = corner + step * directions
    totals = cost.edges(tried, before) + cost.edges(tried, after)
    for i in np.argsort(totals, kind="stable").tolist():
        if totals[i] >= now * (1.0 - 1e-6):
            return False
        if is_free(before, tried[i]) and is_free(tried[i], after):
            path[k] = tried[i]
            return True
    return False


def _spread(path: Array, spacing: float) -> Array:
    points = [path[:1]]
    for start, end in pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing)))
        shares = np.arange(1, count) / count
        points += [start + shares[:, None] * (end - start), end[None, :]]
    return np.concatenate(points)


# Search and post-processing.


_SPREAD_POINTS = 40
_ROUNDS = 2
_FOR_FEWER_CORNERS = 0.003
"""Share by which a finished path may cost more to have fewer corners, at which a run slows."""


def paper_route(
    rig: Rig,
    scene: Scene,
    settings: PlannerSettings,
    kinematic: KinematicCost,
    progress: Progress | None = None,
) -> Route:
    """Searches; in the rewiring mode first with room for the blends that round the corners.

    A blend deviates from the path by up to the rig's blend tolerance, toward the obstacle it goes
    around; without room the executor would have to shrink it and slow down. Where no path has that
    room, the search starts again without it.

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
    """Algorithm 3; in the rewiring mode the path is then pulled tight as well."""
    path = planner.shortcut(raw)
    if planner.settings.mode == "paper" or len(path) == 2:
        return path
    cost: Cost = kinematic if planner.settings.cost == "kinematic" else LengthCost()
    length = float(np.sum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    for _ in range(_ROUNDS):
        path = cheapest_through(path, planner.edge, cost, length / _SPREAD_POINTS)
        path = pull_tight(path, planner.edge, cost)
    return planner.shortcut(path, _FOR_FEWER_CORNERS)


def _no_solution(
    scene: Scene, settings: PlannerSettings, result: SearchResult, iterations: int
) -> NoSolution:
    refused = sorted(result.refused.items(), key=lambda item: -item[1])
    why = ", ".join(f"{count} for {reason}" for reason, count in refused) or "none"
    pairs = sorted(result.blocking_pairs.items(), key=lambda item: -item[1])[:3]
    if pairs:
        listed = ", ".join(f"{a} – {b} ({n})" for (a, b), n in pairs)
        why += f"; most often blocking: {listed}"
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
