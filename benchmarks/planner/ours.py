"""Our planner on the same problem and with the same clock as OMPL's."""

from __future__ import annotations

import time
from collections.abc import Sequence

import compiled_rrt
import numpy as np
from result import Result

from model.rig import Rig
from model.scene import Scene
from planner.anytime.path import advance, handle_of, sampled_path
from planner.anytime.problem import problem_of
from planner.anytime.state import BEST, TESTS_BEFORE, AnytimeSearch, Handle, new_search
from planner.costs import KinematicCost
from planner.kernels.jit import kernel
from planner.settings import Weights

NAME = "optimal"
_TRIES = 10
"""Alternations of trees and roadmap in a call."""
_MANY = 2000


class Contestant:
    """The planner of `cdpr plan`, for the shortest path.

    It keeps more limits than the others: self clearance and wrench feasibility (on the paper's rig
    both are proved for the whole workspace before the search), and a small reserve.
    """

    def __init__(self, rig: Rig, scene: Scene) -> None:
        """Builds the problem once and compiles the machine code."""
        cost = KinematicCost(rig, scene.start.rotation)
        self._problem = problem_of(rig, scene, Weights(length=1.0), cost)
        self._start, self._goal = (np.array(p.position) for p in (scene.start, scene.goal))
        advance(handle_of(self._problem, new_search(self._start, self._goal, 0)), 1)
        self._first(0)

    def run(self, seed: int, marks_s: Sequence[float]) -> Result:
        """Runs until the last mark."""
        first = self._first(seed)
        search = new_search(self._start, self._goal, seed)
        handle, lengths = handle_of(self._problem, search), list[float]()
        length = np.inf
        begin = time.process_time()
        while len(lengths) < len(marks_s):
            known, length = length, float(advance(handle, 1))
            spent = time.process_time() - begin
            while len(lengths) < len(marks_s) and spent >= marks_s[len(lengths)]:
                lengths.append(known)
        path = search.points[BEST, : search.counts[BEST, 0]].copy()
        return Result(first, tuple(lengths), _checks(search), path)

    @property
    def open_comparisons(self) -> int:
        """Number of self-clearance comparisons not proved over the whole workspace."""
        robot = self._problem.robot
        return len(robot.open_pairs) + len(robot.open_cables)

    def rounds_us(self, rounds: int, seed: int) -> float:
        """Processor time of ``rounds`` rounds of the search, [µs]; NaN without a path."""
        search = new_search(self._start, self._goal, seed)
        handle = handle_of(self._problem, search)
        begin = time.process_time()
        length = advance(handle, rounds)
        spent = time.process_time() - begin
        return spent * 1e6 if np.isfinite(length) else float("nan")

    def mean_first_us(self) -> float:
        """Mean processor time to the first path inside compiled code, [µs].

        Without the cost of a call from Python, which OMPL pays at every check.
        """
        handle = handle_of(self._problem, new_search(self._start, self._goal, 0))
        _many(handle, 1)
        begin = time.process_time()
        found = _many(handle, _MANY)
        spent = time.process_time() - begin
        return spent / _MANY * 1e6 if found == _MANY else np.inf

    def mean_rival_us(self, share: float) -> float:
        """The same for compiled RRTConnect, with steps up to a share of the space's extent."""
        low, high = self._problem.world.limits
        extent = float(np.linalg.norm(high - low))
        return compiled_rrt.mean_first_us(self._problem, self._start, self._goal, share * extent)

    def _first(self, seed: int) -> float:
        """Processor time to the first path, [s]."""
        handle = handle_of(self._problem, new_search(self._start, self._goal, seed))
        begin = time.process_time()
        found = first_path(handle)
        spent = time.process_time() - begin
        return spent if found else np.inf


@kernel
def first_path(handle: Handle) -> int:
    """The beginning of a round: the two trees and the roadmap, without polishing.

    Called again it continues. Returns the number of vertices; 0 where there is no path yet.
    """
    search = handle.search
    for _ in range(_TRIES):
        found = sampled_path(handle.problem, search, search.points[0])
        if found > 0:
            return found  # type: ignore[no-any-return]
    return 0


@kernel
def _many(handle: Handle, times: int) -> int:
    """Searches for a first path ``times`` times; returns how often one was found."""
    found = 0
    for _ in range(times):
        handle.search.trees.counts[:] = 0
        handle.search.roadmap.made[:] = 0
        if first_path(handle) > 0:
            found += 1
    return found


def _checks(search: AnytimeSearch) -> int:
    return int(search.totals[TESTS_BEFORE] + search.counts[:, 1].sum())
