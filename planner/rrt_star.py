"""Algorithm 1: modified adaptive RRT*, as the paper stops it, and as RRT* goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from cdpr.poses import Array
from planner.cost import Cost
from planner.sampling import Sampler
from planner.settings import IMPROVING_ITERATIONS, PlannerSettings
from planner.tree import Tree
from planner.validity import Validity

Progress = Callable[[int, int, float], None]
"""Called with iterations done, iterations at most, and the tree's distance to the goal [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """What a search found.

    Attributes:
        tree: All nodes; the goal is one of them when there is a path.
        path: From start to goal, both included, shape (k, n); None without one.
        iterations: How many there were.
        best_distance: Smallest distance of a node to the goal, [m].
    """

    tree: Tree
    path: Array | None
    iterations: int
    best_distance: float


class RrtStar:
    """One search, fed by a sampler; the same random numbers give the same tree."""

    def __init__(
        self,
        validity: Validity,
        cost: Cost,
        sampler: Sampler,
        settings: PlannerSettings,
        random: Generator,
    ) -> None:
        """Holds what the search needs; `search` does it."""
        self.validity = validity
        self.cost = cost
        self.sampler = sampler
        self.settings = settings
        self.random = random

    def search(self, start: Array, goal: Array, progress: Progress | None = None) -> SearchResult:
        """Grows a tree from ``start`` until ``goal`` is a node of it, and in the rewiring mode on.

        Args:
            start: Shape (n,).
            goal: Shape (n,).
            progress: Told once in 50 iterations.
        """
        tree, reached = Tree(start), None
        last, nearest_to_goal = self.settings.max_iterations, float(np.linalg.norm(goal - start))
        iteration = 0
        if self._tries_straight(start, goal) and self.validity.edge(start, goal):
            reached = tree.add(goal, 0, self.cost.edge(start, goal))
            nearest_to_goal, last = 0.0, 0
        while iteration < last:
            iteration += 1
            wanted = self.sampler.draw(tree) if reached is None else self._near_path(tree, reached)
            added = self._grow(tree, wanted)
            if added is not None:
                away = float(np.linalg.norm(tree.points[added] - goal))
                nearest_to_goal = min(nearest_to_goal, away)
                if away <= self.settings.goal_radius and self._join_goal(
                    tree, added, goal, reached
                ):
                    if reached is None:
                        reached = tree.count - 1
                        last = self._last_iteration(iteration)
                    nearest_to_goal = 0.0
            if progress is not None and iteration % 50 == 0:
                progress(iteration, last, nearest_to_goal)
        path = None if reached is None else tree.way_to(reached)
        return SearchResult(tree, path, iteration, nearest_to_goal)

    def _tries_straight(self, start: Array, goal: Array) -> bool:
        """The paper grows a tree even where the straight line is free; from near it need not."""
        away = float(np.linalg.norm(goal - start))
        return self.settings.mode == "rewire" or away <= self.settings.goal_radius

    def _last_iteration(self, iteration: int) -> int:
        """When to stop, the goal having been reached first in this iteration."""
        if self.settings.mode == "paper":
            return iteration
        return min(iteration + IMPROVING_ITERATIONS, self.settings.max_iterations)

    def _near_path(self, tree: Tree, reached: int) -> Array:
        """A point near the best path so far, where new nodes can still make it cheaper."""
        way = tree.way_to(reached)
        k = int(self.random.integers(len(way) - 1)) if len(way) > 1 else 0
        on_way = way[k] + self.random.random() * (way[min(k + 1, len(way) - 1)] - way[k])
        away = self.random.normal(0.0, self.settings.neighbour_radius, on_way.shape)
        near: Array = np.clip(on_way + away, self.validity.space.lower, self.validity.space.upper)
        return near

    def _grow(self, tree: Tree, wanted: Array) -> int | None:
        """One expansion (lines 5–18); the new node, or None when it failed."""
        nearest = tree.nearest(wanted)
        new = self._steer(tree.points[nearest], wanted)
        if new is None:  # drawn on a node: no fault of that node
            self.sampler.tell(0, False)
            return None
        if not self.validity.edge(tree.points[nearest], new):
            self.sampler.tell(nearest, False)
            return None
        self.sampler.tell(nearest, True)
        neighbours = tree.within(new, self.settings.neighbour_radius)
        costs = self.cost.edges(tree.points[neighbours], new)
        own = float(costs[int(np.flatnonzero(neighbours == nearest)[0])])
        parent, cost = self._best_parent(tree, neighbours, costs, nearest, own, new)
        node = tree.add(new, parent, cost)
        if self.settings.mode == "rewire":
            self._rewire(tree, node, neighbours, costs)
        return node

    def _steer(self, near: Array, wanted: Array) -> Array | None:
        """Eq. 9: one step η toward the point, in the rewiring mode no farther than the point."""
        along = wanted - near
        length = float(np.linalg.norm(along))
        if length < 1e-9:
            return None
        step = self.settings.step
        if self.settings.mode == "rewire":
            step = min(step, length)
        new: Array = near + along * (step / length)
        return new

    def _best_parent(
        self,
        tree: Tree,
        neighbours: NDArray[np.int64],
        costs: Array,
        nearest: int,
        own: float,
        new: Array,
    ) -> tuple[int, float]:
        """Lines 10–17: the neighbour with the least cost to come whose edge is free."""
        totals = tree.costs[neighbours] + costs
        already = float(tree.costs[nearest]) + own
        for k in np.argsort(totals, kind="stable").tolist():
            if totals[k] >= already:
                break
            if self.validity.edge(tree.points[int(neighbours[k])], new):
                return int(neighbours[k]), float(totals[k])
        return nearest, already

    def _rewire(self, tree: Tree, node: int, neighbours: NDArray[np.int64], costs: Array) -> None:
        """RRT*: neighbours that are cheaper through the new node become its children."""
        through = float(tree.costs[node]) + costs
        for k in np.flatnonzero(through < tree.costs[neighbours] - 1e-12).tolist():
            neighbour = int(neighbours[k])
            # Carried changes may have made this one cheap already.
            if through[k] < tree.costs[neighbour] - 1e-12 and self.validity.edge(
                tree.points[node], tree.points[neighbour]
            ):
                tree.move(neighbour, node, float(through[k]))

    def _join_goal(self, tree: Tree, node: int, goal: Array, reached: int | None) -> bool:
        """Adds the exact goal behind a node, or gives it a better parent; False if not free."""
        total = float(tree.costs[node]) + self.cost.edge(tree.points[node], goal)
        if reached is not None and total >= tree.costs[reached]:
            return False
        if not self.validity.edge(tree.points[node], goal):
            return False
        if reached is None:
            tree.add(goal, node, total)
        else:
            tree.move(reached, node, total)
        return True
