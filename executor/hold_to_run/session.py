"""Jog sessions: enable the drives once, move while a control is held, end in order.

Controls are reported over the command socket (`executor.remote.protocol`): the session itself has
no keys and no screen.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Protocol

from executor.control.winch_motion import WinchResult
from executor.drives import (
    drives_of,
    is_simulated,
    require_own_time,
    require_simulated_start,
    unreferenced_drives_of,
)
from executor.hold_to_run.cables import CableMotion, CableTravel
from executor.hold_to_run.line import JogProver, PieceRing
from executor.hold_to_run.loop import JogMotion
from executor.hold_to_run.presses import PressBoard
from executor.interlock.interlock import MotionInterlock
from executor.jogging import FASTEST, LONGEST_MM, measured_pose, with_speed
from executor.proposals import Proposal, cables_proposal, jog_proposal, require_confirmed
from executor.realtime.child import MotionTask, ReadyDrives
from executor.realtime.scheduling import SimulatedClock
from executor.realtime.shared_memory import SharedMemory
from executor.remote.command_server import Commands, commands_from_start
from executor.remote.status import CableStatus, JogStatus, SessionStatus
from executor.state_machine import REMARK, CycleRecord
from executor.supervision import RequestBoard, Supervisor
from executor.winch_runs import limit_of, move_supervised, supervised, winch_mover
from model.errors import truth_value
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Scene, empty_scene
from model.winches import WinchMap

#: A session without a held control ends after this time, [s]: cables relax.
IDLE = 300.0


def jog_session(
    rig: Rig,
    scene: Scene | None,
    *,
    speed: float = FASTEST,
    start: Pose | None = None,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
    on_cycle: Callable[[CycleRecord, PressBoard, JogProver], None] | None = None,
) -> None:
    """Enables the drives, and moves the platform in a straight line while a control is held.

    A press is reported over the command socket (``held``, every 50 ms) and ends with ``let_go``, or
    after 150 ms without a report. The line ahead of the platform is checked during the motion
    against the scene, the workspace, tensions and winches, and the platform slows down before the
    end of the checked line. The session ends with ``end``, with a stop, or after five minutes
    without a held control.

    Args:
        rig: The robot and its bus.
        scene: Obstacles and load; its stops are ignored. None states that there are no obstacles.
        speed: Largest jog speed, [m/s].
        start: Pose of the simulated platform, ``world_from_platform``; None for its home pose.
        realtime: As for `executor.runner.run`, like all up to the supervisor.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        listener: Receives events.
        confirm: Called once, before anything is enabled; False cancels it.
        supervisor: Turns interrupts into stops; None for `KeyboardInterrupt`.
        on_cycle: Called after every cycle with the board of presses and the checked line, for
            programs that hold controls themselves.

    Raises:
        CdprError: As for `executor.jogging.jog`; a fault is latched.
        StoppedByOperator: Cancelled, or stopped; the drives hold.
    """
    realtime = truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    slow = with_speed(rig, speed)
    require_own_time(slow, realtime)
    require_simulated_start(slow, start)
    with commands_from_start("jog", slow, supervisor, realtime=realtime) as commands:
        interlock = MotionInterlock(slow)
        interlock.require_free()
        ready = interlock.referenced_rig()
        around = (empty_scene(slow) if scene is None else scene).changed(stops=())
        known = (start or ready.home) if is_simulated(ready) else None
        start = known or measured_pose(ready, around)
        require_confirmed(confirm, jog_proposal(ready, around, start))
        session = _Session(
            ready,
            _PlatformJogs(ready, around, start, on_cycle),
            realtime,
            need_real_time_rights,
            listener,
        )
        supervised(ready, commands, partial(session.run, commands))


def cable_session(
    rig: Rig,
    *,
    limit: float | None = None,
    speed: float = FASTEST,
    realtime: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    supervisor: Supervisor | None = None,
    on_cycle: Callable[[CycleRecord, PressBoard, CableTravel], None] | None = None,
) -> None:
    """Enables the drives, homed or not, and moves one winch while a control is held.

    As `executor.jogging.jog_cable`, except for the length: the winch slows down and comes to rest
    when the control is released, near the tension limit, and after 50 mm of a press. Presses and
    the end of the session are as for `jog_session`. The homing reference is kept; if the drive
    positions fit no pose afterwards, no run begins.

    Args:
        rig: The robot and its bus.
        limit: Largest tension of any cable, [N]; None for 60 % of the rig's range.
        speed: Largest winch speed, [m/s].
        realtime: As for `executor.runner.run`, like all up to the supervisor.
        need_real_time_rights: Refuse to enable drives on a bus without real-time scheduling.
        listener: Receives events.
        confirm: Called once, before anything is enabled; False cancels it.
        supervisor: Turns interrupts into stops; None for `KeyboardInterrupt`.
        on_cycle: Called after every cycle with the board of presses and the cable travel, for
            programs that hold controls themselves.

    Raises:
        CdprError: As for `executor.jogging.jog_cable`; a fault is latched.
        StoppedByOperator: Cancelled, or stopped; the drives hold.
    """
    realtime = truth_value("realtime", realtime)
    need_real_time_rights = truth_value("need_real_time_rights", need_real_time_rights)
    slow = with_speed(rig, speed)
    require_own_time(slow, realtime)
    limit = limit_of(slow, limit)
    with commands_from_start("jog", slow, supervisor, realtime=realtime) as commands:
        MotionInterlock(slow).require_free()
        require_confirmed(confirm, cables_proposal(slow, limit))
        session = _Session(
            slow,
            _CableJogs(slow, limit, on_cycle),
            realtime,
            need_real_time_rights,
            listener,
        )
        supervised(slow, commands, partial(session.run, commands))


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Parts of one kind of session.

    Attributes:
        task: For the real-time process.
        make_drives: See `winch_mover`.
        status: Reported status.
        take_cycle: Called after every cycle.
        on_cycle: Called after that.
    """

    task: MotionTask
    make_drives: Callable[..., AbstractContextManager[ReadyDrives]]
    status: SessionStatus
    take_cycle: Callable[[CycleRecord], None]
    on_cycle: Callable[[CycleRecord], None]


