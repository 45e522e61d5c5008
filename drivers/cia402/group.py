"""All CiA 402 drives of a rig as one group: one thread, one bus, one step per cycle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence, Set

import can
import numpy as np

from drivers.can_bus import SentFrame
from drivers.can_load import TESTED_HZ, heartbeat_cycles, heartbeat_timeout, requests_per_cycle
from drivers.cia402.configure import configure_drives
from drivers.cia402.monitor import DriveMonitor
from drivers.cia402.object_dictionary import peer_timeout_ms
from drivers.cia402.pdo import CyclicFrames, commanding_ids, foreign_master_message, is_command
from drivers.cia402.profile import power_bits, profile_of
from drivers.cia402.sdo_jobs import (
    ASKED_AGAIN_AFTER,
    ERROR_REQUESTS,
    MODE_WAIT,
    AnswerListener,
    ModeCheck,
    MonitoringEnd,
    SdoJobs,
    StatePoll,
    StateReading,
    answer_cycles,
    cycles_to_end,
    mode_text,
)
from drivers.cia402.state_machine import (
    HOLDS,
    STEP_CYCLES,
    WITHOUT_TORQUE,
    ControlWord,
    DriveState,
    Goal,
    SentWords,
    ignoring_drives,
    stopped_between_replies,
)
from drivers.cyclic_group import CyclicBus, CyclicGroup
from drivers.drive_group import (
    Capabilities,
    Counts,
    CycleStatus,
    DriveWarning,
    GroupCommand,
    GroupState,
    OnRestarted,
    Pace,
    Pump,
)
from drivers.plausibility import require_within_limits, winding_signs
from model.errors import HardwareMissing, Refused
from model.rig import Rig

#: Time within which a drive must leave the state FAULT after a reset, [s].
RESET_WITHIN = 1.0
#: Time in which every drive must answer SYNC: NMT START is not confirmed, [s].
FIRST_READING_WITHIN = 2.0
#: Consistent readings per drive before its position is accepted: one frame may be wrong.
FIRST_READINGS = 2
#: Time-out per attempt, [s]; a drive just started may miss the first SYNC.
FIRST_READING_TIMEOUT = 0.1


class Cia402Group(CyclicGroup):
    """CiA 402 drives in cyclic synchronous position mode; see `drivers.drive_group.DriveGroup`."""

    _watch: DriveMonitor

    def __init__(
        self, rig: Rig, bus: can.BusABC, pump: Pump | None = None, *, max_tension: float | None
    ) -> None:
        """Takes an open bus and sends nothing yet; arguments as for `make_drive_group`."""
        super().__init__(rig, bus, pump)
        self._signs = winding_signs(rig)
        cycle = rig.cycle
        self._cycle_s, self._profile = cycle, profile_of(rig)
        self._answer_cycles = answer_cycles(self._profile.sdo_timeout_ms / 1000.0, cycle)
        self._requests = requests_per_cycle(rig.cable_count, cycle, rig.document.bus.bitrate)
        self._heartbeat_cycles = heartbeat_cycles(cycle)
        self._enable_s = self._profile.enable_timeout_ms / 1000.0
        self._patience = STEP_CYCLES + math.ceil(self._enable_s / cycle - 1e-9)
        self._reset_cycles = round(RESET_WITHIN / cycle)
        self._again_after = max(1, round(ASKED_AGAIN_AFTER / cycle))
        self._max_tension = max_tension
        self._restarted: tuple[int, ...] = ()
        self._simulated, self._heartbeats = False, (1,) * rig.cable_count
        self._reset_memory()

    def _reset_memory(self) -> None:
        count = len(self._nodes)
        commanding = commanding_ids(self._nodes)
        self._cyclic = CyclicBus(self._bus, commanding, foreign_master_message, is_command)
        self._frames = CyclicFrames(self._nodes)
        names, is_warning = self._rig.drive_names, self._profile.is_warning
        missed = peer_timeout_ms(self._rig) / 1000.0 / self._cycle_s - 1.0  # a cycle may be late
        bits = power_bits(self._profile)
        self._watch = DriveMonitor(names, self._max_steps, is_warning, missed, bits)
        self._warnings: tuple[DriveWarning, ...] = ()
        self._goal = Goal.IDLE
        self._sent = SentWords(count)
        self._targets, self._demands = [0] * count, [0] * count
        self._faults = []
        self._cycle = self._cycles_to_goal = 0
        self._enables = False  # "enable operation" was sent for this goal
        self._former: tuple[Goal, bool] | None = None  # goal and that of words not replied to yet
        self._monitoring_off: MonitoringEnd | None = None
        self._modes: ModeCheck | None = None
        self._poll = StatePoll((), 1)
        self._errors = SdoJobs({}, 1)

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of CiA 402 drives after `configure`."""
        return Capabilities(
            sync=True,
            holds_on_comm_loss=True,
            holds_on_quick_stop=True,
            has_brake=all(winch.brake for winch in self._rig.winches),
            max_hz=TESTED_HZ,
            watchdog_ms=None,
            sync_timeout=self._profile.sync_timeout_periods,
            master_timeout=max(
                heartbeat_timeout(self._cycle_s), self._profile.sync_timeout_periods * self._cycle_s
            ),
            released_within=2.0 * self._patience * self._cycle_s + 1.0,
            unmonitored_within=self._cycle_s
            * cycles_to_end(self._heartbeats, self._requests, self._answer_cycles),
            simulated=self._simulated,
        )

    @property
    def restarted(self) -> tuple[int, ...]:
        """Nodes that `configure` found without this program's configuration."""
        return self._restarted

    @property
    def targets(self) -> Counts:
        """Last targets sent, shape (m,), [counts]."""
        return np.array(self._targets, dtype=np.int64)

    def configure(
        self, *, to_reset: bool = False, on_restarted: OnRestarted | None = None
    ) -> tuple[str, ...]:
        """Configures every drive and reads every setting back; see `DriveGroup.configure`."""
        self._refuse_enabled()
        self._state = GroupState.OFFLINE
        self._reset_memory()

        def take(restarted: tuple[int, ...]) -> None:
            self._restarted = restarted
            if on_restarted is not None:
                on_restarted(restarted)

        done = configure_drives(
            self._rig,
            self._bus,
            self._pump,
            max_tension=self._max_tension,
            to_reset=to_reset,
            on_restarted=take,
        )
        self._heartbeats, self._simulated = done.heartbeats, done.simulated
        for can_id, data in done.emergencies.items():  # they may explain a state
            self._watch.take(can_id, data)
        self._watch.note_errors(done.errors)
        self._state = GroupState.CONFIGURED
        return done.remarks

    def read_positions(self, pace: Pace | None = None) -> CycleStatus:
        """Sends SYNC until every drive has reported a position; see `DriveGroup.read_positions`."""
        self._watch.forget_positions()
        agreed = 0
        attempt = FIRST_READING_TIMEOUT if pace is None else self._cycle_s
        for _ in range(round(FIRST_READING_WITHIN / attempt)):
            time_left = FIRST_READING_TIMEOUT if pace is None else pace()
            self.send_cycle(self._watch.positions)
            status = self.receive(time_left)
            agreed = 0 if status.missing.any() else agreed + 1
            if agreed == FIRST_READINGS:
                return status
            if not agreed:
                self._watch.forget_positions()
        names = ", ".join(str(self._nodes[drive]) for drive in np.flatnonzero(status.missing))
        raise HardwareMissing(
            f"no position from drive{'s' if ',' in names else ''} {names}",
            where="reading the drives' positions",
            why="the drive lost power or the bus after it was configured",
            next_step="check power and wiring, then start again",
            values={"nodes": names},
        )

    def send_cycle(
        self, targets: Sequence[int], may_send: Callable[[bool], bool] = lambda _enables: True
    ) -> None:
        """Sends one cycle; see `DriveGroup.send_cycle`."""
        self._online()
        self._discard_stale()
        if self._goal is not Goal.RESET_FAULT:  # faults since the last cycle stop this one
            self._latch(self._new_messages())
        following = self._state is GroupState.ENABLED
        words = self._sent.next_words(self._goal, self._watch.states_to_command)
        if self._former is not None and self._goal in (Goal.ENABLE, Goal.RELEASE):
            # No further step until every drive has shown the effect of the last words.
            words = self._sent.words
        self._enables |= ControlWord.ENABLE_OPERATION in words
        self._demands = self._targets if self._cycle else list(self._watch.positions)
        if following:
            self._targets = [int(target) for target in targets]
        elif ControlWord.ENABLE_OPERATION not in self._sent.words:
            # Without power, or held by the drives themselves: the targets follow the positions.
            # Once enabling has begun they are fixed, so that they do not follow a sagging drive.
            self._targets = list(self._watch.positions)
        self._send(words, may_send)
        self._cycle += 1
        if self._cycle % self._heartbeat_cycles == 0:
            self._cyclic.send((self._frames.heartbeat,))
        for jobs in (self._modes, self._monitoring_off, self._errors):
            if jobs is not None:
                self._ask(jobs, self._requests)

    def command(self, command: GroupCommand) -> None:
        """Sets the goal of the group; see `DriveGroup.command`."""
        self._online()
        {
            GroupCommand.QUICK_STOP: self._stop,
            GroupCommand.ENABLE: self._begin_enabling,
            GroupCommand.RELEASE: self._begin_release,
            GroupCommand.END_MONITORING: self._begin_monitoring_off,
            GroupCommand.RESET_FAULT: self._reset_fault,
        }[command]()

    def quick_stop_now(self) -> None:
        """Sends the stop to all drives in one batch; see `DriveGroup.quick_stop_now`."""
        self._stop()  # first: even if the bus fails now, no later cycle re-enables the drives
        self._send((ControlWord.QUICK_STOP,) * len(self._nodes), lambda _enables: True)

    @property
    def ending(self) -> frozenset[int]:
        """Drives whose monitoring is being switched off; see `DriveGroup.ending`."""
        if self._monitoring_off is None:
            return frozenset()
        return frozenset(map(self._nodes.index, self._monitoring_off.unfinished()))

    @property
    def is_monitored(self) -> bool:
        """Whether drives still monitor this master; see `DriveGroup.is_monitored`."""
        jobs = self._monitoring_off
        return jobs is None or bool(jobs.unfinished() | jobs.refused())

    def read_state(self, pace: Pace) -> CycleStatus:
        """Reads the state of every drive by SDO; see `DriveGroup.read_state`."""
        self._online()
        silent = {self._nodes[i] for i, heard in enumerate(self._watch.answered) if not heard}
        jobs = StateReading(self._nodes, self._again_after, self._answer_cycles, silent=silent)
        self._watch.begin_cycle()
        self._watch.on_answer = jobs.take
        while jobs.waits:
            left = pace()
            self._ask(jobs, len(self._nodes))
            if self._pump is not None:
                self._pump()
                left = 0.0
            self._cyclic.take_replies(AnswerListener(self._watch.take, jobs), left)
        self._watch.take_states(jobs.values)
        self._check_faults()
        return self._status()

    def _ask(self, jobs: SdoJobs | ModeCheck | StatePoll, most: int) -> None:
        self._cyclic.send(SentFrame(can_id, data) for can_id, data in jobs.next_requests(most))

    def _begin_monitoring_off(self) -> None:
        """Switches monitoring off, heartbeat first, SYNC last; both are sent until then."""
        if self._state in (GroupState.ENABLING, GroupState.ENABLED):
            raise Refused("enabled drives must monitor this program", where="drive group")
        counts = dict(zip(self._nodes, self._heartbeats, strict=True))
        self._monitoring_off = MonitoringEnd(
            counts, self._profile.rpdo, self._again_after, stopped=self._watch.stopped()
        )
        self._modes, self._errors = None, SdoJobs({}, 1)
        self._watch.on_answer = self._monitoring_off.take

    def _send(self, words: tuple[ControlWord, ...], may_send: Callable[[bool], bool]) -> None:
        """Sends one cycle's frames; the words are remembered even if the bus fails."""
        self._sent.note(self._watch.states, words)
        self._watch.begin_cycle()
        stops: Sequence[can.Message] = ()
        may_follow = False
        try:
            self._cyclic.send(self._frames.set_points(words, self._targets))
            may_follow = may_send(ControlWord.ENABLE_OPERATION in words)
        finally:  # a frame that failed must not keep a stop from the other drives
            if not may_follow:  # the drives act on the set-points at SYNC: the last word counts
                self._stop()
                self._sent.words = (ControlWord.QUICK_STOP,) * len(words)
                stops = self._frames.set_points(self._sent.words, self._targets)
            self._cyclic.send((*stops, self._frames.sync))

    def _check_faults(self) -> None:
        powered = self._goal in (Goal.ENABLE, Goal.RELEASE)
        warnings = self._watch.warnings()
        self._warnings = warnings if powered else ()
        # Replies show the effect of earlier words, at first those of the former goal.
        goal, enables = self._former or (self._goal, self._enables)
        own = self._watch.changes_on_their_own(goal, enables=enables)
        if self._state is GroupState.ENABLED and self._profile.follows_bit is not False:
            own += self._watch.ignoring_targets()
        found = [*self._new_messages({node for node, _ in own}), *own]
        known = {text for _, text in (*self._faults, *found)}
        found += self._watch.state_faults(known, powered=powered)
        if self._goal is not Goal.RESET_FAULT:
            self._latch(found)

    def _new_messages(self, shown: Set[int] = frozenset()) -> list[tuple[int, str]]:
        """Messages since the last call that are faults whatever the replies have ``shown``."""
        found = self._watch.news()
        if self._state is GroupState.ENABLED:
            found += stopped_between_replies(self._rig.drive_names, self._poll.new_words(), shown)
        if self._goal in (Goal.ENABLE, Goal.RELEASE):
            return found
        # An emergency of a drive at rest only explains its state.
        return [(node, text) for node, text in found if node in self._watch.restarted]

    def _latch(self, found: list[tuple[int, str]]) -> None:
        for fault in found:
            if fault not in self._faults:
                self._faults.append(fault)
        if found:
            self._goal, self._state = Goal.STOP, GroupState.FAULT

    def _advance(self) -> None:
        """Checks whether the goal is reached or overdue."""
        states = self._watch.states_to_command
        self._cycles_to_goal += 1
        if self._watch.complete:
            self._former = None
        if self._goal is Goal.RESET_FAULT:
            self._watch.take_errors(self._errors.values)
            if self._cycles_to_goal > self._reset_cycles or DriveState.FAULT not in states:
                self._goal = Goal.IDLE
        elif self._state is GroupState.ENABLED:
            self._ask(self._poll, 1)  # late: drives stop after SYNC; few: a stop may follow
        elif self._state is GroupState.ENABLING:
            names, words = self._rig.drive_names, self._watch.status_words
            seconds, needs_bit = self._enable_s, self._profile.follows_bit
            idle = ignoring_drives(names, words, seconds) if needs_bit else []
            follow = set(self._sent.words) == {ControlWord.ENABLE_OPERATION}
            if follow and set(states) == {DriveState.OPERATION_ENABLED} and not idle:
                self._check_modes()
            elif self._cycles_to_goal > self._patience:
                late = self._watch.late(self._sent.words, self._goal, self._enable_s)
                self._latch(late or idle)
        elif self._goal is Goal.RELEASE:
            if all(state in WITHOUT_TORQUE for state in states):
                self._goal, self._state = Goal.IDLE, GroupState.RELEASED
            elif self._cycles_to_goal > 2 * self._patience:  # it enables the drives first
                self._latch(self._watch.late(self._sent.words, self._goal, 2.0 * self._enable_s))

    def _check_modes(self) -> None:
        """Enters ENABLED once every drive shows CSP; most profiles check it when configuring."""
        if self._profile.mode_display_when_enabled and self._modes is None:
            cycles = len(self._nodes) + round(MODE_WAIT / self._cycle_s) + self._answer_cycles
            self._modes = ModeCheck(self._nodes, cycles, self._again_after)
            self._watch.on_answer = self._modes.take
        wrong = self._modes.wrong() if self._modes is not None else {}
        if not wrong:
            self._modes, self._state = None, GroupState.ENABLED
            self._poll = StatePoll(self._nodes, self._again_after)
            self._watch.on_answer = self._poll.take
        elif self._modes is not None and self._modes.is_overdue:
            self._modes = None
            self._latch([(n, mode_text(self._rig.drive_names[n], m)) for n, m in wrong.items()])

    def _status(self) -> CycleStatus:
        watch = self._watch
        read = watch.positions, self._demands, watch.status_words
        positions, demands, words = (np.array(values, dtype=np.int64) for values in read)
        torques = np.array(watch.torques, dtype=np.int64) * self._signs
        answered = np.array(watch.answered)
        missing = ~answered
        for array in (positions, demands, torques, words, answered, missing):
            array.setflags(write=False)
        return CycleStatus(
            positions=positions,
            demands=demands,
            set_points=demands,
            renewed=answered,
            torques=torques,
            status_words=words,
            missing=missing,
            faults=tuple(self._faults),
            state=self._state,
            holding=all(s in HOLDS for s in watch.states),
            stopped=DriveState.OPERATION_ENABLED not in watch.states,
            rejected=watch.rejected,
            error_frames=self._cyclic.error_frames,
            warnings=self._warnings,
        )

    def _stop(self) -> None:
        self._goal = Goal.STOP
        if self._state not in (GroupState.FAULT, GroupState.OFFLINE):
            self._state = GroupState.QUICK_STOP

    def _begin_enabling(self) -> None:
        if self._state is GroupState.ENABLED:
            return
        self._refuse_latched("enable the drives")
        self._begin(Goal.ENABLE)
        self._state = GroupState.ENABLING

    def _begin(self, goal: Goal) -> None:
        self._former = self._goal, self._enables
        self._goal, self._cycles_to_goal = goal, 0
        self._modes, self._errors = None, SdoJobs({}, 1)
        self._enables = False
        self._watch.leave_in_fault(self._faults if goal is Goal.RELEASE else ())

    def require_releasable(self) -> None:
        """Checks whether the drives may be released; see `DriveGroup.require_releasable`."""
        if not (self.capabilities.has_brake and self._watch.only_in_fault(self._faults)):
            self._refuse_latched("release the drives")
        positions = dict(enumerate(self._watch.positions))
        require_within_limits(self._rig, positions, "nothing was enabled")

    def _begin_release(self) -> None:
        self.require_releasable()
        self._begin(Goal.RELEASE)
        if self._state in (GroupState.ENABLING, GroupState.ENABLED, GroupState.FAULT):
            self._state = GroupState.QUICK_STOP  # set-points are no longer followed

    def _reset_fault(self) -> None:
        """Clears the faults; resets drives in fault only if no other holds the platform."""
        faulted = self._watch.require_resettable(braked=self.capabilities.has_brake)
        self._errors = SdoJobs(dict.fromkeys(faulted, ERROR_REQUESTS), self._again_after)
        self._watch.on_answer = self._errors.take
        self._cycles_to_goal = 0
        self._faults.clear()
        self._watch.forget_emergencies()
        self._cyclic.forget_faults()
        if self._state is GroupState.FAULT:
            self._goal = Goal.RESET_FAULT if faulted else Goal.STOP
            self._state = GroupState.CONFIGURED if faulted else GroupState.QUICK_STOP
