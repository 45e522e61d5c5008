"""Our planner under the same question and the same clock as OMPL's."""

from __future__ import annotations

import time
from collections.abc import Sequence

import compiled_rrt
import numpy as np
from numpy.typing import NDArray
from result import Result

from model.rig import Rig
from model.scene import Scene
from planner.anytime.connect import connect
from planner.anytime.prepare import problem_of
from planner.anytime.problem import PathProblem
from planner.anytime.random import State
from planner.anytime.rounds import advance
from planner.anytime.state import BEST, AnytimeSearch, new_search
from planner.costs import KinematicCost
from planner.kernels.jit import kernel
from planner.settings import Weights

NAME = "optimal"
Array = NDArray[np.float64]
Integers = NDArray[np.int64]
_SAMPLES = 100_000
_MANY = 2000


class Contestant:
    """The planner that `cdpr plan` uses, for the shortest path.

    It keeps more than the others are asked to: self clearance and wrench feasibility (on the
    paper's rig both are proved for the whole workspace before the search), and a small reserve.
    """

    def __init__(self, rig: Rig, scene: Scene) -> None:
        """Makes the problem once and has the machine code made."""
        cost = KinematicCost(rig, scene.start.rotation)
        self._problem = problem_of(rig, scene, Weights(length=1.0), cost)
        self._start, self._goal = (np.array(p.position) for p in (scene.start, scene.goal))
        advance(self._problem, new_search(self._start, self._goal, 0), 1)
        self._first(0)

    def run(self, seed: int, marks_s: Sequence[float]) -> Result:
        """Runs until the last mark."""
        first = self._first(seed)
        search = new_search(self._start, self._goal, seed)
        lengths: list[float] = []
        begin = time.process_time()
        while len(lengths) < len(marks_s):
            length = advance(self._problem, search, 1)
            spent = time.process_time() - begin
            while len(lengths) < len(marks_s) and spent >= marks_s[len(lengths)]:
                lengths.append(float(length))
        path = search.points[BEST, : search.counts[BEST, 0]].copy()
        return Result(first, tuple(lengths), _checks(search), path)

    @property
    def open_comparisons(self) -> int:
        """Of cables with each other and the platform: those not proved over the whole workspace."""
        robot = self._problem.robot
        return len(robot.open_pairs) + len(robot.open_cables)

    def rounds_us(self, rounds: int, seed: int) -> float:
        """Processor time of so many rounds of the search, [µs]; not a number without a path."""
        search = new_search(self._start, self._goal, seed)
        begin = time.process_time()
        length = advance(self._problem, search, rounds)
        spent = time.process_time() - begin
        return spent * 1e6 if np.isfinite(length) else float("nan")

    def mean_first_us(self) -> float:
        """Mean processor time to the first path inside compiled code, [µs].

        Without what one call from Python costs, which OMPL pays at every check instead.
        """
        search = new_search(self._start, self._goal, 0)
        args = (self._problem, search.ends, search.state, search.trees)
        rest = (search.parents, search.grown, search.points[0])
        _many(*args, *rest, 1)
        begin = time.process_time()
        found = _many(*args, *rest, _MANY)
        spent = time.process_time() - begin
        return spent / _MANY * 1e6 if found == _MANY else np.inf

    def mean_rival_us(self, share: float) -> float:
        """The same of RRTConnect, compiled, its steps at most a share of the space's extent."""
        low, high = self._problem.world.limits
        extent = float(np.linalg.norm(high - low))
        return compiled_rrt.mean_first_us(self._problem, self._start, self._goal, share * extent)

    def _first(self, seed: int) -> float:
        """Processor time to the first path, [s]."""
        search = new_search(self._start, self._goal, seed)
        path = search.points[0]
        begin = time.process_time()
        found = connect(
            self._problem, search.ends, search.state, search.trees, search.parents, search.grown,
            _SAMPLES, path,
        )  # fmt: skip
        spent = time.process_time() - begin
        return spent if found else np.inf


@kernel
def _many(
    problem: PathProblem, ends: Array, state: State, trees: Array, parents: Integers, grown:
        Integers,
    path: Array, times: int,
) -> int:  # fmt: skip
    """Searches for a first path so many times; returns how often there was one."""
    found = 0
    for _ in range(times):
        grown[:] = 0
        if connect(problem, ends, state, trees, parents, grown, _SAMPLES, path) > 0:
            found += 1
    return found


def _checks(search: AnytimeSearch) -> int:
    return int(search.totals[2] + search.counts[:, 1].sum())
