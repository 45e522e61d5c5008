"""The search in rounds: some first paths, and more and more polishing of the best of them.

A round depends on the seed and on the rounds before alone. So a search can end after any of them,
and be repeated from the number of rounds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from model.pose import Array
from planner.anytime_6d import connect as connecting
from planner.anytime_6d import local_search as polishing
from planner.anytime_6d.connect import connect
from planner.anytime_6d.local_search import Line, copied, line_length, measure, new_line, polish
from planner.anytime_6d.moves import move_length
from planner.anytime_6d.problem import RotatingProblem, set_weights
from planner.settings import Weights

_KEPT = 6
_SAMPLES, _TRIALS = 50, 40
_ANOTHER_EVERY = 30
"""After the first rounds, one in this many begins with a new path."""
_TO_THE_BEST = 0.5


@dataclass(slots=True, eq=False)
class _Kept:
    """A path under improvement, and what it costs."""

    line: Line
    cost: float


class RotatingSearch:
    """The state of a search.

    Attributes:
        rounds: Done so far.
        tallies: Moves asked about, by what forbids them; see `planner.anytime_6d.problem`.
        first: The very first path, shape (k, 7); empty without one.
    """

    def __init__(self, problem: RotatingProblem, start: Array, goal: Array, seed: int) -> None:
        """A search that has not begun; start and goal shape (7,)."""
        self.problem = problem
        self.rounds = 0
        self.tallies = np.zeros(6, dtype=np.int64)
        self.first: Array = np.zeros((0, 7))
        self._ends = np.stack([start, goal])
        self._random = np.random.default_rng(seed)
        self._kept: list[_Kept] = []
        self._best: _Kept | None = None
        self._trees = np.zeros((2, connecting.NODES, 7))
        self._parents = np.zeros((2, connecting.NODES), dtype=np.int64)
        self._grown = np.zeros(3, dtype=np.int64)

    @property
    def cost(self) -> float:
        """What the best path costs; infinite without one."""
        return math.inf if self._best is None else self._best.cost

    @property
    def path(self) -> Array | None:
        """The best path, shape (k, 7); None without one."""
        if self._best is None:
            return None
        line = self._best.line
        return line.poses[: line.counts[0]].copy()

    @property
    def length(self) -> float:
        """Length of the best path, turning counted, [m]; infinite without one."""
        if self._best is None:
            return math.inf
        return float(line_length(self.problem, self._best.line))

    @property
    def shortest(self) -> float:
        """Length that no path is below, [m]."""
        return float(move_length(self._ends[0], self._ends[1], self.problem.objective.radian))

    def weigh(self, weights: Weights) -> None:
        """Changes what is made small."""
        set_weights(self.problem.objective, weights)
        for kept in (*self._kept, *filter(None, [self._best])):
            kept.cost = float(measure(self.problem, kept.line))
        for kept in self._kept:
            self._note(kept)

    def cost_by(self, weights: Weights) -> float:
        """What the best path costs by other weights; infinite without one."""
        if self._best is None:
            return math.inf
        objective = self.problem.objective
        problem = self.problem._replace(objective=objective._replace(weights=np.zeros(4)))
        set_weights(problem.objective, weights)
        return float(measure(problem, copied(self._best.line)))

    def gap(self) -> float:
        """Smallest distance of positions in the two trees, [m]."""
        first, second = (self._trees[k, : max(self._grown[k], 1), :3] for k in (0, 1))
        if self._grown[0] == 0:
            first, second = self._ends[:1, :3], self._ends[1:, :3]
        return float(np.linalg.norm(first[:, None, :] - second[None, :, :], axis=-1).min())

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
        """Keeps a copy of the best: leaving poses out may make those under work a little worse."""
        if kept.cost < self.cost:
            self._best = _Kept(copied(kept.line), kept.cost)

    def _chosen(self, begun: int) -> _Kept | None:
        """Which path to work on; a new one now and then."""
        if len(self._kept) < _KEPT or begun % _ANOTHER_EVERY == 0:
            new = self._begun()
            if new is not None:
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
        line = new_line()
        draws = self._random.random((_SAMPLES, connecting.DRAWS))
        count = connect(
            self.problem,
            self._ends,
            draws,
            self._trees,
            self._parents,
            self._grown,
            self.tallies,
            line.poses,
        )
        if count == 0:
            return None
        self._grown[:] = 0
        if not len(self.first):
            self.first = line.poses[:count].copy()
        line.counts[0] = count
        return _Kept(line, float(measure(self.problem, line)))
