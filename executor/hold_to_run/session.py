"""A session of jogs: enables the drives once, moves while a control is held, ends in order.

Controls are held over the command socket (`executor.remote.protocol`): the session itself has no
keys and no screen.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Protocol

import numpy as np

from executor.control.winch_motion import WinchesStand, WinchRecord, move_winches, recording
from executor.drives import (
    drives_of,
    is_simulated,
    require_own_time,
    unreferenced_drives_of,
)
from executor.hold_to_run.cables import CableMotion, CableTravel
from executor.hold_to_run.line import JogProver, PieceRing
from executor.hold_to_run.loop import JogMotion
from executor.hold_to_run.presses import PressBoard
from executor.interlock.interlock import MotionInterlock
from executor.jogging import FASTEST, LONGEST_MM, measured_pose, with_speed
from executor.proposals import CablesProposal, JogProposal, require_confirmed
from executor.realtime.job import MotionTask, ReadyDrives
from executor.realtime.scheduling import SimulatedClock
from executor.realtime.shared_memory import SharedMemory, SharedRequests
from executor.recording.record_files import free_folder
from executor.remote.command_socket import advertised, serving
from executor.remote.status import CableStatus, JogStatus, SessionStatus
from executor.state_machine import CycleRecord, LoopEvent
from executor.supervision import LocalRequests, RequestBoard, Supervisor
from executor.winch_runs import limit_of, winch_mover, with_board
from model.kinematics import cable_lengths
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Load, Scene, empty_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap

#: A session in which nothing is held for so long ends by itself, [s]: cables relax.
IDLE = 300.0


def jog_session(
    rig: Rig,
    scene: Scene | None,
    *,
    speed: float = FASTEST,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[JogProposal], bool] | None = None,
    supervisor: Supervisor | None = None,
    on_cycle: Callable[[CycleRecord, PressBoard, JogProver], None] | None = None,
) -> None:
    """Enables the drives where the platform is, and moves it straight while a control is held.

    A press is said to be held over the command socket (``held``, every 50 ms) and ends with
    ``let_go``, or when nothing is heard of it for 150 ms. What is ahead of the platform is proved
    while it moves, against the scene, the workspace, tensions and winches, and it slows down where
    no more can be proved. The session ends with ``end``, with a stop, or after five minutes in
    which nothing is held.

    Args:
        rig: The robot and its bus.
        scene: What is in the way, and what the platform carries; its stops are left out. None
            states that nothing is in the way.
        speed: Of a jog at most, [m/s].
        realtime: As for `executor.runner.run`, as all up to the supervisor.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        listener: Receives what happens.
        confirm: Called once, before anything is enabled; False cancels it.
        supervisor: Turns interrupts into stops; None for `KeyboardInterrupt`.
        on_cycle: Called after every cycle, with the board of presses and what is proved, by a
            program that holds controls itself.

    Raises:
        CdprError: As for `executor.jogging.jog`; a fault is latched.
        StoppedByOperator: It was cancelled, or stopped; the drives hold.
    """
    slow = with_speed(rig, speed)
    require_own_time(slow, realtime)
    interlock = MotionInterlock(slow)
    interlock.require_free()
    ready = interlock.referenced_rig()
    around = (empty_scene(slow) if scene is None else scene).changed(stops=())
    start = ready.home if is_simulated(ready) else measured_pose(ready, around)
    require_confirmed(confirm, JogProposal(ready, around, start))
    session = _Session(
        ready,
        _PlatformJogs(ready, around, start, on_cycle),
        realtime,
        need_real_time_rights,
        listener,
    )
    with_board(ready, supervisor or Supervisor(), session.run, realtime=realtime)


def cable_session(
    rig: Rig,
    *,
    limit: float | None = None,
    speed: float = FASTEST,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[CablesProposal], bool] | None = None,
    supervisor: Supervisor | None = None,
    on_cycle: Callable[[CycleRecord, PressBoard, CableTravel], None] | None = None,
) -> None:
    """Enables the drives where they are, homed or not, and moves one winch while a control is held.

    As `executor.jogging.jog_cable`, but for its length: the winch slows down when the control is
    let go, near the limit of the tension, where it comes to rest, and after 50 mm of a press. A
    press is held, and the session ends, as for `jog_session`. What the homing reference was before
    it stays; where the drive positions fit no pose afterwards, no run begins.

    Args:
        rig: The robot and its bus.
        limit: No cable may carry more, [N]; None for 60 % of the rig's range.
        speed: Of a winch at most, [m/s].
        realtime: As for `executor.runner.run`, as all up to the supervisor.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        listener: Receives what happens.
        confirm: Called once, before anything is enabled; False cancels it.
        supervisor: Turns interrupts into stops; None for `KeyboardInterrupt`.
        on_cycle: Called after every cycle, with the board of presses and how far cables moved, by
            a program that holds controls itself.

    Raises:
        CdprError: As for `executor.jogging.jog_cable`; a fault is latched.
        StoppedByOperator: It was cancelled, or stopped; the drives hold.
    """
    slow = with_speed(rig, speed)
    require_own_time(slow, realtime)
    limit = limit_of(slow, limit)
    MotionInterlock(slow).require_free()
    require_confirmed(confirm, CablesProposal(slow, limit))
    session = _Session(
        slow,
        _CableJogs(slow, limit, on_cycle),
        realtime,
        need_real_time_rights,
        listener,
    )
    with_board(slow, supervisor or Supervisor(), session.run, realtime=realtime)


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """What one kind of session puts into it.

    Attributes:
        task: Of the process that moves the drives.
        make_drives: See `winch_mover`.
        status: What is reported.
        take_cycle: Called after every cycle, before the status hears of it.
        on_cycle: Called after that.
    """

    task: MotionTask
    make_drives: Callable[..., AbstractContextManager[ReadyDrives]]
    status: SessionStatus
    take_cycle: Callable[[CycleRecord], None]
    on_cycle: Callable[[CycleRecord], None]


class _Kind(Protocol):
    """What is moved in a session."""

    @property
    def folder(self) -> str:
        """Of its record, below ``runs``."""
        ...

    @property
    def cables(self) -> int:
        """See `PressBoard`."""
        ...

    def parts(
        self, board: RequestBoard, presses: PressBoard, stack: ExitStack, *, realtime: bool
    ) -> _Parts:
        """Makes them; what must be closed is left to the stack."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _PlatformJogs:
    """The platform, straight, along what is proved."""

    folder: ClassVar[str] = "jog-session"
    cables: ClassVar[int] = 0

    rig: Rig
    scene: Scene
    start: Pose
    on_cycle: Callable[[CycleRecord, PressBoard, JogProver], None] | None

    def parts(
        self, board: RequestBoard, presses: PressBoard, stack: ExitStack, *, realtime: bool
    ) -> _Parts:
        """See `_Kind`."""
        rig, load = self.rig, self.scene.load
        memory = SharedMemory.create(PieceRing.size(rig.cable_count))
        stack.callback(memory.close)
        send = PieceRing(memory, rig.cable_count).put
        prover = JogProver(rig, self.scene, self.start, presses, send)
        task = JogMotion(
            rig=rig.document,
            cables=rig.cable_count,
            cycle=rig.cycle,
            begin=_counts_at(rig, self.start, load),
            presses=presses.memory,
            pieces=memory,
            reference=MotionInterlock(rig).require_ready(),
        )
        on_cycle = self.on_cycle or _nothing
        return _Parts(
            task,
            partial(drives_of, rig.document, self.start, load),
            JogStatus(rig, board, prover, simulated_time=not realtime),
            prover.take_cycle,
            lambda record: on_cycle(record, presses, prover),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _CableJogs:
    """One cable at a time."""

    folder: ClassVar[str] = "jog-cables"

    rig: Rig
    limit: float
    on_cycle: Callable[[CycleRecord, PressBoard, CableTravel], None] | None

    @property
    def cables(self) -> int:
        """See `PressBoard`."""
        return self.rig.cable_count

    def parts(
        self, board: RequestBoard, presses: PressBoard, stack: ExitStack, *, realtime: bool
    ) -> _Parts:
        """See `_Kind`."""
        rig, limit, longest = self.rig, self.limit, LONGEST_MM / 1000.0
        travel = CableTravel(rig, limit, longest)
        speed = rig.motion.speed
        task = CableMotion(rig.cable_count, rig.cycle, limit, speed, longest, presses.memory)
        on_cycle = self.on_cycle or _nothing
        return _Parts(
            task,
            partial(unreferenced_drives_of, rig.document, rig.home, limit, None),
            CableStatus(rig, board, travel, simulated_time=not realtime),
            lambda record: travel.take_cycle(record, presses.held()),
            lambda record: on_cycle(record, presses, travel),
        )


def _nothing(_record: CycleRecord, _presses: PressBoard, _moved: object) -> None:
    """No program looks on."""


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """One session and how it is to be done."""

    rig: Rig
    kind: _Kind
    realtime: bool
    need_real_time_rights: bool
    listener: Listener

    def run(self, board: LocalRequests | SharedRequests) -> WinchesStand:
        """Moves until it ends; the command socket takes what is said of presses."""
        rig, interlock = self.rig, MotionInterlock(self.rig)
        clock = SimulatedClock(rig.cycle)
        now = time.monotonic if self.realtime else lambda: clock.now
        with ExitStack() as stack:
            presses = PressBoard(now, self.kind.cables)
            stack.callback(presses.close)
            parts = self.kind.parts(board, presses, stack, realtime=self.realtime)
            status = parts.status
            listeners = stack.enter_context(advertised())
            stack.enter_context(serving(listeners, board, status, presses))
            mover = stack.enter_context(
                winch_mover(
                    rig,
                    parts.task,
                    parts.make_drives,
                    board,
                    clock=clock,
                    need_real_time_rights=self.need_real_time_rights,
                    listener=self.listener,
                )
            )
            kept = stack.enter_context(
                nullcontext() if is_simulated(rig) else recording(free_folder(self.kind.folder))
            )
            status.folder = None if kept is None else kept.folder
            stand = move_winches(
                mover,
                rig,
                interlock,
                _Sink(parts, presses, kept, self.listener),
                record=kept.folder if kept is not None else interlock.file.path,
                rehome=False,
                at_rest=lambda _stand, _true_pose: None,
            )
            status.take_end(stand.state, stand.cause)
        return stand


@dataclass(frozen=True, slots=True, eq=False)
class _Sink:
    """Forwards what happens to the parts of the session and the record."""

    parts: _Parts
    presses: PressBoard
    kept: WinchRecord | None
    listener: Listener

    def take_cycle(self, record: CycleRecord, _true_pose: Pose | None) -> None:
        self.parts.take_cycle(record)
        self.parts.status.take_cycle(record)
        if record.at - self.presses.last_heard > IDLE:
            self.presses.end()
        self.parts.on_cycle(record)
        if self.kept is not None:
            self.kept.take_cycle(record)

    def take_event(self, event: LoopEvent) -> None:
        self.parts.status.take_event(event)
        if event.code not in ("moving", "traceback"):
            self.listener.note(f"{event.code}: {event.text}")
        if self.kept is not None:  # last: what a full disk does not take is told all the same
            self.kept.take_event(event)


def _counts_at(rig: Rig, pose: Pose, load: Load) -> tuple[int, ...]:
    """Where the drives stand at a pose, as a set-point there has it."""
    winches, tensions = WinchMap(rig), working_tensions(rig, pose, load).tensions
    counts = winches.counts(winches.unstrained(cable_lengths(rig, pose), tensions))
    return tuple(int(count) for count in np.rint(counts))
