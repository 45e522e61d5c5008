"""Fine references: the best paths from much more time, a dense graph and more polishing.

They are upper bounds of the optimum, from the same exact edges as the planner under test but a
graph 30 times as dense and some thousand times the polishing. The kinematic cost is taken from the
dense grid, and integrals are computed from the model itself, not from a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.anytime.lattice_path import lattice_path
from planner.anytime.local_search import MOST_VERTICES, Polyline, measure, polish
from planner.anytime.path import advance, handle_of
from planner.anytime.problem import KINEMATIC, LENGTH, UNIT, VERTEX, PathProblem, problem_of
from planner.anytime.state import BEST, new_search
from planner.costs import KinematicCost
from planner.kernels.primitives import seeded
from planner.settings import Weights
from planner.space import Lattice

DENSE = 0.008
"""Spacing of points of the dense graph, [m]."""
SAMPLING = 0.001
"""Spacing of samples of exact integrals, [m]."""
_TRIALS = 400
_FIRST_POLISHING = 30


@dataclass(frozen=True)
class Effort:
    """Effort for one reference.

    Attributes:
        spreads: Of the costs of edges, for each path through the dense graph.
        searches: Number of long searches by the planner itself.
        rounds: Of each of them.
        finalists: Number of best paths of both kinds that are polished.
        polishing: Rounds for each of those.
    """

    spreads: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0)
    searches: int = 6
    rounds: int = 400
    finalists: int = 5
    polishing: int = 300


FULL = Effort()
LIGHT = Effort(spreads=(0.0,), searches=3, rounds=250, finalists=2, polishing=150)


@dataclass(frozen=True)
class Question:
    """One scene, prepared once for all objectives.

    Attributes:
        rig: The robot.
        scene: Obstacles, start and goal.
        cost: The kinematic cost from the model.
        problem: As the planner gets it.
        fine: The same with the kinematic cost on a dense grid.
    """

    rig: Rig
    scene: Scene
    cost: KinematicCost
    problem: PathProblem
    fine: PathProblem

    @property
    def ends(self) -> Array:
        """Start and goal, shape (2, 3), [m]."""
        return np.array([self.scene.start.position, self.scene.goal.position])

    def length(self, path: Array) -> float:
        """Length of a path, [m]."""
        return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())

    def integral(self, path: Array) -> float:
        """The line integral of the kinematic cost along a path from the model, [m]."""
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        counts = np.maximum(1, np.ceil(steps / SAMPLING)).astype(int)
        starts, moves = np.repeat(path[:-1], counts, axis=0), np.diff(path, axis=0)
        shares = np.concatenate([(np.arange(n) + 0.5) / n for n in counts])
        at = self.cost.at(starts + shares[:, None] * np.repeat(moves, counts, axis=0))
        return float((at * np.repeat(steps / counts, counts)).sum())

    def value(self, length: float, kinematic: float, path: Array) -> float:
        """The sum of length and integral with these weights, [m]."""
        total = length * self.length(path)
        return total + kinematic * self.integral(path) if kinematic else total


def question(rig: Rig, scene: Scene) -> Question:
    """Prepares a scene."""
    cost = KinematicCost(rig, scene.start.rotation)
    problem = problem_of(rig, scene, Weights(length=1.0), cost)
    size = rig.workspace_upper - rig.workspace_lower
    cells = np.ceil(size / DENSE).astype(int)
    dense = Lattice(rig.workspace_lower, size / cells, tuple(int(n) + 1 for n in cells))  # type: ignore[arg-type]
    points = dense.points(np.arange(dense.count))
    coarse = [
        problem.grid[0, a] + problem.grid[1, a] * np.arange(problem.margins.shape[a])
        for a in range(3)
    ]
    inside = np.clip(points, [c[0] for c in coarse], [c[-1] for c in coarse])
    fine = problem._replace(
        grid=np.stack([dense.lower, dense.spacing]),
        kinematic=np.concatenate([cost.at(p) for p in np.array_split(points, 20)]).reshape(
            dense.shape
        ),
        margins=RegularGridInterpolator(coarse, problem.margins)(inside).reshape(dense.shape),
        terms=problem.terms.copy(),
    )
    return Question(rig, scene, cost, problem, fine)


def reference_of(
    asked: Question,
    length: float,
    kinematic: float,
    also: Sequence[Array] = (),
    effort: Effort = FULL,
) -> Array:
    """The best path known for a sum of length and kinematic integral, shape (k, 3), [m].

    Args:
        asked: The scene.
        length: Its weight; may be negative if the least kinematic cost outweighs it.
        kinematic: Its weight.
        also: Paths to polish besides those of the dense graph and of long searches.
        effort: Effort of the search.
    """
    fine = asked.fine._replace(terms=asked.fine.terms.copy())
    fine.terms[[LENGTH, KINEMATIC]] = length, kinematic
    fine.terms[UNIT] = length + kinematic * float(fine.kinematic.mean())
    found = _from_dense_graph(asked, fine, effort), _from_long_searches(asked, fine, effort)
    rough = sorted([*also, *found[0], *found[1]], key=lambda p: asked.value(length, kinematic, p))
    polished = [
        _polished(fine, path, seed, effort.polishing)
        for seed, path in enumerate(rough[: effort.finalists])
    ]
    return min(polished, key=lambda path: asked.value(length, kinematic, path))


def _from_dense_graph(asked: Question, fine: PathProblem, effort: Effort) -> list[Array]:
    found = []
    for seed, spread in enumerate(effort.spreads):
        points, counts = np.zeros((1000, 3)), np.zeros(2, dtype=np.int64)
        length = lattice_path(fine, asked.ends, seeded(seed), 1, spread, points, counts)
        if length:
            found.append(_polished(fine, points[:length], seed, _FIRST_POLISHING))
    return found


def _from_long_searches(asked: Question, fine: PathProblem, effort: Effort) -> list[Array]:
    found = []
    coarse = asked.problem._replace(terms=fine.terms.copy())
    for seed in range(effort.searches):
        search = new_search(*asked.ends, 10_000 + seed)
        if np.isfinite(advance(handle_of(coarse, search), effort.rounds)):
            found.append(search.points[BEST, : search.counts[BEST, 0]].copy())
    return found


def _polished(fine: PathProblem, path: Array, seed: int, rounds: int) -> Array:
    room = max(len(path) + 8, MOST_VERTICES)
    line = Polyline(np.zeros((room, 3)), np.zeros((room, 3)), np.array([len(path), 0]))
    line.points[: len(path)] = path
    measure(fine, line)
    state = seeded(seed)
    fine.terms[VERTEX] = 0.0
    for _ in range(rounds):
        polish(fine, line, state, _TRIALS)
    return line.points[: line.counts[0]].copy()
