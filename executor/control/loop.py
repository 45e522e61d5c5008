"""The cyclic loop: every cycle one set of set-points out, one set of replies in, one decision.

It owns the order of things: ready → enabling → approaching → moving (⇄ holding) → (stopping) →
securing → end. Whatever happens, it ends with the drives holding by themselves (quick stop active,
torque on), and with the fault latched if there was one.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence

import numpy as np

from drivers.drive_group import CycleStatus, GroupCommand, GroupState
from drivers.factory import stop_alone
from executor.control.cycle import Cycle, CycleResult, Feed, targets_at
from executor.control.preconditions import require_at_start, require_capabilities, require_unchanged
from executor.control.sync_master import SyncMaster, left_otherwise
from executor.safety.gate import Purpose
from executor.safety.monitor import Alarm, StopReaction
from executor.state_machine import (
    ON_PATH,
    CycleRecord,
    Event,
    LoopEvent,
    Machine,
    State,
    shared_causes,
)
from executor.supervision import OperatorRequests
from executor.trajectory.setpoints import CheckedSetpoints
from executor.trajectory.time_scaling import smooth_step
from model.errors import CdprError, Refused

#: Within which all drives must hold after the command to, [s].
HOLD_TIMEOUT = 3.0
#: Cycles of holding still before and after the motion.
SETTLING = 10


class Loop:
    """One run of one checked course on one drive group."""

    way = "along the path"
    """How the drives move and stop, in messages."""
    slack_counts = True
    """A cable that hangs slack is a fault."""

    def __init__(
        self,
        course: CheckedSetpoints,
        master: SyncMaster,
        *,
        wishes: Callable[[], OperatorRequests],
        on_cycle: Callable[[CycleRecord], None],
        on_event: Callable[[LoopEvent], None],
    ) -> None:
        """Prepares a run; nothing is sent yet.

        Args:
            course: The checked set-points, with the rig they are for.
            master: Keeps the cycle of configured drives.
            wishes: Asked every cycle.
            on_cycle: Called after every cycle; it must not take long.
            on_event: Called for every event.
        """
        self.machine = Machine()
        self._course, self._master = course, master
        self._group, self._clock = master.group, master.clock
        self._wishes, self._on_cycle, self._on_event = wishes, on_cycle, on_event
        self._exchange = Cycle(course, master, slack_counts=self.slack_counts)
        self._feed = Feed(len(course), course.cycle, course.rig.motion)
        self._cycle = 0
        self._taken_over = False
        self._told: set[tuple[str, str]] = set()
        self._listener_error = ""
        self._held = _HELD if self._group.capabilities.holds_on_quick_stop else _BRAKED
        self.cause = ""
        self.error: CdprError | None = None
        """None: the end of a run is reported by its cause."""
        self.holding = True
        """Every cable was held when the drives were last heard."""

    def arm(self, require: Callable[[Sequence[int]], None] = lambda _positions: None) -> None:
        """Confirms the drives' abilities, the set-points, and that the platform is at their start.

        From here on the cycle must be kept (`SyncMaster.keep_until`) until `run` is called.

        Args:
            require: What else must hold of the drives' positions [counts]; it raises if it does
                not.

        Raises:
            Refused: One of it is not so; nothing was enabled.
            HardwareMissing: A drive does not answer.
        """
        require_capabilities(self._group.capabilities, self._course.cycle)
        require_unchanged(self._course)
        self._master.read_positions()
        self._take_positions()
        require(self.stands_at)
        self._require_at_start()
        self._exchange.armed = True

    def _take_positions(self) -> None:
        """As the drives reported them last."""
        if self._master.status is not None:
            self._exchange.actual = tuple(int(p) for p in self._master.status.positions)

    def _require_at_start(self) -> None:
        require_at_start(self._course, np.array(self.stands_at, dtype=np.float64))

    @property
    def stands_at(self) -> tuple[int, ...]:
        """Where the drives stood when they were last heard, from arming on, [counts]."""
        return self._exchange.actual

    def run(self) -> State:
        """Runs to the end; returns the last state, and `cause` says why it is not FINISHED.

        Raises:
            Refused: It was not armed.
        """
        if not self._exchange.armed:
            raise Refused("the run was not armed", where="executor")
        try:
            self._take_positions()
            self._require_at_start()
            self._master.freshen()
            self.machine.on(Event.ENABLE)
            while self.machine.state in _ACTIVE:
                self._one_step()
        except CdprError as error:
            self._fault(error.code, error.what)
        except Exception as error:
            self._fault("broken", f"the control loop failed: {type(error).__name__}: {error}")
            self._tell("traceback", traceback.format_exc())
        except BaseException:
            self._fault("broken", "the program was terminated")
            raise
        return self.machine.state

    def _one_step(self) -> None:
        match self.machine.state:
            case State.ENABLING:
                self._enable()
            case State.APPROACHING:
                self._approach()
            case State.MOVING | State.HOLDING | State.STOPPING:
                self._follow()
            case _:
                self._secure()

    def _enable(self) -> None:
        """All drives together, on their actual positions; the group gives up by itself in time."""
        self._group.command(GroupCommand.ENABLE)
        while self.machine.state is State.ENABLING:
            status = self._send(Purpose.HOLD, self._exchange.resting_targets)
            enabled = status is not None and status.state is GroupState.ENABLED
            if enabled and self.machine.state is State.ENABLING:
                self._take_over()

    def _take_over(self) -> None:
        verdict = self._exchange.take_over()
        if not verdict.allowed:
            self._fault("gate_denied", f"the drives hold at other positions: {verdict.reason}")
            return
        self._taken_over = True
        self.machine.on(Event.ENABLED)
        self._tell("enabled", "all drives are enabled and hold")

    def _approach(self) -> None:
        """From where the drives stand to the first row, smoothly; at most the start tolerance."""
        begin = np.array(self._exchange.targets, dtype=np.float64)
        end = self._course.setpoints[0].astype(np.float64)
        way, speed = self._exchange.largest_way(begin, end), self._course.rig.motion.speed
        steps = SETTLING + int(np.ceil(4.0 * way / (speed * self._course.cycle)))
        for step in range(1, steps + 1):
            share = smooth_step(step / steps)
            targets = tuple(int(v) for v in np.rint(begin + share * (end - begin)))
            self._send(Purpose.MOVE, targets)
            if self.machine.state is not State.APPROACHING:
                return
        self.machine.on(Event.AT_START)
        self._tell("moving", f"at the start; moving {self.way}")

    def _follow(self) -> None:
        """One cycle along the table, or on one place of it."""
        if not self._feed.at_rest:
            place = targets_at(self._course.setpoints, self._feed.advance())
            self._send(Purpose.MOVE, place)
        elif self.machine.state is State.HOLDING:
            self._send(Purpose.HOLD, self._exchange.resting_targets)
        else:
            self.machine.on(Event.AT_REST)

    def _secure(self) -> None:
        """Settles, then lets the drives hold by themselves, and waits until they say so."""
        was_enabled = self._group.state is GroupState.ENABLED
        # Before they were taken over, drives hold targets of their own: no set-point may move them.
        for _ in range(SETTLING if was_enabled and self._taken_over else 0):
            self._send(Purpose.HOLD, self._exchange.resting_targets)
            if self.machine.state is not State.SECURING:
                return
        self._group.command(GroupCommand.QUICK_STOP)
        for _ in range(round(HOLD_TIMEOUT / self._course.cycle)):
            status = self._send(Purpose.HOLD, self._exchange.resting_targets)
            if self.machine.state is not State.SECURING:
                return
            if status is not None and status.stopped and (status.holding or not was_enabled):
                self._leave(status)
                return
        self._fault("hold_timeout", f"the drives did not hold within {HOLD_TIMEOUT:g} s")

    def _leave(self, held: CycleStatus) -> None:
        """Leaves drives alone that hold by themselves, and asks them once more afterwards."""
        left = self._master.leave(self._one_more_at_rest)
        if self.machine.state is not State.SECURING:
            return
        if left.missing.any() or not left.stopped or (held.holding and not left.holding):
            self.holding = left.holding
            self._fault("not_held", left_otherwise(self._course.rig, held, left))
            return
        self.machine.on(Event.HELD)
        self._tell("held", self._held if left.holding else _NEVER_ENABLED)

    def _one_more_at_rest(self) -> bool:
        """A cycle at rest; false when something was wrong in it."""
        self._send(Purpose.HOLD, self._exchange.resting_targets)
        return self.machine.state is State.SECURING

    def _send(self, purpose: Purpose, targets: tuple[int, ...]) -> CycleStatus | None:
        """One cycle and what follows from it; None when the gate denied the targets."""
        at_rest = self.machine.state in (State.ENABLING, State.SECURING)
        done = self._exchange.cycle(purpose, targets, at_rest=at_rest)
        if not done.verdict.allowed:
            self._fault("gate_denied", f"the safety gate denied a set-point: {done.verdict.reason}")
            return None
        self._record(done)
        self._judge(done.findings)
        # A fault stops the drives at once; what the operator wants counts up to the next cycle.
        self._clock.wait_to_decide()
        wishes = self._wishes()
        if wishes.lost:
            self._judge((Alarm(StopReaction.PATH_STOP, "supervisor_lost", wishes.lost),))
        self._obey(wishes)
        return done.status

    def _record(self, done: CycleResult) -> None:
        if done.status is None:
            return
        self.holding = done.status.holding or not self._taken_over
        record = CycleRecord(
            cycle=self._cycle,
            at=self._clock.time,
            state=self.machine.state,
            index=self._place(),
            rate=self._feed.rate if self.machine.state in ON_PATH else 0.0,
            targets=self._exchange.resting_targets,
            actual=self._exchange.actual,
            torques=tuple(int(t) for t in done.status.torques),
            words=tuple(int(w) for w in done.status.status_words),
            missing=int(np.count_nonzero(done.status.missing)),
            rejected=done.status.rejected,
            error_frames=done.status.error_frames,
            following_error=done.following_error,
            lateness=done.lateness,
        )
        self._cycle += 1
        self._told_outside(lambda: self._on_cycle(record))

    def _place(self) -> float:
        """Where in the motion this is, for the record."""
        return self._feed.index

    def _told_outside(self, tell: Callable[[], None]) -> None:
        """A listener that fails does not break the loop; it leads to a stop along the path."""
        try:
            tell()
        except Exception as error:
            self._listener_error = (
                self._listener_error or f"recording failed: {_in_one_line(error)}"
            )

    def _judge(self, findings: tuple[Alarm, ...]) -> None:
        """Reacts to what the watch saw, and to the loss of the record."""
        if self._listener_error:
            lost = Alarm(StopReaction.PATH_STOP, "recorder", self._listener_error)
            findings = (*findings, lost)
        findings = shared_causes(findings, list(self._course.rig.drive_names.values()))
        for finding in findings:
            self._tell_once(finding)
        if findings and self.machine.state is not State.LATCHED:
            self._react(max(findings, key=lambda finding: finding.reaction))

    def _obey(self, wishes: OperatorRequests) -> None:
        """Does what the operator wants, as far as the state allows it."""
        state = self.machine.state
        if self._obey_stop(wishes):
            return
        if wishes.hold and state is State.MOVING:
            self._feed.stop()
            self.machine.on(Event.HOLD)
            self._tell("hold", f"feed hold; slowing down {self.way}")
        elif state is State.HOLDING and not wishes.hold:
            self._feed.go_to(wishes.speed)
            self.machine.on(Event.RESUME)
            self._tell(
                "resume", f"continuing {self.way} at {wishes.speed:.0%} of the planned speed"
            )
        elif state is State.MOVING and self._feed.wanted != wishes.speed:
            self._feed.go_to(wishes.speed)
            self._tell("speed", f"speed {self.way}: {wishes.speed:.0%} of the planned speed")

    def _obey_stop(self, wishes: OperatorRequests) -> bool:
        """Stops along the path where that is wished and possible."""
        if not (wishes.stop and self.machine.state in _STOPPABLE):
            return False
        if wishes.for_what is not None:
            text = f"{wishes.for_what.text}; slowing down {self.way}"
            self._tell_cause(wishes.for_what.code, text)
        else:
            self._tell_cause("stop", f"stop requested; slowing down {self.way}")
        self._feed.stop()
        self.machine.on(Event.STOP)
        return True

    def _tell_once(self, finding: Alarm) -> None:
        """A condition that persists is reported in its first cycle."""
        # A drive may report several faults, each once; what the watch measures changes its text.
        named = finding.code in ("drive_fault", "drive_warning")
        what = finding.text if named else str(finding.drive)
        if (finding.code, what) not in self._told:
            self._told.add((finding.code, what))
            self._tell(finding.code, finding.text)

    def _react(self, finding: Alarm) -> None:
        if finding.reaction is StopReaction.PATH_STOP and self.machine.state in _WITHOUT_QUICK_STOP:
            self.cause = self.cause or f"{finding.text}; stopped {self.way}"
            self._feed.stop()
            self.machine.on(Event.PATH_FAULT)
        elif finding.reaction is not StopReaction.NOTE:
            self._fault(finding.code, finding.text)

    def _fault(self, code: str, text: str) -> None:
        """Quick stop for all drives at once, latched."""
        self.machine.on(Event.FAULT)
        self._exchange.latched = True
        self._stop_drives()
        self._tell_cause(code, f"{text}; quick stop of all drives, fault latched")
        self._drain()

    def _stop_drives(self) -> None:
        """Sends the stop; on a dead bus the drives stop by themselves, as nothing reaches them."""
        try:
            self._master.stop_now()
        except Exception as error:
            text = f"{_in_one_line(error)}; the drives stop on loss of the master"
            self._tell("stop_not_sent", text)

    def _drain(self) -> None:
        """More cycles, for drives whose stop needs them and for the record; then the end."""
        try:
            for cycle in range(round(HOLD_TIMEOUT / self._course.cycle)):
                if cycle >= SETTLING and not self._group.stopping:
                    break
                if not self._one_more_latched():
                    return
            before = self._master.status
            left = self._master.leave(self._one_more_latched)
        except Exception as error:  # the drives have been commanded to stop; nothing more is needed
            text = f"{_in_one_line(error)}; the drives stop on loss of the master"
            self._tell("bus_lost", text)
            return
        if before is None or left.holding:
            return
        self.holding = not self._taken_over
        rig = self._course.rig
        held = np.array(stop_alone(rig, before.status_words.tolist())) & ~before.missing
        if otherwise := left_otherwise(rig, before, left, np.flatnonzero(~held).tolist()):
            self._tell("not_held", otherwise)

    def _one_more_latched(self) -> bool:
        """A cycle after a fault; false when the gate denies it, as it will every later one."""
        targets = self._exchange.resting_targets
        done = self._exchange.cycle(Purpose.HOLD, targets, at_rest=True)
        if done.verdict.allowed:
            self._record(done)
            self._tell_reasons(done.findings)
        return done.verdict.allowed

    def _tell_reasons(self, findings: tuple[Alarm, ...]) -> None:
        """What a drive says of itself may come after what the stop was for."""
        for finding in findings:
            if finding.code == "drive_fault" and finding.text not in self.cause:
                self._tell_once(finding)

    def _tell_cause(self, code: str, text: str) -> None:
        """Reports why the run does not finish; the first cause is kept."""
        self.cause = self.cause or text
        self._tell(code, text)

    def _tell(self, code: str, text: str) -> None:
        event = LoopEvent(self._cycle, self._clock.time, code, text)
        self._told_outside(lambda: self._on_event(event))


def _in_one_line(error: Exception) -> str:
    """What went wrong, without cause and advice."""
    return error.what if isinstance(error, CdprError) else f"{type(error).__name__}: {error}"


_ACTIVE = ON_PATH | {State.ENABLING, State.APPROACHING, State.SECURING}
#: Where the drives move along the path together, or are at rest already.
_WITHOUT_QUICK_STOP = ON_PATH | {State.SECURING}
_STOPPABLE = frozenset({State.ENABLING, State.APPROACHING, State.MOVING, State.HOLDING})

_HELD = "at rest; the drives hold under torque"
_BRAKED = "at rest; the brakes of the winches hold"
_NEVER_ENABLED = "stopped before all drives were enabled; none follows set-points"
