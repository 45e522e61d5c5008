"""One search by the compiled planner, and its result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.clearance import PLATFORM, cable_name
from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.costs import KinematicCost
from planner.edge_checks import FREE, OBSTACLE, REASONS, ExactChecks
from planner.kernels.jit import kernel
from planner.path import Progress
from planner.rrt.rrt import (
    CHECKS,
    ITERATIONS,
    KEPT_REFUSALS,
    LAST,
    NOT_REACHED,
    REACHED,
    REFUSALS,
    CostField,
    EdgeLimits,
    Rules,
    Search,
    Task,
    edge_cost,
    exact_checks,
    extend_tree,
    kinematic_field,
    length_field,
    limits_of,
    new_search,
    problem,
    try_straight,
)
from planner.rrt.sampling import new_tallies
from planner.rrt.tree import new_tree, nodes_to
from planner.rrt.variants import FAILURE_RATES, FOCUSES
from planner.settings import IMPROVING_ITERATIONS, PlannerSettings
from planner.space import TranslationSpace

# Algorithm 3 as intended, compiled: from each kept node to the farthest that can be reached.
#
# As printed, it takes shortcuts that are NOT free. Here a shortcut keeps every limit of an edge.
# Under the kinematic cost a straight line can cost more than the path it replaces, so a shortcut
# must not be costlier; under the length it never is.


Integers = NDArray[np.int64]

_ROUND_OFF = 1e-12


@kernel
def shortcut(
    path: Array, limits: EdgeLimits, field: CostField, extra: float
) -> tuple[Integers, int]:
    """The nodes of a path that Algorithm 3 keeps, the first and the last included.

    Args:
        path: Allowed from node to node, shape (k, 3), [m].
        extra: Share by which a shortcut may cost more than what it replaces, to save corners.

    Returns:
        Indices of nodes, shape (j,), and the number of edges checked.
    """
    last, checks = len(path) - 1, 0
    along = np.zeros(len(path))
    for k in range(last):
        along[k + 1] = along[k] + edge_cost(field, path[k], path[k + 1])
    kept = np.zeros(len(path), dtype=np.int64)
    count, i = 1, 0
    while i < last:
        j = last
        while j > i + 1:
            most = (1.0 + extra) * (along[j] - along[i]) + _ROUND_OFF
            if edge_cost(field, path[i], path[j]) <= most:
                checks += 1
                if problem(limits, path[i], path[j]) == FREE:
                    break
            j -= 1
        kept[count] = j
        count += 1
        i = j
    return kept[:count], checks


_CHUNK = 500
"""Iterations between progress reports."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """The result of a search.

    Attributes:
        points: All nodes, shape (k, n); the goal is one of them when there is a path.
        parents: Of each node, -1 for the root, shape (k,).
        path: From start to goal, both included, shape (j, n); None without one.
        iterations: Number of samples drawn.
        edge_checks: Number of edges checked.
        best_distance: Smallest distance of a node to the goal, [m].
        refused: Edges refused, by reason.
        blocking_pairs: Of the latest edges refused for obstacles, by body and obstacle.
    """

    points: Array
    parents: NDArray[np.int64]
    path: Array | None
    iterations: int
    edge_checks: int
    best_distance: float
    refused: dict[str, int]
    blocking_pairs: dict[tuple[str, str], int]


class PaperPlanner:
    """The paper's planner for one rig in one scene; any number of searches.

    Attributes:
        space: The search space.
        settings: Of the searches; their seed is not used.
        limits: Of edges.
        field: Cost of edges.
        checks: Edges checked so far.
    """

    def __init__(
        self,
        rig: Rig,
        scene: Scene,
        settings: PlannerSettings,
        reserve: float,
        cost: KinematicCost | None = None,
        exact: ExactChecks | None = None,
    ) -> None:
        """Prepares limits and cost.

        Args:
            scene: Obstacles, clearances, load; each search has its own start and goal.
            settings: Sampler, readings, cost, mode and sizes.
            reserve: Added to the scene's clearances, [m].
            cost: For the rig at the scene's orientation; computed if needed and left out.
            exact: The limits with the reserve, to share between planners; built if left out.
        """
        self.space = TranslationSpace(rig, scene.start.rotation)
        self.settings = settings
        self._exact = exact or exact_checks(rig, scene, self.space.rotation, reserve)
        self.limits = limits_of(self._exact)
        if settings.cost == "kinematic":
            self.field = kinematic_field(cost or KinematicCost(rig, self.space.rotation))
        else:
            self.field = length_field()
        self._obstacles = [obstacle.name for obstacle in scene.obstacles]
        self._cables = rig.cable_count
        self.checks = 0

    def edge(self, start: Array, end: Array) -> bool:
        """Whether the straight edge between two positions, shape (3,), is allowed."""
        self.checks += 1
        return self._exact.problem(start, end) == FREE

    def search(
        self,
        start: Array,
        goal: Array,
        random: np.random.Generator,
        progress: Progress | None = None,
    ) -> SearchResult:
        """Grows a tree from ``start``; the same random numbers give the same tree.

        Args:
            start: Shape (3,), [m].
            goal: Shape (3,), [m].
            progress: Called every 500 iterations.
        """
        settings = self.settings
        lower, upper = np.array(self.space.lower), np.array(self.space.upper)
        task = Task(np.array(start), np.array(goal), lower, upper, self.limits, self.field)
        capacity = settings.max_iterations + 2
        search = new_search(
            new_tree(task.start, capacity),
            new_tallies(capacity),
            task.goal,
            settings.max_iterations,
        )
        rules = _rules(settings)
        if self._tries_straight(start, goal):
            try_straight(search, task)
        counts = search.counts
        while counts[ITERATIONS] < counts[LAST]:
            extend_tree(search, task, rules, random, _CHUNK)
            if progress is not None:
                progress(int(counts[ITERATIONS]), int(counts[LAST]), float(search.closest[0]))
        self.checks += int(counts[CHECKS])
        return self._result(search)

    def shortcut(self, path: Array, extra: float = 0.0) -> Array:
        """Algorithm 3: some of a path's nodes, the first and the last included.

        Args:
            path: Allowed from node to node, shape (k, 3), [m].
            extra: Share by which a shortcut may cost more than what it replaces.
        """
        kept, checks = shortcut(np.ascontiguousarray(path), self.limits, self.field, extra)
        self.checks += checks
        return path[kept]

    def _tries_straight(self, start: Array, goal: Array) -> bool:
        """The paper's mode grows a tree even where the straight line is free, unless near."""
        settings = self.settings
        near = float(np.linalg.norm(goal - start)) <= settings.goal_radius
        return near or settings.mode == "rewire" or settings.readings.goal_sight

    def _result(self, search: Search) -> SearchResult:
        tree, size = search.tree, int(search.tree.size[0])
        reached = int(search.counts[REACHED])
        refused = {
            REASONS[k]: int(count) for k, count in enumerate(search.reasons.tolist()) if count
        }
        return SearchResult(
            points=tree.points[:size].copy(),
            parents=tree.parents[:size].copy(),
            path=None if reached == NOT_REACHED else tree.points[nodes_to(tree, reached)],
            iterations=int(search.counts[ITERATIONS]),
            edge_checks=int(search.counts[CHECKS]),
            best_distance=float(search.closest[0]),
            refused=refused,
            blocking_pairs={} if reached != NOT_REACHED else self._blocking_pairs(search),
        )

    def _blocking_pairs(self, search: Search) -> dict[tuple[str, str], int]:
        found: dict[tuple[str, str], int] = {}
        for start, end in search.refused[: min(int(search.counts[REFUSALS]), KEPT_REFUSALS)]:
            if self._exact.problem(start, end) != OBSTACLE:
                continue
            _, body, owner = self._exact.clearance(start, end)
            name = PLATFORM if body == self._cables else cable_name(body)
            pair = (name, self._obstacles[owner])
            found[pair] = found.get(pair, 0) + 1
        return found


def _rules(settings: PlannerSettings) -> Rules:
    readings = settings.readings
    return Rules(
        adaptive=settings.sampler == "adaptive",
        rate=FAILURE_RATES.index(readings.failure_rate),
        focus=FOCUSES.index(readings.focus),
        by_volume=readings.cone_draw == "volume",
        full_step=readings.steer == "full-step" and settings.mode == "paper",
        spacing=readings.spacing,
        sight=readings.goal_sight,
        rewire=settings.mode == "rewire",
        step=settings.step,
        neighbour_radius=settings.neighbour_radius,
        goal_radius=settings.goal_radius,
        improving=IMPROVING_ITERATIONS,
    )
