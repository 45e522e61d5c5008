"""The control loop: each cycle sends set-points, takes replies and makes one decision.

It runs through the states ready → enabling → approaching → moving (⇄ holding) → (stopping) →
securing → end. It always ends with the drives holding on their own (quick stop active,
torque on), and with any fault latched.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable

import numpy as np

from drivers.can_errors import BusFault
from drivers.drive_group import CycleStatus, GroupCommand, GroupState
from drivers.factory import holding_nodes, may_have_released
from executor.control.cycle import SETTLING, Cycle, CycleResult, Feed, targets_at
from executor.control.preconditions import require_at_start, require_capabilities, require_checked
from executor.control.sync_master import SyncMaster, changed_states, hold_timeout_text, lost_states
from executor.safety.fault_messages import Alarm, AlarmHistory, StopReaction, shared_causes
from executor.safety.gate import Purpose
from executor.state_machine import ON_PATH, CycleRecord, Event, LoopEvent, Machine, State
from executor.supervision import (
    OperatorRequests,
    StopReason,
    SupervisorCalls,
    in_one_line,
    record_failure,
)
from executor.trajectory.setpoints import CheckedSetpoints
from model.errors import CdprError, Refused

#: Failures of the bus in a row after which it is given up while drives stop.
GONE = 10


class Loop:
    """One run of checked set-points on one drive group.

    A subclass is another motion. It may override `_follow`, `_index` and the class attributes, and
    replace `_feed`. It uses `_rig`, `_checked`, `_send`, `_handle_alarms`, `_report`, `_press`, and
    `_sender` for the targets at rest, their index and the range that the gate allows. It reports
    AT_REST to `machine`; no other event. `_send` and `_handle_alarms` return after a quick stop
    only once the drives were stopped and drained, in LATCHED. A fault that stops along the path
    changes MOVING and HOLDING to STOPPING, and leaves STOPPING and SECURING as they are.
    """

    motion_phrase = "along the path"
    """How the drives move and stop, in messages."""
    slack_counts = True
    """A slack cable is a fault."""
    takes_feed_requests = True
    """The operator may request a feed hold and a speed, not only a stop."""

    def __init__(
        self, checked: CheckedSetpoints, master: SyncMaster, calls: SupervisorCalls
    ) -> None:
        """Prepares a run; nothing is sent yet.

        Args:
            checked: The checked set-points, with the rig they are for.
            master: Sends the cycles of configured drives.
        """
        self.machine = Machine()
        self._checked, self._rig, self._master = checked, checked.rig, master
        self._group, self._clock = master.group, master.clock
        self._calls = calls
        self._sender = Cycle(checked, master, slack_counts=self.slack_counts)
        self._feed = Feed(len(checked), checked.cycle, checked.rig.motion)
        self._cycle = self._bus_faults = 0
        self._taken_over, self._held_before = False, set[int]()  # nodes
        self._press = 0  # of jogs: the one whose line is followed
        self._history = AlarmHistory()
        self._path_stop = f"stopped {self.motion_phrase}"
        self._held = _HELD if self._group.capabilities.holds_on_quick_stop else _BRAKED
        self.cause = self._requested = self._listener_error = ""
        self.error: CdprError | None = None
        """None here: the end of a run is reported by its cause."""
        self.holding = True
        """Every cable was held at the drives' last reply."""

    def arm(self, require: Callable[[CycleStatus], None] = lambda _seen: None) -> None:
        """Checks the drives' capabilities, the set-points, and that the platform is at their start.

        From here on cycles must continue (`SyncMaster.cycle_until`) until `run` is called.

        Args:
            require: Further check of the drives' state; raises on failure.

        Raises:
            Refused: A check failed; nothing was enabled.
            HardwareMissing: A drive does not answer.
        """
        require_capabilities(self._group.capabilities, self._checked.cycle)
        require_checked(self._checked)
        seen = self._master.read_positions()
        self._master.require_no_fault()
        require(seen)
        self._held_before = holding_nodes(self._rig, seen)
        self._require_at_start()
        self._sender.armed = True

    def _require_at_start(self) -> None:
        """Takes the positions that the drives last reported, which must be at the start."""
        if self._master.status is not None:
            self._sender.actual = tuple(int(p) for p in self._master.status.positions)
        require_at_start(self._checked, np.array(self.positions, dtype=np.float64))

    @property
    def positions(self) -> tuple[int, ...]:
        """Last reported positions of the drives, from arming on, [counts]."""
        return self._sender.actual

    def run(self) -> State:
        """Runs to the end; returns the final state, and `cause` why it is not FINISHED.

        Raises:
            Refused: It was not armed.
        """
        if not self._sender.armed:
            raise Refused("the run was not armed", where="executor")
        try:
            self._require_at_start()
            self._master.refresh()
            self._master.require_no_fault()
            self.machine.on(Event.ENABLE)
            while self.machine.state in _ACTIVE:
                self._one_step()
        except CdprError as error:
            self._fault(error.code, error.what)
        except Exception as error:
            self._fault("broken", f"the control loop failed: {type(error).__name__}: {error}")
            self._report("traceback", traceback.format_exc())
        except BaseException:
            self._fault("broken", "the program was terminated")
            raise
        if lost := self._sender.largest_share_lost:
            self._report("reply_lost", lost)
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
        """Enables all drives together at their actual positions; the group has a time-out."""
        self._group.command(GroupCommand.ENABLE)
        while self.machine.state is State.ENABLING:
            status = self._send(Purpose.HOLD, self._sender.resting_targets)
            enabled = status is not None and status.state is GroupState.ENABLED
            if enabled and self.machine.state is State.ENABLING:
                self._take_over()

    def _take_over(self) -> None:
        verdict = self._sender.take_over()
        if not verdict.allowed:
            self._fault("gate_denied", f"the drives hold at other positions: {verdict.reason}")
            return
        self._taken_over = True
        self.machine.on(Event.ENABLED)
        self._report("enabled", "all drives are enabled and hold")

    def _approach(self) -> None:
        """Moves smoothly to the first row, by at most the start tolerance."""
        for targets in self._sender.approach(self._checked.setpoints[0].astype(np.float64)):
            self._send(Purpose.MOVE, targets)
            if self.machine.state is not State.APPROACHING:
                return
        self.machine.on(Event.AT_START)
        self._report("moving", f"at the start; moving {self.motion_phrase}")
        self._apply_requests(self._calls.requests())

    def _follow(self) -> None:
        """One cycle along the table, or at rest in it."""
        if not self._feed.at_rest:
            index = self._feed.advance()
            self._send(Purpose.MOVE, targets_at(self._checked.setpoints, index), index)
        elif self.machine.state is State.HOLDING:
            self._send(Purpose.HOLD, self._sender.resting_targets)
        else:
            self.machine.on(Event.AT_REST)

    def _secure(self) -> None:
        """Settles, then commands a quick stop and waits until the drives hold on their own."""
        was_enabled = self._group.state is GroupState.ENABLED
        # Until taken over, drives hold targets of their own: no set-point may move them.
        for _ in range(SETTLING if was_enabled and self._taken_over else 0):
            self._send(Purpose.HOLD, self._sender.resting_targets)
            if self.machine.state is not State.SECURING:
                return
        self._group.command(GroupCommand.QUICK_STOP)
        within = self._master.hold_timeout
        for _ in range(round(within / self._checked.cycle)):
            status = self._send(Purpose.HOLD, self._sender.resting_targets)
            if self.machine.state is not State.SECURING:
                return
            # One reply may be missing; `MISSING_CYCLES` in a row are a fault.
            if status is not None and status.stopped and (status.holding or not was_enabled):
                self._leave(status)
                return
        text = hold_timeout_text(self._rig, status, within, was_enabled=was_enabled)
        self._fault("hold_timeout", text)

    def _leave(self, held: CycleStatus) -> None:
        """Ends monitoring of drives that hold on their own, and reads their state again."""
        left = self._master.leave(self._one_more_at_rest)
        if self.machine.state is not State.SECURING:
            return
        if not left.all_stopped or (held.holding and not left.holding):
            self._note_end(left)
            self._fault("not_held", changed_states(self._rig, held, left))
            return
        self.machine.on(Event.HELD)
        self._report("held", self._held if left.holding else _NEVER_ENABLED)

    def _one_more_at_rest(self) -> bool:
        """Sends one cycle at rest; returns whether it was free of faults."""
        self._send(Purpose.HOLD, self._sender.resting_targets)
        return self.machine.state is State.SECURING

    def _send(
        self, purpose: Purpose, targets: tuple[int, ...], index: float | None = None
    ) -> CycleStatus | None:
        """Sends one cycle and reacts to its result; None when the gate denied the targets."""
        at_rest = self.machine.state in (State.ENABLING, State.SECURING)
        done = self._sender.cycle(purpose, targets, at_rest=at_rest, index=index)
        if not done.verdict.allowed:
            self._fault("gate_denied", f"the safety gate denied a set-point: {done.verdict.reason}")
            return None
        self._record(done)
        self._handle_alarms(done.alarms)
        # A fault stops the drives at once; operator requests count up to the next cycle.
        self._clock.wait_to_decide()
        requests = self._calls.requests()
        if requests.lost:
            self._handle_alarms((Alarm(StopReaction.PATH_STOP, "supervisor_lost", requests.lost),))
        self._apply_requests(requests)
        return done.status

    def _record(self, done: CycleResult) -> None:
        if done.status is None:
            return
        self.holding = self._is_held(done.status)
        record = CycleRecord(
            cycle=self._cycle,
            at=self._clock.time,
            state=self.machine.state,
            index=self._index(),
            rate=self._feed.rate if self.machine.state in ON_PATH else 0.0,
            targets=self._sender.resting_targets,
            actual=self._sender.actual,
            torques=tuple(int(t) for t in done.status.torques),
            words=tuple(int(w) for w in done.status.status_words),
            missing=int(np.count_nonzero(done.status.missing)),
            rejected=done.status.rejected,
            error_frames=done.status.error_frames,
            following_error=done.following_error,
            lateness=done.lateness,
            tension_known=done.tension_known,
            press=self._press,
        )
        self._cycle += 1
        self._call_listener(lambda: self._calls.on_cycle(record))

    def _is_held(self, status: CycleStatus) -> bool:
        """Whether no drive has let go of a cable that it held, before or in this motion."""
        holding = holding_nodes(self._rig, status)
        self._held_before |= holding
        return holding == self._held_before

    def _note_end(self, left: CycleStatus | None) -> None:
        """Notes whether every cable is still held; None where no drive could be read."""
        silent = [True] * self._rig.cable_count if left is None else left.missing.tolist()
        held = self.holding if left is None else self._is_held(left)
        self.holding = held and self._held_before.isdisjoint(may_have_released(self._rig, silent))

    def _index(self) -> float:
        """Progress of the motion, for the record: only what was sent to the drives."""
        return self._sender.index

    def _call_listener(self, call: Callable[[], None]) -> None:
        """A failing listener does not break the loop; it causes a path stop."""
        try:
            call()
        except Exception as error:
            self._listener_error = self._listener_error or record_failure(error)

    def _handle_alarms(self, alarms: tuple[Alarm, ...]) -> None:
        """Reacts to alarms, and to a record that cannot be kept."""
        if self._listener_error:
            alarms = (*alarms, Alarm(StopReaction.PATH_STOP, "recorder", self._listener_error))
        alarms = shared_causes(alarms, list(self._rig.drive_names.values()))
        latched = self.machine.state is State.LATCHED
        worst = None if latched else max(alarms, key=lambda alarm: alarm.reaction, default=None)
        for alarm in alarms:
            if alarm is not worst or not self._needs_quick_stop(alarm):  # which reports its cause
                self._report_once(alarm)
        if worst is not None:
            self._react(worst)

    def _apply_requests(self, requests: OperatorRequests) -> None:
        """Applies the operator's requests as far as the state allows."""
        state = self.machine.state
        if requests.stop and state in _STOPPABLE:
            why = requests.for_what or StopReason("stop", "stop requested")
            self._requested = f"{why.text}; {self._slow_down()}"
            self._report_cause(why.code, self._requested)
            self.machine.on(Event.STOP)
            return
        if not self.takes_feed_requests:
            return
        speed = f"{requests.speed:.0%} of the planned speed"
        if requests.hold and state is State.MOVING:
            self._report("hold", f"feed hold; {self._slow_down()}")
            self.machine.on(Event.HOLD)
        elif state is State.HOLDING and not requests.hold:
            self._feed.go_to(requests.speed)
            self.machine.on(Event.RESUME)
            self._report("resume", f"continuing {self.motion_phrase} at {speed}")
        elif state is State.MOVING and self._feed.wanted != requests.speed:
            self._feed.go_to(requests.speed)
            self._report("speed", f"speed {self.motion_phrase}: {speed}")

    def _slow_down(self) -> str:
        """Stops the feed; returns what follows."""
        self._feed.stop()
        if self.machine.state not in ON_PATH:
            return "stopping at once"
        return "at rest" if self._feed.at_rest else f"slowing down {self.motion_phrase}"

    def _report_once(self, alarm: Alarm) -> None:
        """Reports an alarm if it is a new one; see `AlarmHistory`."""
        if text := self._history.new_text(alarm, self._cycle):
            self._report(alarm.code, text)

    def _react(self, alarm: Alarm) -> None:
        if self._needs_quick_stop(alarm):
            self._history.new_text(alarm, self._cycle)  # not again while the drives stop
            self._fault(alarm.code, alarm.text)
        elif alarm.reaction is StopReaction.PATH_STOP:
            self._feed.stop()
            at_rest = self.machine.state is State.SECURING or self._feed.at_rest
            self._note_cause(f"{alarm.text}; {'at rest' if at_rest else self._path_stop}")
            self._sender.faulted = True
            self.machine.on(Event.PATH_FAULT)

    def _needs_quick_stop(self, alarm: Alarm) -> bool:
        """Whether no stop along the path is possible or enough."""
        if alarm.reaction is StopReaction.PATH_STOP:
            return self.machine.state not in _WITHOUT_QUICK_STOP
        return alarm.reaction is not StopReaction.NOTE

    def _fault(self, code: str, text: str) -> None:
        """Quick stop for all drives at once, latched; the cause keeps a path fault before it."""
        text = f"{text}; quick stop of all drives"
        if self.machine.state is not State.LATCHED and self.cause not in ("", self._requested):
            unfinished = f"; {self._path_stop}" if self.machine.state in ON_PATH else ""
            self.cause = f"{self.cause.removesuffix(unfinished)}; then {text}"
        self.machine.on(Event.FAULT)
        self._sender.latched = True
        self._stop_drives()
        self._report_cause(code, text)
        self._drain()

    def _stop_drives(self) -> None:
        """Sends the stop; on a dead bus the drives stop on their own, as nothing reaches them."""
        try:
            self._master.stop_now()
        except Exception as error:
            text = f"{in_one_line(error)}; the drives stop on loss of the master"
            self._report("stop_not_sent", text)

    def _drain(self) -> None:
        """Continues cycles for drives still stopping and for the record, then ends."""
        try:
            for cycle in range(round(self._master.hold_timeout / self._checked.cycle)):
                if cycle >= SETTLING and not self._group.stopping:
                    break
                if not self._one_more_latched():
                    return
            before = self._master.status
            left = self._master.leave(self._one_more_latched)
        except Exception as error:  # the drives have been commanded to stop; nothing more is needed
            text = f"{in_one_line(error)}; the drives stop on loss of the master"
            self._report("bus_lost", text)
            self._note_end(None)
            return
        # An ODrive is missing as well without a valid position, although its brake holds.
        is_known = self._held == _BRAKED or not left.missing.any()
        if before is None or (left.holding and left.stopped and is_known):
            return
        self._note_end(left)
        if lost := lost_states(self._rig, before, left, self._held_before, self.cause):
            self._report("not_held", lost)
            self.cause += "" if lost in self.cause else f"; {lost}"

    def _one_more_latched(self) -> bool:
        """Sends a cycle after a fault; false when the gate denies it, as it then always will.

        A bus that disturbs single cycles still carries SYNC, whose end some drives take for a loss
        of the master and let go: it is given up only after `GONE` failures in a row.
        """
        targets = self._sender.resting_targets
        try:
            done = self._sender.cycle(Purpose.HOLD, targets, at_rest=True)
        except BusFault:
            self._bus_faults += 1
            if self._bus_faults >= GONE:
                raise
            return True
        self._bus_faults = 0
        if done.verdict.allowed:
            self._record(done)
            for alarm in done.alarms:  # drive faults may arrive after the cause of the stop
                if alarm.code == "drive_fault" and alarm.text not in self.cause:
                    self._report_once(alarm)
        return done.verdict.allowed

    def _report_cause(self, code: str, text: str) -> None:
        """Reports why the run does not finish."""
        self._note_cause(text)
        self._report(code, text)

    def _note_cause(self, text: str) -> None:
        """Keeps the first cause, except that a fault outweighs a requested stop before it."""
        if self.cause in ("", self._requested):
            self.cause = text

    def _report(self, code: str, text: str) -> None:
        event = LoopEvent(self._cycle, self._clock.time, code, text)
        self._call_listener(lambda: self._calls.on_event(event))


_ACTIVE = ON_PATH | {State.ENABLING, State.APPROACHING, State.SECURING}
#: States in which the drives move along the path together, or are already at rest.
_WITHOUT_QUICK_STOP = ON_PATH | {State.SECURING}
_STOPPABLE = frozenset({State.ENABLING, State.APPROACHING, State.MOVING, State.HOLDING})

_HELD = "at rest; the drives hold under torque"
_BRAKED = "at rest; the brakes of the winches hold"
_NEVER_ENABLED = "stopped before all drives were enabled; none follows set-points"
