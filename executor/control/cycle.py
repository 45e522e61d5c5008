"""One cycle with the drives: wait, ask the gate, send, receive, look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.drive_group import CycleStatus, GroupState
from executor.control.sync_master import SyncMaster
from executor.safety.gate import ALLOWED, GateDecision, Purpose, Request, examine
from executor.safety.limits import gate_limits, stuck_limits, watch_limits
from executor.safety.monitor import Alarm, Monitor, Observation, StopReaction
from executor.safety.stall import StuckWatch
from executor.trajectory.setpoints import CheckedSetpoints
from model.pose import Array


@dataclass(frozen=True, slots=True)
class CycleResult:
    """What came of one cycle.

    Attributes:
        verdict: Of the gate; when it denied, nothing was sent and there is nothing else.
        status: What the drives reported; None also when it was too late to send anything.
        following_error: Largest over the cables, [m]; NaN while the drives do not follow.
        lateness: In cycles.
        findings: What the watch saw.
    """

    verdict: GateDecision
    lateness: float
    status: CycleStatus | None = None
    following_error: float = float("nan")
    findings: tuple[Alarm, ...] = ()


class Cycle:
    """The way to the drives and back; nothing is sent but what the gate allows.

    Attributes:
        armed: The course's hash was confirmed, and the platform stands at its start.
        latched: A fault is latched.
        targets: Sent last; None before the first cycle with targets.
        actual: Positions as last received, [counts].
    """

    def __init__(
        self, course: CheckedSetpoints, master: SyncMaster, *, slack_counts: bool = True
    ) -> None:
        """Nothing is sent yet; what slack cables mean is as for `watch_limits`."""
        rig = course.rig
        self._rig, self._master, self._group = rig, master, master.group
        self._per_metre = np.array([w.counts_per_metre for w in rig.winches])
        self._limits = gate_limits(rig, course.setpoints, course.cycle)
        names = tuple(rig.drive_names.values())
        self._numbers = {node: k for k, node in enumerate(rig.drive_names, start=1)}
        limits = watch_limits(rig, master.rule, slack_counts=slack_counts)
        self._watch = Monitor.fresh(limits, names)
        self._stuck = StuckWatch.fresh(stuck_limits(rig, course.cycle), names)
        self.armed = False
        self.latched = False
        self._unsent = 0.0
        self.targets: tuple[int, ...] | None = None
        self.actual: tuple[int, ...] = ()

    @property
    def resting_targets(self) -> tuple[int, ...]:
        """Targets that move nothing."""
        return self.targets or self.actual

    def allow(self, setpoints: NDArray[np.int32]) -> None:
        """The gate lets the range of other set-points through from now on, shape (n, m)."""
        self._limits = gate_limits(self._rig, setpoints, self._rig.cycle)

    def largest_way(self, first: Array, second: Array) -> float:
        """The longest cable between two sets of drive positions, [m]."""
        return float(np.max(np.abs((second - first) / self._per_metre)))

    def allows(self, purpose: Purpose, targets: tuple[int, ...]) -> GateDecision:
        """What the gate says to targets now."""
        request = Request(
            purpose=purpose,
            targets=targets,
            previous=self.targets,
            actual=self.actual,
            armed=self.armed,
            enabled=self._group.state is GroupState.ENABLED,
            latched=self.latched,
        )
        return examine(self._limits, request)

    def take_over(self) -> GateDecision:
        """Goes on from where the group held each drive while it enabled them."""
        held = tuple(int(target) for target in self._group.targets)
        first = Request(Purpose.HOLD, held, None, self.actual, self.armed, False, self.latched)
        verdict = examine(self._limits, first)
        if verdict.allowed:
            self.targets = held
        return verdict

    def cycle(self, purpose: Purpose, targets: tuple[int, ...], *, at_rest: bool) -> CycleResult:
        """One cycle.

        Args:
            purpose: Why the targets are sent.
            targets: One position a drive, [counts].
            at_rest: Nothing moves, so that only a cycle that would enable a drive can be late.
        """
        # The cycle that was not sent has no record: the next one records how late it is.
        lateness, self._unsent = max(self._master.begin(), self._unsent), 0.0
        too_late = () if at_rest else self._too_late(lateness)
        if too_late:
            self._unsent = lateness
            return CycleResult(ALLOWED, lateness, findings=too_late)
        verdict = self.allows(purpose, targets)
        if not verdict.allowed:
            return CycleResult(verdict, lateness)
        status = self._master.exchange(targets)
        self.targets = targets
        self.actual = tuple(int(p) for p in status.positions)
        errors = self._following_errors(status)
        overdue = self._master.overdue
        lateness = max(lateness, overdue - 1.0)
        findings = self._look(status, errors, 0.0 if at_rest and not overdue else lateness)
        return CycleResult(verdict, lateness, status, _largest(errors), findings)

    def _too_late(self, lateness: float) -> tuple[Alarm, ...]:
        """Why nothing is sent any more: the drives have stopped by themselves meanwhile."""
        found = self._watch.lateness(lateness)
        return tuple(each for each in found if each.reaction is StopReaction.QUICK_STOP)

    def _following_errors(self, status: CycleStatus) -> Array:
        """Signed, in cable length, shape (m,), [m]; NaN while drives do not follow or answer."""
        if status.state is not GroupState.ENABLED:
            return np.full(len(self._per_metre), np.nan)
        errors: Array = (status.positions - status.demands) / self._per_metre
        return np.where(status.missing, np.nan, errors)

    def _look(self, status: CycleStatus, errors: Array, lateness: float) -> tuple[Alarm, ...]:
        following, missing = status.state is GroupState.ENABLED, status.missing.tolist()
        seen = Observation(
            following=following,
            following_errors=errors.tolist(),
            tensions=self._rig.tensions_by(status.torques).tolist(),
            missing=missing,
            faults=[(self._numbers.get(node, 0), text) for node, text in status.faults],
            lateness=lateness,
            warnings=[(self._numbers.get(w.node, 0), w.text, w.stops) for w in status.warnings],
        )
        self._watch, findings = self._watch.look(seen)
        self._stuck, stuck = self._stuck.look(
            following, status.positions.tolist(), status.demands.tolist(), missing
        )
        return (*findings, *stuck)


def _largest(errors: Array) -> float:
    """Of those that are known; NaN when none is."""
    known = np.abs(errors[np.isfinite(errors)])
    return float(known.max()) if known.size else float("nan")
