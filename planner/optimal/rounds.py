"""The search in rounds: some first paths, and more and more polishing of the best of them.

A round costs a fraction of a millisecond, and depends on the seed and on the rounds before alone.
So a search can end after any of them, and be repeated from the number of rounds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.optimal.connect import NODES, connect
from planner.optimal.lattice_path import lattice_path
from planner.optimal.polish import polish
from planner.optimal.polyline import MOST_VERTICES, Polyline, cost_of, measure
from planner.optimal.problem import CLEARANCE, KINEMATIC, UNIT, VERTEX, Problem
from planner.optimal.random import State, seeded, uniform

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

KEPT = 6
"""Paths that are kept and polished."""
_TRIALS, _SLOW_TRIALS = 400, 100
"""Changes tried in a round; the second where clearances are asked for or edges have pulleys."""
_SAMPLES = 1000
_COARSE, _MIDDLE = 4, 2
_SPREAD = 1.0
_FINE, _FINE_FOR_LENGTH = 5, 9
"""Which of the first paths comes from all points of the grid; it takes longest where the cost is
not the length, and finds the narrow ways that matter then."""
_ANOTHER_EVERY = 8
"""After the first `KEPT` rounds, one in so many begins with a new path."""
_TO_THE_BEST = 0.7
_VERTEX_PRICES = ((2, 1.5e-3), (5, 5e-4), (12, 2e-4))
"""What a vertex must save, as part of the straight way, up to so many rounds of polishing."""
_LAST_VERTEX_PRICE = 1e-4


class Search(NamedTuple):
    """The state of a search; kernels change it in place.

    Attributes:
        ends: Start and goal, shape (2, 3), [m].
        points: Vertices of the paths kept, shape (KEPT, MOST_VERTICES, 3), [m].
        edges: See `planner.optimal.polyline.Polyline`, shape (KEPT, MOST_VERTICES, 3).
        counts: Vertices (0: no path) and edge tests of each path, shape (KEPT, 2).
        costs: Of each path; infinite for none, shape (KEPT,).
        polished: Rounds spent on each path, shape (KEPT,).
        trees: See `planner.optimal.connect.connect`, shape (2, NODES, 3), [m].
        parents: Likewise, shape (2, NODES).
        grown: Likewise (`counts`), shape (4,).
        totals: Rounds; nodes of finished trees and edge tests in them; first paths sought;
            vertices of the very first path, shape (5,).
        first: That path, shape (MOST_VERTICES, 3), [m].
        state: Of the random numbers.
    """

    ends: Array
    points: Array
    edges: Array
    counts: Integers
    costs: Array
    polished: Integers
    trees: Array
    parents: Integers
    grown: Integers
    totals: Integers
    first: Array
    state: State


def new_search(start: Array, goal: Array, seed: int) -> Search:
    """A search that has not begun; start and goal shape (3,), [m]."""
    return Search(
        ends=np.stack([start, goal]),
        points=np.zeros((KEPT, MOST_VERTICES, 3)),
        edges=np.zeros((KEPT, MOST_VERTICES, 3)),
        counts=np.zeros((KEPT, 2), dtype=np.int64),
        costs=np.full(KEPT, np.inf),
        polished=np.zeros(KEPT, dtype=np.int64),
        trees=np.zeros((2, NODES, 3)),
        parents=np.zeros((2, NODES), dtype=np.int64),
        grown=np.zeros(4, dtype=np.int64),
        totals=np.zeros(5, dtype=np.int64),
        first=np.zeros((MOST_VERTICES, 3)),
        state=seeded(seed),
    )


@kernel
def advance(problem: Problem, search: Search, rounds: int) -> float:
    """Does some rounds; returns the cost of the best path so far, infinite without one."""
    for _ in range(rounds):
        begun = search.totals[0]
        search.totals[0] += 1
        kept = _chosen(search, begun)
        if search.counts[kept, 0] == 0:
            kept = _begin(problem, search, kept)
            if kept < 0:
                continue
        problem.terms[VERTEX] = _vertex_price(problem, search, kept)
        line = _line(search, kept)
        polish(problem, line, search.state, _trials(problem))
        search.polished[kept] += 1
        search.costs[kept] = cost_of(problem, line)
    return search.costs[best_of(search)]  # type: ignore[no-any-return]


@kernel
def measure_again(problem: Problem, search: Search) -> None:
    """Finds the costs of all paths anew, after a change of what is made small."""
    for k in range(KEPT):
        if search.counts[k, 0] > 0:
            search.costs[k] = measure(problem, _line(search, k))


@kernel
def best_of(search: Search) -> int:
    """The number of the cheapest path."""
    best = 0
    for k in range(1, KEPT):
        if search.costs[k] < search.costs[best]:
            best = k
    return best


@kernel
def _trials(problem: Problem) -> int:
    slow = problem.world.pulley > 0.0 or problem.terms[CLEARANCE] > 0.0
    return _SLOW_TRIALS if slow else _TRIALS


@kernel
def _line(search: Search, kept: int) -> Polyline:
    return Polyline(search.points[kept], search.edges[kept], search.counts[kept])


@kernel
def _chosen(search: Search, begun: int) -> int:
    """Which path to work on; one without vertices is to be found first."""
    best, worst = best_of(search), 0
    for k in range(1, KEPT):
        if search.costs[k] > search.costs[worst]:
            worst = k
    if begun < KEPT or search.costs[best] == math.inf:
        return worst
    if begun % _ANOTHER_EVERY == 0:
        search.counts[worst, 0] = 0
        return worst
    if uniform(search.state) < _TO_THE_BEST:
        return best
    other = int(uniform(search.state) * KEPT)
    return other if search.counts[other, 0] > 0 else best


@kernel
def _begin(problem: Problem, search: Search, kept: int) -> int:
    """Finds another path for a place; else the best path, or -1 where there is none."""
    line, grown = _line(search, kept), search.grown
    search.costs[kept], line.counts[0] = math.inf, 0
    begun = search.totals[3]
    search.totals[3] += 1
    fine = _FINE if problem.terms[KINEMATIC] > 0.0 else _FINE_FOR_LENGTH
    if begun == fine or begun % 2 == 1:
        stride, spread = _COARSE if begun % 4 == 1 else _MIDDLE, _SPREAD
        if begun == fine:
            stride, spread = _MIDDLE if problem.world.pulley > 0.0 else 1, 0.0
        found = lattice_path(
            problem, search.ends, search.state, stride, spread, line.points, line.counts
        )
    else:
        found = connect(
            problem,
            search.ends,
            search.state,
            search.trees,
            search.parents,
            grown,
            _SAMPLES,
            line.points,
        )
    if found == 0:
        best = best_of(search)
        return best if search.costs[best] < math.inf else -1
    if begun % 2 == 0:
        search.totals[1] += grown[0] + grown[1]
        search.totals[2] += grown[2]
        grown[:] = 0
    line.counts[0], search.polished[kept] = found, 0
    if search.totals[4] == 0:
        search.totals[4], search.first[:] = found, line.points
    search.costs[kept] = measure(problem, line)
    return kept


@kernel
def _vertex_price(problem: Problem, search: Search, kept: int) -> float:
    straight = 0.0
    for axis in range(3):
        straight += (search.ends[1, axis] - search.ends[0, axis]) ** 2
    share = _LAST_VERTEX_PRICE
    for rounds, price in _VERTEX_PRICES:
        if search.polished[kept] < rounds:
            share = price
            break
    return share * math.sqrt(straight) * problem.terms[UNIT]  # type: ignore[no-any-return]
