"""One control cycle: advance in the table, ask the gate, send, receive, monitor."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.drive_group import CycleStatus, GroupState
from drivers.factory import without_torque
from executor.control.sync_master import SyncMaster
from executor.safety.fault_messages import Alarm, StopReaction
from executor.safety.gate import ALLOWED, GateDecision, Purpose, Request, examine
from executor.safety.limits import gate_limits, monitor_limits, stuck_limits
from executor.safety.monitor import Monitor, Observation
from executor.safety.stall import StuckWatch
from executor.trajectory.setpoints import CheckedSetpoints
from executor.trajectory.time_scaling import smooth_step, smooth_step_duration, speed_change
from model.pose import Array
from model.rig import Motion

#: Cycles at rest before and after the motion.
SETTLING = 10


class Feed:
    """Index into the set-point table; advances with every cycle sent, never by a clock.

    Normal feed is exactly one row per cycle. Changes of rate are jerk-limited, so all
    drives change speed together along the path. It never runs backwards, nor faster
    than the table was timed for.
    """

    def __init__(self, rows: int, cycle: float, motion: Motion, *, rate: float = 1.0) -> None:
        """A feed at row 0.

        Args:
            rows: Length of the table.
            cycle: [s].
            motion: Limits; at the path's full speed a change of rate keeps to its acceleration and
                jerk.
            rate: Initial rate; full for a table that begins at rest.
        """
        self.index = 0.0
        self._last = rows - 1
        self._acceleration = motion.acceleration / motion.speed * cycle  # [rows a cycle²]
        self._jerk = motion.jerk / motion.speed * cycle**2  # [rows a cycle³]
        self._begin(rate)

    def _begin(self, rate: float) -> None:
        """Takes a rate without a ramp."""
        self._change = speed_change((rate, 0.0), rate, self._acceleration, self._jerk)
        self._passed = 0.0  # of the change, [cycles]
        self._wanted = rate
        self._steady = True

    @property
    def rate(self) -> float:
        """Current rate, rows per cycle; from 0 to 1, and 0 at the end."""
        if self.at_end:
            return 0.0
        return min(max(self._change.at(self._passed)[1], 0.0), 1.0)

    @property
    def wanted(self) -> float:
        """Target rate."""
        return self._wanted

    @property
    def at_end(self) -> bool:
        """Whether the last row is reached."""
        return self.index >= self._last

    @property
    def at_rest(self) -> bool:
        """Whether it stays at this row until another rate is requested."""
        return self.at_end or (self._steady and self.rate <= 0.0)

    @property
    def rows_to_rest(self) -> float:
        """Rows it still advances if it begins to slow down now."""
        _, *now = self._change.at(self._passed)
        ramp = speed_change((now[0], now[1]), 0.0, self._acceleration, self._jerk)
        return ramp.at(ramp.duration)[0]

    def extend(self, rows: int) -> None:
        """Extends to a longer table.

        Raises:
            ValueError: The table is shorter than before.
        """
        if rows - 1 < self._last:
            raise ValueError(f"a table of {self._last + 1} rows cannot become one of {rows}")
        self._last = rows - 1

    def go_to(self, rate: float) -> None:
        """Begins to change to another rate; requesting the same one again has no effect.

        Raises:
            ValueError: The rate is outside 0 to 1; the table is checked only up to full feed.
        """
        if not 0.0 <= rate <= 1.0:
            raise ValueError(f"a feed of {rate} rows a cycle is not from 0 to 1")
        if rate == self.wanted:
            return
        _, *now = self._change.at(self._passed)
        self._change = speed_change((now[0], now[1]), rate, self._acceleration, self._jerk)
        self._passed, self._wanted, self._steady = 0.0, rate, False

    def stop(self) -> None:
        """Begins to slow down to rest; before the first step it is at rest at once."""
        if self.index > 0.0:
            self.go_to(0.0)
        else:
            self._begin(0.0)

    def advance(self) -> float:
        """Table index of the next cycle."""
        if self.at_rest:
            return self.index
        step = self.rate if self._steady else self._ramped()
        self.index = min(self.index + step, float(self._last))
        return self.index

    def _ramped(self) -> float:
        """Rows passed in one cycle of a ramp."""
        before, _, _ = self._change.at(self._passed)
        self._passed += 1.0
        after, _, _ = self._change.at(self._passed)
        self._steady = self._passed >= self._change.duration
        return min(max(after - before, 0.0), 1.0)


def targets_at(setpoints: NDArray[np.int32], index: float) -> tuple[int, ...]:
    """Set-points at a table index; linearly interpolated between rows."""
    row = math.floor(index)
    if row >= len(setpoints) - 1:
        return tuple(int(v) for v in setpoints[-1])
    share = index - row
    if share == 0.0:
        return tuple(int(v) for v in setpoints[row])
    first, second = setpoints[row].astype(np.int64), setpoints[row + 1].astype(np.int64)
    # Always rounded in the same direction: to even, a step of n counts could become n + 1.
    mixed = np.floor(first + share * (second - first) + 0.5)
    return tuple(int(v) for v in mixed)


@dataclass(frozen=True, slots=True)
class CycleResult:
    """Result of one cycle.

    Attributes:
        verdict: Decision of the gate; if denied, nothing was sent and the rest is empty.
        status: What the drives reported; None if nothing was sent.
        following_error: Largest of the cables, [m]; NaN while the drives do not follow.
        lateness: In cycles.
        alarms: What the monitors found.
        tension_known: See `CycleRecord`.
    """

    verdict: GateDecision
    lateness: float
    status: CycleStatus | None = None
    following_error: float = float("nan")
    alarms: tuple[Alarm, ...] = ()
    tension_known: tuple[bool, ...] = ()


class Cycle:
    """Sends one cycle to the drives and takes their replies; sends only what the gate allows.

    Attributes:
        armed: The hash of the set-points was confirmed, and the platform is at their start.
        latched: A fault is latched.
        faulted: A fault stopped the motion along its path.
        targets: Last set-points sent; None before the first.
        index: Table index of the last set-points sent from a table.
        actual: Positions as last received, [counts].
    """

    def __init__(
        self, checked: CheckedSetpoints, master: SyncMaster, *, slack_counts: bool = True
    ) -> None:
        """Sends nothing yet; ``slack_counts`` as for `monitor_limits`."""
        rig = checked.rig
        self._rig, self._master, self._group = rig, master, master.group
        self._per_metre = np.array([w.counts_per_metre for w in rig.winches])
        self._limits = gate_limits(rig, checked.setpoints, checked.cycle)
        names = tuple(rig.drive_names.values())
        self._numbers = {node: k for k, node in enumerate(rig.drive_names, start=1)}
        limits = monitor_limits(rig, master.rule, slack_counts=slack_counts)
        self._watch = Monitor.fresh(limits, names)
        stuck = stuck_limits(rig, checked.cycle)
        self._stuck = StuckWatch.fresh(stuck, names, may_disarm=limits.may_disarm)
        self.armed = False
        self.latched = self.faulted = False
        self._unsent = 0.0
        self.targets: tuple[int, ...] | None = None
        self.index = 0.0
        self.actual: tuple[int, ...] = ()

    @property
    def resting_targets(self) -> tuple[int, ...]:
        """Targets that keep the drives still."""
        return self.targets or self.actual

    @property
    def largest_share_lost(self) -> str:
        """See `ReplyCounts.largest_share`."""
        return self._watch.replies.largest_share(self._watch.names)

    def allow(self, setpoints: NDArray[np.int32]) -> None:
        """From now on the gate allows the range of these set-points, shape (n, m)."""
        self._limits = gate_limits(self._rig, setpoints, self._rig.cycle)

    def _approach_cycles(self, first: Array, second: Array) -> int:
        """Cycles for a `smooth_step` between two sets of drive positions, shape (m,), [counts]."""
        motion, cycle = self._rig.motion, self._rig.cycle
        # The platform may move farther than its cables; so its limits are kept for twice as far.
        travel = 2.0 * float(np.max(np.abs((second - first) / self._per_metre)))
        speed = min(motion.speed, *(winch.max_speed for winch in self._rig.winches))
        cycles = SETTLING + math.ceil(2.0 * travel / (speed * cycle))
        return max(cycles, math.ceil(smooth_step_duration(travel, motion) / cycle))

    def approach(self, end: Array) -> Iterator[tuple[int, ...]]:
        """Targets of each cycle of a smooth motion to drive positions, shape (m,), [counts]."""
        begin = np.array(self.targets, dtype=np.float64)
        steps = self._approach_cycles(begin, end)
        for step in range(1, steps + 1):
            share = smooth_step(step / steps)
            yield tuple(int(v) for v in np.rint(begin + share * (end - begin)))

    def allows(self, purpose: Purpose, targets: tuple[int, ...]) -> GateDecision:
        """Decision of the gate on targets now."""
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
        """Continues from the positions at which the group enabled the drives."""
        held = tuple(int(target) for target in self._group.targets)
        first = Request(Purpose.HOLD, held, None, self.actual, self.armed, False, self.latched)
        verdict = examine(self._limits, first)
        if verdict.allowed:
            self.targets = held
        return verdict

    def cycle(
        self,
        purpose: Purpose,
        targets: tuple[int, ...],
        *,
        at_rest: bool,
        index: float | None = None,
    ) -> CycleResult:
        """One cycle.

        Args:
            purpose: Purpose of the targets.
            targets: One position per drive, [counts].
            at_rest: Nothing moves: only a cycle that would enable a drive can be late.
            index: Of the targets in a table; None if they are not from one, or those sent before.
        """
        # A cycle that was not sent has no record: the next one records its lateness.
        lateness, self._unsent = max(self._master.begin(), self._unsent), 0.0
        too_late = () if at_rest else self._too_late(lateness)
        if too_late:
            self._unsent = lateness
            return CycleResult(ALLOWED, lateness, alarms=too_late)
        verdict = self.allows(purpose, targets)
        if not verdict.allowed:
            return CycleResult(verdict, lateness)
        try:
            status = self._master.exchange(targets)
        finally:  # a fault of the bus may be found after the drives got the set-points
            if self._master.sent:
                self.targets = targets
                self.index = self.index if index is None else index
        self.actual = tuple(int(p) for p in status.positions)
        errors = self._following_errors(status)
        overdue = self._master.overdue
        lateness = max(lateness, overdue - 1.0)
        alarms = self._evaluate(status, errors, 0.0 if at_rest and not overdue else lateness)
        known = self._tension_known(status)
        return CycleResult(verdict, lateness, status, _largest(errors), alarms, known)

    def _too_late(self, lateness: float) -> tuple[Alarm, ...]:
        """Quick-stop alarms of a cycle so late that drives may have stopped on their own."""
        found = self._watch.lateness(lateness)
        return tuple(each for each in found if each.reaction is StopReaction.QUICK_STOP)

    def _following_errors(self, status: CycleStatus) -> Array:
        """Signed cable lengths, shape (m,), [m]; NaN where drives do not follow or answer."""
        if status.state is not GroupState.ENABLED:
            return np.full(len(self._per_metre), np.nan)
        errors: Array = (status.positions - status.demands) / self._per_metre
        return np.where(status.missing, np.nan, errors)

    def _tension_known(self, status: CycleStatus) -> tuple[bool, ...]:
        """See `CycleRecord`; after a fault the states of ODrives lag behind their torques."""
        if status.state is GroupState.ENABLED:
            return tuple((~status.missing).tolist())
        faulted = self.latched or self.faulted or status.state is GroupState.FAULT
        if not (faulted and self._group.capabilities.holds_on_quick_stop):
            return (False,) * len(status.missing)
        released = without_torque(self._rig, status.status_words.tolist())
        holds = (node not in released for node in self._rig.drive_names)
        return tuple(h and not m for h, m in zip(holds, status.missing.tolist(), strict=True))

    def _evaluate(self, status: CycleStatus, errors: Array, lateness: float) -> tuple[Alarm, ...]:
        following, missing = status.state is GroupState.ENABLED, status.missing.tolist()
        seen = Observation(
            following=following,
            following_errors=errors.tolist(),
            tensions=self._rig.tensions_by(status.torques).tolist(),
            missing=missing,
            faults=[(self._numbers.get(node, 0), text) for node, text in status.faults],
            lateness=lateness,
            warnings=[(self._numbers.get(w.node, 0), w.text) for w in status.warnings],
        )
        self._watch, alarms = self._watch.update(seen)
        self._stuck, stuck = self._stuck.update(
            following,
            status.positions.tolist(),
            status.set_points.tolist(),
            (~status.renewed).tolist(),
        )
        return (*alarms, *stuck)


def _largest(errors: Array) -> float:
    """Largest of the known values; NaN when none is known."""
    known = np.abs(errors[np.isfinite(errors)])
    return float(known.max()) if known.size else float("nan")
