"""All ODrives of a rig as one group: no SYNC, and brakes that close when an axis is disarmed.

Every cycle sends all set-points back to back. Any stop freezes all targets (at top speed a
drive then stops within a cycle), holds under torque until the platform is at rest, and disarms all
drives back to back, which closes their brakes. Without a master the drives' watchdogs disarm them:
they are fed by the same batch of frames, so they expire together.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from enum import Enum, auto

import can
import numpy as np

from drivers.can_load import TESTED_HZ, heartbeat_within
from drivers.cyclic_group import CyclicBus, CyclicGroup
from drivers.drive_group import (
    Capabilities,
    Counts,
    CycleStatus,
    DriveSnapshot,
    GroupCommand,
    GroupState,
    OnRestarted,
    Pace,
    Pump,
)
from drivers.odrive.configure import configure_drives
from drivers.odrive.messages import (
    RESULT_TEXTS,
    AxisState,
    OdriveFrames,
    commanding_ids,
    foreign_master_message,
    is_command,
    read_layouts,
    state_text,
)
from drivers.odrive.monitor import OdriveMonitor, Report
from drivers.plausibility import largest_steps, winding_signs
from model.errors import HardwareMissing, Refused
from model.files.rig_file import OdriveDocument
from model.rig import Rig

STEP_TIMEOUT = 1.0
"""Time-out of enabling and disarming in addition to the heartbeats, [s]: brakes take tenths."""

SETTLING = 0.1
"""Time under torque before the brakes close, [s]."""

FIRST_READINGS = 2
FIRST_READING_WITHIN = 2.0
"""Time for the first messages of all drives in addition to their slowest heartbeat, [s]."""
FIRST_READING_TIMEOUT = 0.1
"""Part of it after which those that have arrived are processed, [s]."""


class _Stop(Enum):
    """Progress of a stop."""

    NONE = auto()
    HOLDING = auto()
    DISARMING = auto()
    OVER = auto()


class OdriveGroup(CyclicGroup):
    """ODrives in position control; see `drivers.drive_group.DriveGroup`."""

    _watch: OdriveMonitor

    def __init__(
        self, rig: Rig, bus: can.BusABC, pump: Pump | None = None, *, max_tension: float | None
    ) -> None:
        """Takes an open bus and sends nothing yet; arguments as for `make_drive_group`."""
        document = rig.document.drives
        if not isinstance(document, OdriveDocument):
            raise TypeError("the rig has no ODrives")
        super().__init__(rig, bus, pump)
        self._document = document
        self._layouts = read_layouts(document.dbc)
        self._frames = OdriveFrames(rig, self._layouts)
        cycle = rig.cycle
        self._step_within = STEP_TIMEOUT + heartbeat_within(document)
        self._patience = round(self._step_within / cycle)
        self._settling = max(1, round(SETTLING / cycle))
        self._max_tension = rig.max_tension if max_tension is None else max_tension
        self._per_mille = winding_signs(rig) * 1000.0 / [w.rated_torque for w in rig.winches]
        self._reset_memory()

    def _reset_memory(self) -> None:
        ids = commanding_ids(self._nodes)
        self._cyclic = CyclicBus(self._bus, ids, foreign_master_message, is_command)
        self._watch = OdriveMonitor(self._rig, self._document, self._layouts, self._max_steps)
        self._recent: deque[list[int]] = deque(maxlen=self._watch.window)
        self._stop = _Stop.NONE
        self._waited = 0
        self._releasing = False
        self._all_hold = False  # all drives were enabled when the stop began
        self._armed: set[int] = set()  # drives seen under torque since enabling began, by index
        self._resetting = 0
        self._faults = []

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of ODrives, with the brakes and the watchdog of the rig file."""
        return Capabilities(
            sync=False,
            holds_on_comm_loss=False,
            holds_on_quick_stop=False,
            has_brake=all(winch.brake for winch in self._rig.winches),
            max_hz=TESTED_HZ,
            watchdog_ms=self._document.watchdog_ms,
            sync_timeout=None,
            master_timeout=0.0,
            released_within=SETTLING + self._step_within + 1.0,
        )

    @property
    def restarted(self) -> tuple[int, ...]:
        """Empty: a loss of power leaves no trace, as ODrive settings are non-volatile.

        So the rig file requires absolute encoders.
        """
        return ()

    @property
    def stopping(self) -> bool:
        """Whether drives under torque still have to be handed over to their brakes."""
        return self._stop in (_Stop.HOLDING, _Stop.DISARMING)

    @property
    def targets(self) -> Counts:
        """Last targets sent, shape (m,), [counts]."""
        return np.array(self._last(), dtype=np.int64)

    def configure(
        self, *, to_reset: bool = False, on_restarted: OnRestarted | None = None
    ) -> tuple[str, ...]:
        """Configures every drive; see `DriveGroup.configure`."""
        self._refuse_enabled()
        self._state = GroupState.OFFLINE
        self._reset_memory()
        if on_restarted is not None:
            on_restarted(self.restarted)
        remarks = configure_drives(
            self._rig,
            self._document,
            self._layouts,
            self._bus,
            self._pump,
            max_tension=self._max_tension,
            to_reset=to_reset,
        )
        self._state = GroupState.CONFIGURED
        return remarks

    def read_positions(self, pace: Pace | None = None) -> CycleStatus:
        """Waits until every drive has reported position and state; see `DriveGroup`.

        ODrives report on their own, so nothing is sent; ``pace`` only shows the supervisor that
        this process is alive. Their torques are required too: an enabled drive without them is a
        fault.
        """
        return self._read(pace, "position", "heartbeat", "torque")

    def _read(self, pace: Pace | None, *reports: Report) -> CycleStatus:
        self._online()
        self._cyclic.forget_waiting()
        for report in reports:
            self._watch.forget(report)
        agreed = 0
        for _ in range(first_attempts(self._rig, self._document, self._pump)):
            if pace is not None and self._pump is None:
                pace()
            self._watch.begin_cycle()
            status = self.receive(FIRST_READING_TIMEOUT)
            agreed = 0 if status.missing.any() else agreed + 1
            if agreed >= FIRST_READINGS and self._watch.heard(*reports):
                self._recent.clear()
                return status
        raise self._watch.unheard("reading the drives' positions", *reports)

    def send_cycle(
        self, targets: Sequence[int], may_send: Callable[[bool], bool] = lambda _enables: True
    ) -> None:
        """Sends one cycle; see `DriveGroup.send_cycle`.

        A set-point does not arm an axis that disarmed itself, so `may_send` has no effect.
        """
        may_send(False)
        self._online()
        self._discard_stale()
        self._watch.begin_cycle()
        before = self._last()
        if self._state is GroupState.ENABLED:
            now = [int(target) for target in targets]
        elif self._state is GroupState.ENABLING or self.stopping:
            now = before  # do not follow a sagging drive
        else:
            now = list(self._watch.positions)
            before = now
        self._recent.append(now)
        self._waited += 1
        if self._stop is _Stop.DISARMING:
            self._cyclic.send(self._frames.axis_states(AxisState.IDLE))
            return
        self._cyclic.send(self._frames.set_points(now, before))
        if self._state is GroupState.ENABLING:
            self._arm()

    def command(self, command: GroupCommand) -> None:
        """Sets the goal of the group; see `DriveGroup.command`."""
        self._online()
        if command is GroupCommand.ENABLE:
            self._begin_enabling()
        elif command is GroupCommand.RESET_FAULT:
            self._reset_fault()
        elif command is not GroupCommand.END_MONITORING:  # idle axes monitor no master
            if command is GroupCommand.RELEASE:
                self.require_releasable()
            # Every stop of ODrives ends with closed brakes and without torque.
            self._begin_stop(GroupState.QUICK_STOP)
            self._releasing = command is GroupCommand.RELEASE

    def require_releasable(self) -> None:
        """Refuses while a fault is latched; see `DriveGroup.require_releasable`."""
        self._refuse_latched("release the drives")

    def quick_stop_now(self) -> None:
        """Sends the stop to all drives in one batch; see `DriveGroup.quick_stop_now`."""
        self._begin_stop(GroupState.QUICK_STOP)
        if self._stop is _Stop.HOLDING:
            self._cyclic.send(self._frames.set_points(self._last(), self._last()))

    @property
    def ending(self) -> frozenset[int]:
        """Empty, as only an armed axis has a watchdog; see `DriveGroup.ending`."""
        return frozenset()

    @property
    def is_monitored(self) -> bool:
        """False, as axes at rest monitor nothing; see `DriveGroup.is_monitored`."""
        return False

    def read_state(self, pace: Pace) -> CycleStatus:
        """Reads positions and states again; see `DriveGroup.read_state`."""
        with suppress(HardwareMissing):
            return self._read(pace, "position", "heartbeat")
        silent = np.array(self._watch.overdue("heartbeat")) | self._watch.missing
        silent.setflags(write=False)
        return replace(self._status(), missing=silent)

    def _arm(self) -> None:
        """Arms all drives once, and again those whose watchdog expired before they were fed.

        ODrive does not document whether the watchdog runs while an axis is idle; in firmware 0.5
        it does. Source: ODrive, Firmware/MotorControl/main.cpp, control_loop_cb.
        """
        expired = self._watch.take_expired(self._at_rest())
        arming = self._at_rest() if self._waited == 1 else expired
        self._cyclic.send(self._frames.clear_errors(expired))
        self._cyclic.send(self._frames.axis_states(AxisState.CLOSED_LOOP_CONTROL, arming))

    def _at_rest(self) -> list[int]:
        """Drives not seen under torque since enabling began, by index."""
        return [drive for drive in range(len(self._nodes)) if drive not in self._armed]

    def _last(self) -> list[int]:
        return self._recent[-1] if self._recent else list(self._watch.positions)

    def _check_faults(self) -> None:
        if self._resetting:
            self._resetting -= 1
            return
        holding = self._stop is _Stop.HOLDING
        enabled = self._state is GroupState.ENABLED or (holding and self._all_hold)
        powered = enabled or holding or self._state is GroupState.ENABLING
        if not powered:
            self._armed.clear()
        elif self._state is GroupState.ENABLING:
            states = enumerate(self._watch.states)
            self._armed |= {n for n, state in states if state == AxisState.CLOSED_LOOP_CONTROL}
        at_rest = self._at_rest()
        self._latch(self._watch.faults(powered=powered, enabled=enabled, at_rest=at_rest))

    def _latch(self, found: list[tuple[int, str]]) -> None:
        self._faults += [fault for fault in found if fault not in self._faults]
        if found:
            self._begin_stop(GroupState.FAULT)

    def _begin_stop(self, state: GroupState) -> None:
        """Freezes the targets; does not restart a stop in progress."""
        powered = self._state in (GroupState.ENABLING, GroupState.ENABLED)
        self._all_hold = self._all_hold or self._state is GroupState.ENABLED
        if self._state is not GroupState.FAULT:
            self._state = state
        if powered or self._stop is _Stop.NONE:
            idle = _Stop.OVER if self._all_disarmed() else _Stop.DISARMING
            self._stop, self._waited = _Stop.HOLDING if powered else idle, 0

    def _advance(self) -> None:
        """Checks whether the transition in progress has finished or timed out."""
        if self._stop is _Stop.HOLDING and self._waited >= self._settling:
            self._stop, self._waited = _Stop.DISARMING, 0
            self._watch.forget("heartbeat")
        elif self._stop is _Stop.DISARMING and self._waited > 0:
            if self._all_disarmed() or self._waited > self._patience:
                self._stop = _Stop.OVER
        elif self._state is GroupState.ENABLING:
            if self._watch.measures_tensions:  # until then brakes carry the cables
                self._state = GroupState.ENABLED
            elif self._waited > self._patience:
                self._latch(self._not_enabled())
        if self._releasing and self._state is GroupState.QUICK_STOP and self._all_disarmed():
            self._state = GroupState.RELEASED

    def _all_disarmed(self) -> bool:
        return self._watch.heard("heartbeat") and not self._watch.any_enabled()

    def _not_enabled(self) -> list[tuple[int, str]]:
        watch = self._watch
        found = []
        for node, state, result in zip(self._nodes, watch.states, watch.results, strict=True):
            if state != AxisState.CLOSED_LOOP_CONTROL:
                why = RESULT_TEXTS.get(result, f"procedure result {result}")
                name = self._rig.drive_names[node]
                text = f"{name} stays {state_text(state)} instead of closed loop control"
                found.append((node, f"{text}: {why}"))
        return found

    def _status(self) -> CycleStatus:
        watch = self._watch
        positions = np.array(watch.positions, dtype=np.int64)
        targets = np.array(self._recent or [watch.positions], dtype=np.int64)
        # A drive reports its position asynchronously, between the last set-points.
        demands = np.clip(positions, targets.min(axis=0), targets.max(axis=0))
        torques = np.rint(np.array(watch.torques) * self._per_mille).astype(np.int64)
        words = np.array(watch.status_words, dtype=np.int64)
        missing, renewed = np.array(watch.missing), np.array(watch.renewed)
        for array in (positions, demands, targets, torques, words, missing, renewed):
            array.setflags(write=False)
        braked = self.capabilities.has_brake and self._all_disarmed()
        following = self._state in (GroupState.ENABLING, GroupState.ENABLED) or self.stopping
        return CycleStatus(
            positions=positions,
            demands=demands,
            set_points=targets[-1],
            renewed=renewed,
            torques=torques,
            status_words=words,
            missing=missing,
            faults=tuple(self._faults),
            state=self._state,
            holding=braked or watch.in_state(AxisState.CLOSED_LOOP_CONTROL),
            stopped=not following and self._all_disarmed(),
            rejected=watch.rejected,
            error_frames=self._cyclic.error_frames,
        )

    def _begin_enabling(self) -> None:
        if self._state is GroupState.ENABLED:
            return
        self._refuse_latched("enable the drives")
        if self.stopping:
            raise Refused("cannot enable the drives: they are being stopped", where="drive group")
        self._cyclic.forget_waiting()  # the drives kept sending meanwhile
        self._state, self._stop, self._waited = GroupState.ENABLING, _Stop.NONE, 0
        self._all_hold = False
        self._armed.clear()
        self._recent.clear()

    def _reset_fault(self) -> None:
        """Clears the errors of all drives if none holds the platform under torque."""
        if self._watch.any_enabled() or self._stop is _Stop.HOLDING:
            raise Refused(
                "drives cannot be reset while some hold the platform under torque",
                where="drive group",
                why="resetting one drive of a platform under tension moves it",
                next_step="wait until the brakes have closed, then reset the fault",
            )
        self._faults.clear()
        self._cyclic.forget_faults()
        self._cyclic.send(self._frames.clear_errors())
        self._state, self._stop = GroupState.CONFIGURED, _Stop.NONE
        heartbeat = self._document.heartbeat_ms / self._rig.document.bus.cycle_ms
        self._resetting = int(heartbeat) + 2  # until all heartbeats are newer than the reset


