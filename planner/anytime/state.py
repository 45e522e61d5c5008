"""The state of a search."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import config, types
from numba.experimental import structref
from numpy.typing import NDArray

from planner.anytime.connect import NODES, Trees
from planner.anytime.local_search import MOST_VERTICES
from planner.anytime.passages import ROADMAP_NODES, Roadmap
from planner.kernels.primitives import RandomState, seeded

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

KEPT = 6
"""Paths that are stored and polished."""
BEST = KEPT
"""Index of the best path so far, which is not polished."""
ROUNDS, NODES_BEFORE, TESTS_BEFORE, SOUGHT, FIRST_VERTICES, RESTARTED = range(6)
"""Indices of `AnytimeSearch.totals`."""


class AnytimeSearch(NamedTuple):
    """The state of a search; kernels change it in place.

    Attributes:
        ends: Start and goal, shape (2, 3), [m].
        points: Vertices of the paths kept and of the best, shape (KEPT + 1, MOST_VERTICES, 3), [m].
        edges: See `planner.anytime.local_search.Polyline`, shape (KEPT + 1, MOST_VERTICES, 3).
        counts: Vertices (0: no path) and edge tests of each path, shape (KEPT + 1, 2).
        costs: Of each path; infinite for none, shape (KEPT + 1,).
        polished: Rounds spent on each path, shape (KEPT,).
        trees: Of start and goal.
        roadmap: Of samples in gaps.
        totals: Rounds; nodes of finished trees and edge tests in them; first paths sought;
            vertices of the very first path; the round of the last restart, shape (6,).
        first: That path, shape (MOST_VERTICES, 3), [m].
        state: Of the random numbers.
    """

    ends: Array
    points: Array
    edges: Array
    counts: Integers
    costs: Array
    polished: Integers
    trees: Trees
    roadmap: Roadmap
    totals: Integers
    first: Array
    state: RandomState


@structref.register
class _HandleType(types.StructRef):
    """The type of a handle in compiled code."""


class _CompiledHandle(structref.StructRefProxy):
    """The type of a handle in Python."""

    problem: Any
    search: Any


class _PlainHandle(NamedTuple):
    """The same where nothing is compiled (NUMBA_DISABLE_JIT=1)."""

    problem: Any
    search: Any


structref.define_proxy(  # type: ignore[no-untyped-call]
    _CompiledHandle, _HandleType, ["problem", "search"]
)
Handle: Any = _PlainHandle if config.DISABLE_JIT else _CompiledHandle  # type: ignore[attr-defined]
"""A problem and the state of a search in it (``problem``, ``search``), as one reference.

Numba inspects every array argument at each call from Python; for the fifty of a problem and a
search that takes longer than a short search. `planner.anytime.path.handle_of` makes a handle.
"""


def new_search(start: Array, goal: Array, seed: int) -> AnytimeSearch:
    """A search that has not begun; start and goal shape (3,), [m]."""
    return AnytimeSearch(
        ends=np.stack([start, goal]),
        points=np.zeros((KEPT + 1, MOST_VERTICES, 3)),
        edges=np.zeros((KEPT + 1, MOST_VERTICES, 3)),
        counts=np.zeros((KEPT + 1, 2), dtype=np.int64),
        costs=np.full(KEPT + 1, np.inf),
        polished=np.zeros(KEPT, dtype=np.int64),
        trees=Trees(
            nodes=np.zeros((2, NODES, 3)),
            parents=np.zeros((2, NODES), dtype=np.int64),
            counts=np.zeros(4, dtype=np.int64),
            gap=np.array([np.linalg.norm(goal - start)]),
        ),
        roadmap=Roadmap(
            nodes=np.zeros((ROADMAP_NODES, 3)),
            above=np.zeros(ROADMAP_NODES, dtype=np.int64),
            parts=np.zeros(ROADMAP_NODES, dtype=np.int64),
            made=np.zeros(2, dtype=np.int64),
        ),
        totals=np.zeros(6, dtype=np.int64),
        first=np.zeros((MOST_VERTICES, 3)),
        state=seeded(seed),
    )
