"""Maps over a grid, part by part, on as many processes as there are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.workspace.costs import Extremes, costs
from planner.workspace.grid import Grid
from planner.workspace.maps import OBSTACLE_CLEARANCE, Question, Values, values_at

POINTS_IN_A_PART = 4096
VERDICTS = (
    "allowed",
    "no wrench closure",
    "not wrench feasible",
    "self clearance too small",
    "obstacle clearance too small",
)
Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """Values of quantities over a grid.

    Attributes:
        question: For what they are.
        grid: Where.
        values: Shape of the grid each, SI, by name: the quantities that were asked for, and
            the costs (`planner.workspace.costs.costs`).
    """

    question: Question
    grid: Grid
    values: Values

    @property
    def closed(self) -> NDArray[np.bool_]:
        """Where the cables can balance any wrench."""
        return np.asarray(self.values["closure_margin"] > 0.0)

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Where the tension limits suffice for weight, payload and disturbances."""
        return np.asarray(self.values["capacity_margin"] >= 0.0)

    @property
    def collision_free(self) -> NDArray[np.bool_]:
        """Where the scene's clearances are kept; without a scene, where nothing touches."""
        scene = self.question.scene
        own, to_obstacles = 0.0, 0.0
        if scene is not None:
            own, to_obstacles = scene.self_clearance, scene.obstacle_clearance
        free = self.values["self_clearance"] >= own
        if OBSTACLE_CLEARANCE in self.values:
            free &= self.values[OBSTACLE_CLEARANCE] >= to_obstacles
        return np.asarray(free)

    @property
    def verdict(self) -> NDArray[np.int64]:
        """What forbids a pose first, by its place in `VERDICTS`; 0 where nothing does."""
        scene = self.question.scene
        own = scene.self_clearance if scene else 0.0
        tests = [self.closed, self.feasible, self.values["self_clearance"] >= own]
        if OBSTACLE_CLEARANCE in self.values:
            tests.append(self.collision_free)
        return np.asarray(np.select([~test for test in tests], range(1, len(tests) + 1), 0))


def compute(
    question: Question,
    extremes: Extremes,
    grid: Grid,
    *,
    pool: Executor | None = None,
    progress: Progress = lambda _: None,
) -> Maps:
    """Computes maps.

    Args:
        question: Of what.
        extremes: For the costs.
        grid: Where.
        pool: Does the work, in other processes or on other machines; this process without one.
            The values do not depend on it.
        progress: Told how many points are newly done.
    """
    bounds = [(k, min(k + POINTS_IN_A_PART, grid.count)) for k in _starts(grid)]
    values = {name: np.empty(grid.count) for name in question.quantities}
    for (first, last), part in _parts(question, grid, bounds, pool):
        for name, found in part.items():
            values[name][first:last] = found
        progress(last - first)
    shaped = {name: array.reshape(grid.shape) for name, array in values.items()}
    return Maps(question, grid, shaped | costs(shaped, extremes))


def _starts(grid: Grid) -> range:
    return range(0, grid.count, POINTS_IN_A_PART)


def _parts(
    question: Question, grid: Grid, bounds: list[tuple[int, int]], pool: Executor | None
) -> Iterator[tuple[tuple[int, int], Values]]:
    if pool is None or len(bounds) == 1:
        for part in bounds:
            yield part, values_at(question, grid.points(*part))
        return
    tasks = {pool.submit(_part, question, grid, *part): part for part in bounds}
    try:
        for done in as_completed(tasks):
            yield tasks[done], done.result()
    finally:
        for task in tasks:
            task.cancel()


def _part(question: Question, grid: Grid, first: int, last: int) -> Values:
    return values_at(question, grid.points(first, last))