def first_attempts(rig: Rig, document: OdriveDocument, pump: Pump | None) -> int:
    """Number of attempts to hear all drives; each lasts `FIRST_READING_TIMEOUT` or one ``pump``."""
    attempt = FIRST_READING_TIMEOUT if pump is None else rig.cycle
    return math.ceil((FIRST_READING_WITHIN + heartbeat_within(document)) / attempt)


# Reads the state of ODrives from their cyclic messages without changing anything.


def read_axes(
    rig: Rig, document: OdriveDocument, bus: can.BusABC, pump: Pump | None, *, partial: bool = False
) -> DriveSnapshot:
    """State, position and torque of every axis; see `drivers.factory.read_drives`."""
    layouts = read_layouts(document.dbc)
    nodes = [winch.node_id for winch in rig.winches]
    cyclic = CyclicBus(bus, commanding_ids(nodes), foreign_master_message, is_command)
    watch = OdriveMonitor(rig, document, layouts, largest_steps(rig, rig.cycle))
    silence: HardwareMissing | None = None
    cyclic.forget_waiting()
    for _ in range(first_attempts(rig, document, pump)):
        watch.begin_cycle()
        if pump is not None:
            pump()
        cyclic.take_replies(watch, FIRST_READING_TIMEOUT if pump is None else 0.0)
        cyclic.end_cycle()
        watch.end_cycle()
        if watch.heard("position", "heartbeat"):
            break
    else:
        silence = watch.unheard("listening to the drives", "position", "heartbeat")
        if not partial:
            raise silence
    heard = ~(np.array(watch.missing) | watch.overdue("heartbeat"))
    per_mille = winding_signs(rig) * 1000.0 / [winch.rated_torque for winch in rig.winches]
    return DriveSnapshot(
        positions=np.array(watch.positions, dtype=np.int64)[heard],
        torques=np.rint(np.array(watch.torques) * per_mille).astype(np.int64)[heard],
        status_words=np.array(watch.status_words, dtype=np.int64)[heard],
        restarted=(),  # see `OdriveGroup.restarted`
        errors=("",) * int(heard.sum()),
        silent=tuple(np.array(nodes)[~heard].tolist()),
        silence=silence,
    )
