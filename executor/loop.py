"""The cyclic loop: every cycle one set of set-points out, one set of replies in, one decision.

It owns the order of things: ready → enabling → approaching → moving → (stopping) → securing → end.
Whatever happens, it ends with the drives holding by themselves (quick stop active, torque on), and
with the fault latched if there was one.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cdpr.errors import Refused
from cdpr.poses import Array
from drivers.drive_group import CycleStatus, DriveGroup, GroupCommand, GroupState
from executor.arming import require_at_start, require_capabilities, require_unchanged
from executor.clock import Clock
from executor.feed import Feed, targets_at
from executor.machine import Event, Machine, State
from executor.safety.gate import Purpose, Request, examine
from executor.safety.limits import gate_limits, watch_limits
from executor.safety.watch import Finding, Observation, Reaction, Watch
from executor.setpoints import CheckedTable

#: Cycles within which the drives must be enabled, or must hold after a stop.
PATIENCE = 300
#: Cycles of holding still before and after the motion.
SETTLING = 10


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """One cycle as it was.

    Attributes:
        cycle: Counted from the first one sent.
        state: Where the run was.
        index: Place in the table.
        targets: What was sent, [counts].
        actual: What the drives answered, [counts].
        torques: What they answered, [‰ of rated torque].
        missing: How many did not answer.
        following_error: Largest over the cables, [m]; NaN while the drives do not follow.
        lateness: In cycles.
    """

    cycle: int
    state: State
    index: float
    targets: tuple[int, ...]
    actual: tuple[int, ...]
    torques: tuple[int, ...]
    missing: int
    following_error: float
    lateness: float


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """Something worth telling: in which cycle, a stable code, and a sentence."""

    cycle: int
    code: str
    text: str


class Loop:
    """One run of one checked table on one drive group."""

    def __init__(
        self,
        checked: CheckedTable,
        group: DriveGroup,
        clock: Clock,
        *,
        stop_requested: Callable[[], bool],
        on_cycle: Callable[[CycleRecord], None] | None = None,
        on_event: Callable[[LoopEvent], None] | None = None,
    ) -> None:
        """Prepares a run; nothing is sent yet.

        Args:
            checked: The checked set-points, with the rig they are for.
            group: Configured drives.
            clock: Real or simulated.
            stop_requested: Asked every cycle; true begins a stop along the path.
            on_cycle: Called after every cycle; it must not take long.
            on_event: Called for every event.
        """
        self.machine = Machine()
        rig = checked.rig
        self._rig, self._checked, self._group, self._clock = rig, checked, group, clock
        self._stop_requested = stop_requested
        self._on_cycle = on_cycle or _nothing
        self._on_event = on_event or _nothing
        self._per_metre = np.array([w.counts_per_metre for w in rig.winches])
        self._rated = np.array([w.torque_constant for w in rig.winches])
        self._limits = gate_limits(rig, checked.table.setpoints, checked.table.cycle)
        self._watch = Watch.fresh(watch_limits(rig), rig.cable_count)
        self._feed = Feed(len(checked.table), checked.table.cycle, rig.motion)
        self._targets: tuple[int, ...] | None = None
        self._actual: tuple[int, ...] = ()
        self._armed = False
        self._cycle = 0
        self._told: set[tuple[str, int]] = set()
        self._listener_error = ""
        self.cause = ""

    def arm(self) -> None:
        """Confirms the drives' abilities, the table, and that the platform stands at its start.

        Raises:
            Refused: One of it is not so; nothing was enabled.
            HardwareMissing: A drive does not answer.
        """
        require_capabilities(self._group.capabilities, self._cycle_time)
        require_unchanged(self._checked)
        self._actual = tuple(int(p) for p in self._group.read_positions().positions)
        require_at_start(self._checked, np.array(self._actual, dtype=np.float64))
        self._armed = True

    def run(self) -> State:
        """Runs to the end; returns the last state, and `cause` says why it is not FINISHED.

        Raises:
            Refused: It was not armed.
        """
        if not self._armed:
            raise Refused("the run was not armed", where="executor")
        try:
            self.machine.on(Event.ENABLE)
            while self.machine.state in _ACTIVE:
                self._one_step()
        except Exception as error:
            self._fault("broken", f"the loop broke: {type(error).__name__}: {error}")
            self._tell("traceback", traceback.format_exc())
        except BaseException:
            self._fault("broken", "the program was ended")
            raise
        return self.machine.state

    def _one_step(self) -> None:
        match self.machine.state:
            case State.ENABLING:
                self._enable()
            case State.APPROACHING:
                self._approach()
            case State.MOVING | State.STOPPING:
                self._follow()
            case _:
                self._secure()

    def _enable(self) -> None:
        """All drives together, with targets on their actual positions."""
        self._group.command(GroupCommand.ENABLE)
        for _ in range(PATIENCE):
            status = self._send(Purpose.HOLD, self._targets or self._actual)
            if self.machine.state is not State.ENABLING:
                return
            if status is not None and status.state is GroupState.ENABLED:
                self._take_over()
                return
        self._fault("enable_timeout", f"the drives were not enabled within {PATIENCE} cycles")

    def _take_over(self) -> None:
        """Goes on from where the group held each drive while it enabled them."""
        held = tuple(int(target) for target in self._group.targets)
        first = Request(Purpose.HOLD, held, None, self._actual, self._armed, False, False)
        verdict = examine(self._limits, first)
        if not verdict.allowed:
            self._fault("gate_denied", f"the drives hold elsewhere: {verdict.reason}")
            return
        self._targets = held
        self.machine.on(Event.ENABLED)
        self._tell("enabled", "all drives are enabled and hold")

    def _approach(self) -> None:
        """From where the drives stand to the first row, smoothly; at most the start tolerance."""
        begin = np.array(self._targets, dtype=np.float64)
        end = self._checked.table.setpoints[0].astype(np.float64)
        gap = float(np.max(np.abs((end - begin) / self._per_metre)))
        steps = SETTLING + int(np.ceil(4.0 * gap / (self._rig.motion.speed * self._cycle_time)))
        for step in range(1, steps + 1):
            share = _smooth(step / steps)
            targets = tuple(int(v) for v in np.rint(begin + share * (end - begin)))
            self._send(Purpose.MOVE, targets)
            if self.machine.state is not State.APPROACHING:
                return
        self.machine.on(Event.AT_START)
        self._tell("moving", "at the start; moving along the path")

    def _follow(self) -> None:
        """One cycle along the table."""
        if self._feed.at_rest:
            self.machine.on(Event.AT_REST)
            return
        self._send(Purpose.MOVE, targets_at(self._checked.table.setpoints, self._feed.advance()))

    def _secure(self) -> None:
        """Settles, then lets the drives hold by themselves, and waits until they say so."""
        was_enabled = self._group.state is GroupState.ENABLED
        for _ in range(SETTLING if was_enabled else 0):
            self._send(Purpose.HOLD, self._targets or self._actual)
            if self.machine.state is not State.SECURING:
                return
        self._group.command(GroupCommand.QUICK_STOP)
        for _ in range(PATIENCE):
            status = self._send(Purpose.HOLD, self._targets or self._actual)
            if self.machine.state is not State.SECURING:
                return
            if status is not None and status.stopped and (status.holding or not was_enabled):
                self.machine.on(Event.HELD)
                self._tell("held", _HELD if status.holding else _NEVER_ENABLED)
                return
        self._fault("hold_timeout", f"the drives did not go over to hold in {PATIENCE} cycles")

    @property
    def _cycle_time(self) -> float:
        return self._checked.table.cycle

    def _send(self, purpose: Purpose, targets: tuple[int, ...]) -> CycleStatus | None:
        """One cycle: wait, ask the gate, send, let simulated drives work, receive, judge.

        None when the gate denied the targets.
        """
        lateness = self._clock.next_cycle()
        verdict = examine(self._limits, self._request(purpose, targets))
        if not verdict.allowed:
            self._fault("gate_denied", f"the safety gate denied a set-point: {verdict.reason}")
            return None
        status, errors = self._exchange(targets, lateness)
        self._judge(status, errors, lateness)
        return status

    def _exchange(self, targets: tuple[int, ...], lateness: float) -> tuple[CycleStatus, Array]:
        """Sends what the gate allowed, receives and records."""
        self._group.send_cycle(targets)
        self._targets = targets
        status = self._group.receive(self._clock.time_left())
        self._actual = tuple(int(p) for p in status.positions)
        errors = self._following_errors(status)
        self._record(status, errors, lateness)
        return status, errors

    def _following_errors(self, status: CycleStatus) -> Array:
        """Signed, in cable length, shape (m,), [m]; NaN while drives do not follow or answer."""
        if status.state is not GroupState.ENABLED:
            return np.full(len(self._per_metre), np.nan)
        errors: Array = (status.positions - status.demands) / self._per_metre
        return np.where(status.missing, np.nan, errors)

    def _request(self, purpose: Purpose, targets: tuple[int, ...]) -> Request:
        return Request(
            purpose=purpose,
            targets=targets,
            previous=self._targets,
            actual=self._actual,
            armed=self._armed,
            enabled=self._group.state is GroupState.ENABLED,
            latched=self.machine.state is State.LATCHED,
        )

    def _record(self, status: CycleStatus, errors: Array, lateness: float) -> None:
        record = CycleRecord(
            cycle=self._cycle,
            state=self.machine.state,
            index=self._feed.index,
            targets=self._targets or (),
            actual=self._actual,
            torques=tuple(int(t) for t in status.torques),
            missing=int(np.count_nonzero(status.missing)),
            following_error=_largest(errors),
            lateness=lateness,
        )
        self._cycle += 1
        self._told_outside(lambda: self._on_cycle(record))

    def _told_outside(self, tell: Callable[[], None]) -> None:
        """A listener that fails does not break the loop; it leads to a stop along the path."""
        try:
            tell()
        except Exception as error:
            self._listener_error = self._listener_error or f"what records the run failed: {error}"

    def _judge(self, status: CycleStatus, errors: Array, lateness: float) -> None:
        """Lets the watch look at the cycle and reacts; then looks for the operator's stop."""
        seen = Observation(
            following=status.state is GroupState.ENABLED,
            following_errors=errors.tolist(),
            tensions=(np.asarray(status.torques) / 1000.0 * self._rated).tolist(),
            missing=[bool(m) for m in status.missing],
            faults=[f"node {node}: {text}" for node, text in status.faults],
            # At rest nothing is late any more.
            lateness=0.0 if self.machine.state is State.SECURING else lateness,
        )
        self._watch, findings = self._watch.look(seen)
        if self._listener_error:
            findings = (*findings, Finding(Reaction.PATH_STOP, "recorder", self._listener_error))
        for finding in findings:
            self._tell_once(finding)
        if findings and self.machine.state is not State.LATCHED:
            self._react(max(findings, key=lambda finding: finding.reaction))
        if self.machine.state in _STOPPABLE and self._stop_requested():
            self._tell_cause("stop", "stop requested; slowing down along the path")
            self._feed.stop()
            self.machine.on(Event.STOP)

    def _tell_once(self, finding: Finding) -> None:
        """What is wrong in every cycle is told in the first."""
        if (finding.code, finding.drive) not in self._told:
            self._told.add((finding.code, finding.drive))
            self._tell(finding.code, finding.text)

    def _react(self, finding: Finding) -> None:
        if finding.reaction is Reaction.PATH_STOP and self.machine.state in _WITHOUT_QUICK_STOP:
            self.cause = self.cause or f"{finding.text}; stopped along the path"
            self._feed.stop()
            self.machine.on(Event.PATH_FAULT)
        elif finding.reaction is not Reaction.NOTE:
            self._fault(finding.code, finding.text)

    def _fault(self, code: str, text: str) -> None:
        """Quick stop for all drives at once, latched."""
        self.machine.on(Event.FAULT)
        self._stop_drives()
        self._tell_cause(code, f"{text}; quick stop of all drives, fault latched")
        self._drain()

    def _stop_drives(self) -> None:
        """Sends the stop; on a dead bus the drives stop by themselves, as nothing reaches them."""
        try:
            self._group.quick_stop_now()
        except Exception as error:
            self._tell("stop_not_sent", f"{error}; the drives stop when they miss the master")

    def _drain(self) -> None:
        """A few more cycles, so that what the drives do during a quick stop is on record."""
        try:
            for _ in range(SETTLING):
                lateness = self._clock.next_cycle()
                targets = self._targets or self._actual
                if examine(self._limits, self._request(Purpose.HOLD, targets)).allowed:
                    self._exchange(targets, lateness)
        except Exception as error:  # the drives have been told to stop; nothing more is owed
            self._tell("bus_lost", f"{error}; the drives stop when they miss the master")

    def _tell_cause(self, code: str, text: str) -> None:
        """Tells why the run does not finish; the first cause is kept."""
        self.cause = self.cause or text
        self._tell(code, text)

    def _tell(self, code: str, text: str) -> None:
        event = LoopEvent(self._cycle, code, text)
        self._told_outside(lambda: self._on_event(event))


_ACTIVE = frozenset(
    {State.ENABLING, State.APPROACHING, State.MOVING, State.STOPPING, State.SECURING}
)
#: Where the drives move along the path together, or are at rest already.
_WITHOUT_QUICK_STOP = frozenset({State.MOVING, State.STOPPING, State.SECURING})
_STOPPABLE = frozenset({State.ENABLING, State.APPROACHING, State.MOVING})


def _largest(errors: Array) -> float:
    """Of those that are known; NaN when none is."""
    known = np.abs(errors[np.isfinite(errors)])
    return float(known.max()) if known.size else float("nan")


_HELD = "at rest; the drives hold by themselves under torque"
_NEVER_ENABLED = "stopped before all drives were enabled; none of them follows set-points"


def _nothing(*_: object) -> None:
    """Does nothing."""


def _smooth(share: float) -> float:
    """0 to 1 with zero speed and acceleration at both ends."""
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