class _Kind(Protocol):
    """Kind of session."""

    @property
    def folder(self) -> str:
        """Name of its record folder in ``runs``."""
        ...

    @property
    def cables(self) -> int:
        """See `PressBoard`."""
        ...

    def parts(
        self, board: RequestBoard, presses: PressBoard, stack: ExitStack, *, realtime: bool
    ) -> _Parts:
        """Makes the parts; resources to close go to the stack."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _PlatformJogs:
    """Moves the platform along a checked straight line."""

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
            begin=tuple(map(int, WinchMap(rig).counts_at(self.start, load))),
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
    """Moves one cable at a time."""

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
    """Default for `on_cycle`."""


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """One session and its options."""

    rig: Rig
    kind: _Kind
    realtime: bool
    need_real_time_rights: bool
    listener: Listener

    def run(self, commands: Commands) -> WinchResult:
        """Runs the session; the command socket takes the presses."""
        rig, clock, board = self.rig, SimulatedClock(self.rig.cycle), commands.board
        now = time.monotonic if self.realtime else lambda: clock.now
        with ExitStack() as stack:
            presses = PressBoard(now, self.kind.cables)
            stack.callback(presses.close)
            parts = self.kind.parts(board, presses, stack, realtime=self.realtime)

            def take_cycle(record: CycleRecord) -> None:
                parts.take_cycle(record)
                if record.at - presses.last_heard > IDLE:
                    presses.end()
                parts.on_cycle(record)

            mover = winch_mover(
                rig,
                parts.task,
                parts.make_drives,
                board,
                clock=clock,
                need_real_time_rights=self.need_real_time_rights,
                listener=self.listener,
            )
            return move_supervised(
                rig,
                commands,
                mover,
                parts.status,
                self.kind.folder,
                listener=self.listener,
                showing=nullcontext(take_cycle),
                presses=presses,
                # Its user must know when drives are enabled.
                unreported={"moving", "traceback", REMARK},
            )
