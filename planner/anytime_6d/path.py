"""From start to goal with the platform free to rotate: rounds until the budget is spent.

Rounds find some first paths and then polish the best of them. A round depends only on the seed and
the rounds before it, so a search can end after any round and be repeated from the number of rounds.
Where start and goal have one orientation, every other first path is of the search without rotation,
which is much faster: its path is a good one where little is gained by rotating.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from model.errors import BadInput, NoSolution
from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.anytime.path import CompiledSearch
from planner.anytime.path import load as load_level
from planner.anytime_6d import connect as connecting
from planner.anytime_6d import local_search as polishing
from planner.anytime_6d.connect import connect
from planner.anytime_6d.local_search import Line, copied, line_length, measure, new_line, polish
from planner.anytime_6d.problem import (
    RotatingProblem,
    build_objective,
    move_allowed,
    move_length,
    set_weights,
)
from planner.collision.world import build_robot, build_world
from planner.costs import KinematicCost, LimitedSearch, margin_reserve
from planner.edge_checks import REASONS
from planner.path import Progress, Route
from planner.settings import (
    CLEARANCE_RESERVE,
    TurningSettings,
    Weights,
    least_rounds,
)
from planner.space import PoseSpace
from planner.wrench.capacity import build_load

_KEPT = 6
_SAMPLES, _TRIALS = 50, 40
_ANOTHER_EVERY = 30
"""After the first rounds, one in this many begins with a new path."""
_TO_THE_BEST = 0.5
_LEVEL_ROUNDS = 4
"""Rounds of the search without rotation before each path taken from it."""


@dataclass(slots=True, eq=False)
class _Kept:
    """A path under improvement, and its cost."""

    line: Line
    cost: float


class RotatingSearch:
    """The state of a search.

    Attributes:
        rounds: Done so far.
        tallies: Moves checked, by what forbids them; see `planner.anytime_6d.problem`.
        first: The very first path, shape (k, 7); empty without one.
    """

    def __init__(
        self,
        problem: RotatingProblem,
        start: Array,
        goal: Array,
        seed: int,
        level: CompiledSearch | None = None,
    ) -> None:
        """A search that has not begun.

        Args:
            problem: Limits and costs.
            start: Shape (7,).
            goal: Shape (7,).
            seed: Of the random numbers.
            level: The search without rotation; None where start and goal differ in orientation.
        """
        self.problem = problem
        self.rounds = 0
        self.tallies = np.zeros(6, dtype=np.int64)
        self.first: Array = np.zeros((0, 7))
        self._ends = np.stack([start, goal])
        self._random = np.random.default_rng(seed)
        self._level, self._level_is_next, self._level_checks = level, True, 0
        self._kept: list[_Kept] = []
        self._best: _Kept | None = None
        self._trees = np.zeros((2, connecting.NODES, 7))
        self._parents = np.zeros((2, connecting.NODES), dtype=np.int64)
        self._grown = np.zeros(3, dtype=np.int64)

    @property
    def cost(self) -> float:
        """Cost of the best path; infinite without one."""
        return math.inf if self._best is None else self._best.cost

    @property
    def checks(self) -> int:
        """Number of moves checked."""
        return int(self.tallies.sum()) + self._level_checks

    @property
    def path(self) -> Array | None:
        """The best path, shape (k, 7); None without one."""
        if self._best is None:
            return None
        line = self._best.line
        return line.poses[: line.counts[0]].copy()

    @property
    def length(self) -> float:
        """Length of the best path, rotation counted, [m]; infinite without one."""
        if self._best is None:
            return math.inf
        return float(line_length(self.problem, self._best.line))

    @property
    def shortest(self) -> float:
        """Lower bound of the length of any path, [m]."""
        return float(move_length(self._ends[0], self._ends[1], self.problem.objective.radian))

    def weigh(self, weights: Weights) -> None:
        """Changes the weights of the objective."""
        set_weights(self.problem.objective, weights)
        if self._level is not None:
            self._level.weigh(weights)
        for kept in (*self._kept, *filter(None, [self._best])):
            kept.cost = float(measure(self.problem, kept.line))
        for kept in self._kept:
            self._note(kept)

    def cost_by(self, weights: Weights) -> float:
        """Cost of the best path by other weights; infinite without one."""
        if self._best is None:
            return math.inf
        objective = self.problem.objective
        problem = self.problem._replace(objective=objective._replace(weights=np.zeros(4)))
        set_weights(problem.objective, weights)
        return float(measure(problem, copied(self._best.line)))

    def gap(self) -> float:
        """Smallest distance between positions in the two trees, [m]."""
        first, second = (self._trees[k, : max(self._grown[k], 1), :3] for k in (0, 1))
        if self._grown[0] == 0:
            first, second = self._ends[:1, :3], self._ends[1:, :3]
        return smallest_gap(first, second)

    def advance(self) -> None:
        """Does one round."""
        begun = self.rounds
        self.rounds += 1
        kept = self._chosen(begun)
        if kept is None:
            return
        draws = self._random.random((_TRIALS, polishing.DRAWS))
        kept.cost = float(polish(self.problem, kept.line, draws, self.tallies))
        self._note(kept)

    def _note(self, kept: _Kept) -> None:
        """Keeps a copy of the best path: leaving poses out may make a path slightly worse."""
        if kept.cost < self.cost:
            self._best = _Kept(copied(kept.line), kept.cost)

    def _chosen(self, begun: int) -> _Kept | None:
        """Which path to polish; a new one now and then."""
        if len(self._kept) < _KEPT or begun % _ANOTHER_EVERY == 0:
            new = self._begun()
            if new is not None:
                self._note(new)
                if len(self._kept) == _KEPT:
                    self._kept.remove(max(self._kept, key=lambda kept: kept.cost))
                self._kept.append(new)
                return new
        if not self._kept:
            return None
        if self._random.random() < _TO_THE_BEST:
            return min(self._kept, key=lambda kept: kept.cost)
        return self._kept[int(self._random.random() * len(self._kept))]

    def _begun(self) -> _Kept | None:
        line, count = new_line(), 0
        if self._level is not None and self._level_is_next:
            count = self._without_rotation(self._level, line.poses)
        self._level_is_next = count == 0
        if count == 0:
            count = self._connected(line.poses)
        if count == 0:
            return None
        if not len(self.first):
            self.first = line.poses[:count].copy()
        line.counts[0] = count
        return _Kept(line, float(measure(self.problem, line)))

    def _connected(self, poses: Array) -> int:
        """Writes a path of the two trees; its number of poses, 0 if they have not met."""
        draws = self._random.random((_SAMPLES, connecting.DRAWS))
        count = connect(
            self.problem,
            self._ends,
            draws,
            self._trees,
            self._parents,
            self._grown,
            self.tallies,
            poses,
        )
        if count > 0:
            self._grown[:] = 0
        return int(count)

    def _without_rotation(self, level: CompiledSearch, poses: Array) -> int:
        """Writes the best path without rotation; its number of poses, 0 if there is none.

        That search keeps a smaller reserve of the capacity margin, so its path may be refused here.
        After one failure it is not asked again: its rounds without a path take long.
        """
        for _ in range(_LEVEL_ROUNDS):
            level.advance()
        path, self._level_checks = level.path, level.checks
        if path is not None and len(path) <= len(poses):
            found = poses[: len(path)]
            found[:, :3], found[:, 3:] = path, self._ends[0, 3:]
            if all(move_allowed(self.problem, *ends, self.tallies) for ends in pairwise(found)):
                return len(path)
        self._level = None
        return 0


def smallest_gap(first: Array, second: Array) -> float:
    """The smallest distance between the nodes of two trees, [m].

    Row by row: all pairs of two full trees at once take 1 GB.

    Args:
        first: Positions, shape (i, 3), [m].
        second: Positions, shape (j, 3), [m].
    """
    return min(float(np.linalg.norm(second - node, axis=-1).min()) for node in first)


# The search as called from the planner.


Clock = Callable[[], float]

_REPORT_EVERY = 20
_ROTATION_ROUND_OFF = 2.5e-6
"""Added to the rotation limits, [rad]: ends at a limit may exceed it by round-off in files of up to
2e-6; the check tolerates 3e-6."""


def rotating_problem(
    rig: Rig, scene: Scene, weights: Weights, kinematic: KinematicCost
) -> RotatingProblem:
    """The problem of a scene, with the reserves that `planner.settings` documents.

    Raises:
        BadInput: The scene has no rotation limits.
    """
    limits = scene.rotation_limits
    if limits is None:
        raise BadInput(
            "the scene has no limits for rotation",
            where=f"scene {scene.name}",
            why="`free_rotation=True` searches orientations within the scene's rotation_limits",
            next_step="add a line such as `rotation_limits: {tilt_deg: 8, turn_deg: 2}` that start,"
            " stops and goal keep",
        )
    rotation = np.array(scene.start.rotation)
    world = build_world(rig, scene, rotation, scene.obstacle_clearance + CLEARANCE_RESERVE)
    return RotatingProblem(
        world=world,
        robot=build_robot(rig, world, scene.self_clearance + CLEARANCE_RESERVE),
        load=build_load(rig, scene, rotation),
        reserve=margin_reserve(rig, scene.load, turns=True),
        tilt=limits.tilt + _ROTATION_ROUND_OFF,
        turn=limits.turn + _ROTATION_ROUND_OFF,
        objective=build_objective(weights, kinematic),
    )


def rotating_route(
    rig: Rig,
    scene: Scene,
    settings: TurningSettings,
    kinematic: KinematicCost,
    progress: Progress | None = None,
    clock: Clock = time.perf_counter,
) -> Route:
    """Finds a path in `PoseSpace` and improves it until the budget is spent.

    Args:
        scene: Obstacles, clearances, load, rotation limits, start and goal.
        settings: Objective, seed and budget.
        kinematic: The cost of poses at the start's orientation, which gives its scaling.
        progress: Called with the time spent [s] and the budget, or rounds, and the cost.
        clock: Seconds; decides when a budget is spent.

    Raises:
        BadInput: The scene has no rotation limits.
        NoSolution: No path was found, or none is short enough.
    """
    weights = settings.weights.normalized()
    problem = rotating_problem(rig, scene, weights, kinematic)
    space = PoseSpace(rig)
    start, goal = space.coordinates(scene.start), space.coordinates(scene.goal)
    _load(RotatingSearch(problem, start, goal, settings.seed), weights)

    def level_search(at: Scene, by: Weights) -> CompiledSearch | None:
        if not np.array_equal(start[3:], goal[3:]):
            return None
        level = CompiledSearch(rig, at, by, kinematic, settings.seed)
        load_level(level)
        return level

    def begin(at: Scene, by: Weights) -> RotatingSearch:
        own, level = rotating_problem(rig, at, by, kinematic), level_search(at, by)
        return RotatingSearch(own, start, goal, settings.seed, level)

    to_do: RotatingSearch | LimitedSearch[RotatingSearch]
    if settings.longest < math.inf:
        to_do = LimitedSearch(begin, scene, weights, settings.longest, kinematic)
        search = to_do.first
    else:
        level = level_search(scene, weights)
        to_do = search = RotatingSearch(problem, start, goal, settings.seed, level)
    began, spent, rounds = clock(), 0.0, 0
    while not _is_over(settings, search, rounds, spent):
        to_do.advance()
        rounds, spent = rounds + 1, clock() - began
        if progress is not None and rounds % _REPORT_EVERY == 0:
            settings.report(progress, rounds, spent, to_do.cost)
    path = to_do.path
    if path is None:
        raise _no_path(scene, search, settings)
    return Route.from_rounds(path, search.first, rounds, to_do.checks, clock() - began)


def _load(search: RotatingSearch, weights: Weights) -> None:
    """Calls every kernel of a round once, so that compiling or loading is not timed."""
    search.advance()
    search.cost_by(weights)


def _is_over(settings: TurningSettings, search: RotatingSearch, rounds: int, spent: float) -> bool:
    if settings.weights.is_length and search.cost <= search.shortest * (1.0 + 1e-12):
        return True
    has_limit = settings.longest < math.inf
    least = least_rounds(has_limit=has_limit, has_clearance=False)  # is demanded with a limit only
    return settings.is_over(rounds, spent, least)


def _no_path(scene: Scene, search: RotatingSearch, settings: TurningSettings) -> NoSolution:
    names = (*REASONS, "rotation limits")
    refused = [
        (int(count), name)
        for count, name in zip(search.tallies, names, strict=True)
        if name and count
    ]
    listed = ", ".join(f"{name} ({count})" for count, name in sorted(refused, reverse=True))
    gap = search.gap()
    values: dict[str, float | str] = {
        "rounds": float(search.rounds),
        "seed": float(settings.seed),
        "best_distance_mm": gap * 1e3,
    }
    if search.path is not None:
        return settings.too_long(f"scene {scene.name}", search.length, search.shortest, values)
    return NoSolution(
        settings.not_found(search.rounds, gap),
        where=f"scene {scene.name}",
        why=f"it is not proved that no path exists; moves were refused for: {listed}",
        next_step=f"{settings.longer}, reduce the clearance, widen rotation_limits, try"
        " another seed, or move the goal or an obstacle",
        values=values,
    )
