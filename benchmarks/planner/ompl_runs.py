"""OMPL's planners on a rig in a scene, with either checker, one run after the other.

The length of the best path is read whenever OMPL asks whether to stop, so one call of ``solve``
gives the whole curve (in 2.0.1 a second call hangs for AORRTC). Time is the processor time of this
process: other work on the machine does not count.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from checkers import SPACING, EdgeCheck, FclStates
from ompl import base, geometric, util
from result import Result

from model.pose import Array
from model.rig import Rig
from model.scene import Scene

PLANNERS = ("RRTConnect", "RRTConnect*", "RRTstar", "InformedRRTstar", "BITstar", "AORRTC")
"""`RRTConnect*` is RRTConnect with unlimited steps, which suits exact edges best."""


class Question:
    """A start, a goal and a checker, in OMPL's form."""

    def __init__(self, rig: Rig, scene: Scene, check: EdgeCheck | FclStates) -> None:
        """Builds the space once; every run gets its own planner and problem."""
        self._space = base.RealVectorStateSpace(3)
        bounds = base.RealVectorBounds(3)
        for axis in range(3):
            bounds.setLow(axis, float(rig.workspace_lower[axis]))
            bounds.setHigh(axis, float(rig.workspace_upper[axis]))
        self._space.setBounds(bounds)
        self.information = base.SpaceInformation(self._space)
        self.checks = 0
        if isinstance(check, FclStates):
            self._check_states(check)
        else:
            self._check_edges(check)
        self.information.setup()
        self.ends = self._state(scene.start.position), self._state(scene.goal.position)

    def run(self, planner: str, marks_s: Sequence[float]) -> Result:
        """Runs a planner until the last mark, or its first path if it does not improve paths."""
        self.checks = 0
        problem = base.ProblemDefinition(self.information)
        problem.setStartAndGoalStates(*self.ends)
        problem.setOptimizationObjective(base.PathLengthOptimizationObjective(self.information))
        made = getattr(geometric, planner.rstrip("*"))(self.information)
        if planner.endswith("*"):
            made.setRange(self._space.getMaximumExtent())
        made.setProblemDefinition(problem)
        made.setup()
        if not hasattr(made, "bestCost"):
            return self._first_path(made, problem, marks_s)
        curve = _Curve(lambda: float(made.bestCost().value()), marks_s)
        made.solve(base.PlannerTerminationCondition(curve.stop))
        curve.finish()
        path = _vertices(problem)
        return Result(curve.first, tuple(curve.lengths), self.checks, path)

    def _first_path(self, made: Any, problem: Any, marks_s: Sequence[float]) -> Result:
        begin = time.process_time()
        made.solve(marks_s[-1])
        spent = time.process_time() - begin
        path = _vertices(problem)
        first = spent if len(path) else np.inf
        length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) if len(path) else np.inf
        lengths = tuple(length if first <= mark else np.inf for mark in marks_s)
        return Result(first, lengths, self.checks, path)

    def _check_edges(self, check: EdgeCheck) -> None:
        question = self

        class Edges(base.MotionValidator):  # type: ignore[misc]
            def checkMotion(self, a: Any, b: Any) -> bool:  # noqa: N802  OMPL's name
                question.checks += 1
                return check(a[0], a[1], a[2], b[0], b[1], b[2])

        def valid(state: Any) -> bool:
            x, y, z = state[0], state[1], state[2]
            return check(x, y, z, x, y, z)

        self._validator = Edges(self.information)
        self.information.setStateValidityChecker(valid)
        self.information.setMotionValidator(self._validator)

    def _check_states(self, check: FclStates) -> None:
        def valid(state: Any) -> bool:
            self.checks += 1
            return check.free(state[0], state[1], state[2])

        self.information.setStateValidityChecker(valid)
        share = SPACING / self._space.getMaximumExtent()
        self.information.setStateValidityCheckingResolution(share)

    def _state(self, position: Array) -> Any:
        state = self._space.allocState()
        for axis in range(3):
            state[axis] = float(position[axis])
        return state


class _Curve:
    """The best length over processor time, read when OMPL asks whether to stop."""

    def __init__(self, best: Callable[[], float], marks_s: Sequence[float]) -> None:
        self._best, self._marks = best, marks_s
        self.first, self.lengths = np.inf, [np.inf] * len(marks_s)
        self._next = 0
        self._begin = time.process_time()

    def stop(self) -> bool:
        if self._next == len(self._marks):
            return True
        now = time.process_time() - self._begin
        known = np.isfinite(self.first)
        if known and now < self._marks[self._next]:
            return False
        length = self._best()
        if not known and np.isfinite(length):
            self.first = now
        while self._next < len(self._marks) and now >= self._marks[self._next]:
            self.lengths[self._next] = length if self.first <= self._marks[self._next] else np.inf
            self._next += 1
        return self._next == len(self._marks)

    def finish(self) -> None:
        """A planner that stopped by itself keeps its last length."""
        for mark in range(self._next, len(self._marks)):
            self.lengths[mark] = self._best()


def seed(number: int) -> None:
    """Seeds OMPL's random numbers; it allows this once per process."""
    util.setLogLevel(util.LogLevel.LOG_NONE)
    util.RNG.setSeed(number)


def _vertices(problem: Any) -> Array:
    if not problem.hasExactSolution():
        return np.zeros((0, 3))
    states = problem.getSolutionPath().getStates()
    return np.array([[state[axis] for axis in range(3)] for state in states])
