"""The best path that is no longer than asked: a price λ of length is raised until it holds.

With the objective plus λ times the length, a higher λ gives a shorter path. After every few rounds
λ is moved by halving towards the least that keeps the limit; the best path that did is kept.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cdpr.poses import Array
from planner.optimal.polyline import measure, polyline_of
from planner.optimal.preparation import set_weights
from planner.optimal.problem import Problem
from planner.optimal.rounds import measure_again
from planner.optimal.search import BEST, Search
from planner.optimal.settings import OptimalSettings

_ROUNDS = 6
"""Between changes of λ."""
_MOST = 64.0
"""λ with which the length is practically all that counts, in units of the objective."""


class LengthLimit:
    """The search for λ, told after every round.

    Attributes:
        path: The best path found that is short enough, shape (k, 3), [m]; None without one.
    """

    def __init__(self, settings: OptimalSettings) -> None:
        """Begins without a price of length."""
        self._settings = settings
        self._low, self._high, self._price = 0.0, math.inf, 0.0
        self._rounds = 0
        self._least = math.inf
        self.path: Array | None = None

    def after_round(self, problem: Problem, search: Search) -> None:
        """Looks at the best path, and changes λ when it is time to."""
        if not search.costs[BEST] < math.inf:
            return
        path = search.points[BEST, : search.counts[BEST, 0]].copy()
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        short_enough = length <= self._settings.longest
        if short_enough:
            self._keep(problem, path)
        self._rounds += 1
        if self._rounds % _ROUNDS == 0:
            self._move(problem, search, short_enough)

    def _keep(self, problem: Problem, path: Array) -> None:
        """Keeps a path if it is the best by the objective alone."""
        set_weights(problem, self._settings.weights)
        cost = float(measure(problem, polyline_of(path)))
        if cost < self._least:
            self._least, self.path = cost, path
        self._set(problem)

    def _move(self, problem: Problem, search: Search, short_enough: bool) -> None:
        if short_enough:
            self._high = self._price
        else:
            self._low = self._price
        if self._high == 0.0:
            return  # the objective alone keeps the limit
        if self._high == math.inf:
            self._price = min(max(4.0 * self._price, 0.25 * self._unit(problem)), _MOST)
        else:
            self._price = (self._low + self._high) / 2.0
        self._set(problem)
        measure_again(problem, search)

    def _unit(self, problem: Problem) -> float:
        weights = self._settings.weights
        return weights.length + weights.kinematic * float(problem.kinematic.mean())

    def _set(self, problem: Problem) -> None:
        weights = self._settings.weights
        set_weights(problem, replace(weights, length=weights.length + self._price))
