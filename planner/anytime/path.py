"""From start to goal with the planner we recommend: rounds until the budget is spent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.anytime.infeasibility import no_path
from planner.anytime.local_search import measure, polyline_of
from planner.anytime.prepare import problem_of, set_weights
from planner.anytime.problem import ASK_PROOF, LEAST_MARGIN, UNIT, PathProblem
from planner.anytime.rounds import advance, handle_of, measure_again
from planner.anytime.state import BEST, AnytimeSearch, new_search
from planner.costs import KinematicCost
from planner.path import LEAST_ROUNDS_WITH_LIMIT, LengthLimit, Progress, Route
from planner.settings import LEAST_ROUNDS, OptimalSettings

Clock = Callable[[], float]

LEAST_WITH_PROOFS = 2
"""Likewise from where wrenches have to be proved on every edge, which takes long."""
_TELL_EVERY = 0.1
"""Between calls of a progress, [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class OptimalRoute:
    """A route, and what it takes to find it again.

    Attributes:
        route: The path; its nodes are those of the first path found.
        rounds: How many were done; `OptimalSettings.rounds` repeats them.
        preparation_time: [s].
        search_time: [s].
    """

    route: Route
    rounds: int
    preparation_time: float
    search_time: float


def optimal_route(
    rig: Rig,
    scene: Scene,
    settings: OptimalSettings,
    kinematic: KinematicCost,
    progress: Progress | None = None,
    clock: Clock = time.perf_counter,
) -> OptimalRoute:
    """Searches and improves.

    Args:
        rig: The robot.
        scene: Obstacles, clearances, load, start and goal.
        settings: Objective, seed and budget.
        kinematic: The cost of poses at the start's orientation.
        progress: Called with the work done and its limit, both in seconds of the budget or in
            rounds, and the cost of the best path; about ten times a second.
        clock: Seconds; decides when a budget is spent.

    Raises:
        NoSolution: There is no path, none was found, or none is short enough.
    """
    began = clock()
    problem = problem_of(rig, scene, settings.weights, kinematic)
    start, goal = np.array(scene.start.position), np.array(scene.goal.position)
    search = new_search(start, goal, settings.seed)
    _load(problem, search)
    prepared = clock()
    path = _improved(problem, search, settings, prepared, progress, clock)
    if path is None:
        raise no_path(rig, scene, problem, search, settings)
    first = search.first[: search.totals[4]].copy()
    route = Route(
        path=path,
        raw=first,
        nodes=first,
        parents=np.arange(-1, len(first) - 1, dtype=np.int64),
        iterations=int(search.totals[0]),
        edge_checks=int(search.totals[2] + search.grown[2] + search.counts[:, 1].sum()),
    )
    return OptimalRoute(route, route.iterations, prepared - began, clock() - prepared)


def _load(problem: PathProblem, search: AnytimeSearch) -> None:
    """Calls what the rounds call: machine code is made, or loaded, when it is called first."""
    advance(handle_of(problem, search), 0)
    measure_again(problem, search)
    measure(problem, polyline_of(search.ends))


def _improved(
    problem: PathProblem,
    search: AnytimeSearch,
    settings: OptimalSettings,
    began: float,
    progress: Progress | None,
    clock: Clock,
) -> Array | None:
    """Does rounds until the budget is spent, or nothing can be better."""
    limit = None
    if settings.longest < math.inf:
        limit = LengthLimit(settings.longest, problem.terms[UNIT])
    handle = handle_of(problem, search)
    spent, told = 0.0, 0.0
    while not _is_over(problem, settings, search, spent):
        cost = advance(handle, 1)
        if limit is not None:
            _limited(problem, search, settings, limit)
        elif cost <= _least(search, settings):
            break
        spent = clock() - began
        if progress is not None and spent - told >= _TELL_EVERY:
            told = spent
            settings.tell(progress, int(search.totals[0]), spent, float(search.costs[BEST]))
    return limit.path if limit is not None else best_path(search)


def _limited(
    problem: PathProblem, search: AnytimeSearch, settings: OptimalSettings, limit: LengthLimit
) -> None:
    """Passes the best path to the limit, and applies the price that it sets."""
    path, weights = best_path(search), settings.weights
    if path is None:
        return

    def cost() -> float:
        set_weights(problem, weights)
        return float(measure(problem, polyline_of(path)))

    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    changed = limit.after_round(path, length, cost)
    set_weights(problem, replace(weights, length=weights.length + limit.price))
    if changed:
        measure_again(problem, search)


def _is_over(
    problem: PathProblem, settings: OptimalSettings, search: AnytimeSearch, spent: float
) -> bool:
    rounds, begun = int(search.totals[0]), int(search.totals[5])
    least = LEAST_ROUNDS if settings.longest == math.inf else LEAST_ROUNDS_WITH_LIMIT
    if problem.terms[LEAST_MARGIN] == ASK_PROOF:
        least = LEAST_WITH_PROOFS
    return settings.is_over(rounds, spent, begun + least)


def _least(search: AnytimeSearch, settings: OptimalSettings) -> float:
    """The cost that nothing is below; only known where the length alone counts."""
    weights = settings.weights
    if not weights.is_length:
        return -math.inf
    straight = float(np.linalg.norm(search.ends[1] - search.ends[0]))
    return weights.length * straight * (1.0 + 1e-12)


def best_path(search: AnytimeSearch) -> Array | None:
    """The cheapest path so far, shape (k, 3), [m]; None without one."""
    if not search.costs[BEST] < math.inf:
        return None
    return search.points[BEST, : search.counts[BEST, 0]].copy()
