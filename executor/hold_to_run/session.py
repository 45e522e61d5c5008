"""A session of jogs: enables the drives once, moves while a control is held, ends in order.

Controls are held over the command socket (`executor.remote.protocol`): the session itself has no
keys and no screen.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial

import numpy as np

from executor.control.winch_loop import WinchesHere, WinchMover
from executor.control.winch_motion import WinchesStand, WinchRecord, move_winches, recording
from executor.drives import drives_of, is_simulated, left_alone, open_drives, require_own_time
from executor.hold_to_run.line import (
    FIRST_ROWS,
    MOST_ROWS,
    JogLine,
    Piece,
    PieceRing,
)
from executor.hold_to_run.loop import JogMotion
from executor.hold_to_run.presses import Press, PressBoard
from executor.interlock.interlock import MotionInterlock
from executor.jogging import FASTEST, measured_pose, with_speed
from executor.kernels import ready_for_simulating_process
from executor.proposals import JogProposal, require_confirmed
from executor.realtime.clock import SimulatedClock
from executor.realtime.process import real_time_process
from executor.realtime.shared_memory import SharedMemory, SharedRequests
from executor.recording.run_course import free_folder
from executor.remote.command_socket import advertised, serving
from executor.remote.status import JogStatus
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import LocalRequests, Supervisor
from executor.winch_runs import with_board
from model.errors import CdprError
from model.kinematics import cable_lengths
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Rig
from model.scene import Load, Scene, nothing_in_the_way
from model.statics.gravity import working_tensions
from model.winches import WinchMap

#: Rows are proved ahead for so long beyond the way to rest, [s].
AHEAD = 0.4
#: Cycles after the end of a press until what the loop reports is certainly not of it any more.
CERTAIN = 2.0
#: A session in which nothing is held for so long ends by itself, [s]: cables relax.
IDLE = 300.0


class JogProver:
    """Keeps what is proved ahead of the platform as long as a press is held."""

    def __init__(
        self, rig: Rig, scene: Scene, start: Pose, board: PressBoard, send: Callable[[Piece], None]
    ) -> None:
        """The platform is at rest at the start, ``world_from_platform``."""
        self._rig, self._scene, self._board, self._send = rig, scene, board, send
        self._cycle = rig.document.bus.cycle_ms / 1000.0
        motion = rig.motion
        to_rest = motion.speed / motion.acceleration + motion.acceleration / motion.jerk
        self._wanted_rows = (AHEAD + to_rest) / self._cycle
        self._line = JogLine(rig, scene, start, np.zeros(3))
        self._press, self._size, self._narrows, self._is_whole = 0, FIRST_ROWS, False, True
        self._row = 0.0
        self.limit = ""
        """Why the line ends where it does; empty while it may go on."""

    @property
    def pose(self) -> Pose:
        """Where the platform was sent last, ``world_from_platform``."""
        return self._line.pose(self._row)

    @property
    def room(self) -> float:
        """How far the platform may still go on this line, [m]."""
        return self._line.travelled(self._line.rows - 1) - self._line.travelled(self._row)

    def take_cycle(self, record: CycleRecord) -> None:
        """A cycle is over; proves at most one piece."""
        if record.state is not State.MOVING:
            return
        press = self._board.held()
        if press is None or press.number == self._press:
            self._row = record.index
        if press is None:
            return
        if press.number != self._press:
            rests = record.rate == 0.0 or record.index >= self._line.rows - 1
            # What this cycle did was decided up to a cycle before it began.
            if rests and record.at - press.free_since > CERTAIN * self._cycle:
                self._row = record.index
                self._begin(press)
        elif not self._is_whole and self._line.rows - 1 - record.index < self._wanted_rows:
            self._prove(press)

    def _begin(self, press: Press) -> None:
        start = self.pose
        rotation = start.rotation if press.in_platform else np.eye(3)
        self._line = JogLine(self._rig, self._scene, start, rotation @ press.direction)
        self._press, self._row, self.limit = press.number, 0.0, ""
        self._size, self._narrows, self._is_whole = FIRST_ROWS, False, False
        self._prove(press)

    def _prove(self, press: Press) -> None:
        """Proves the next piece; half of one that is refused, until not one row is left."""
        first = self._line.rows - 1
        try:
            if press.step is None:
                checked = self._line.go_on(self._size)
            else:
                checked = self._line.step(press.step)
        except CdprError as error:
            self.limit = self.limit or error.what
            self._size, self._narrows = self._size // 2, True
            self._is_whole = press.step is not None or self._size == 0
            return
        self._is_whole = press.step is not None
        if not self._narrows:
            self._size = MOST_ROWS
        rows = checked.table.setpoints
        self._send(Piece(press.number, first, self._is_whole, rows, checked.hash))


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
    around = (nothing_in_the_way(slow) if scene is None else scene).changed(stops=())
    start = ready.home if is_simulated(ready) else measured_pose(ready, around)
    require_confirmed(confirm, JogProposal(ready, around, start))
    session = _Session(ready, around, start, realtime, need_real_time_rights, listener, on_cycle)
    with_board(ready, supervisor or Supervisor(), session.run, realtime=realtime)


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """One session and how it is to be done."""

    rig: Rig
    scene: Scene
    start: Pose
    realtime: bool
    need_real_time_rights: bool
    listener: Listener
    on_cycle: Callable[[CycleRecord, PressBoard, JogProver], None] | None

    def run(self, board: LocalRequests | SharedRequests) -> WinchesStand:
        """Moves until it ends; the command socket takes what is said of presses."""
        rig, interlock = self.rig, MotionInterlock(self.rig)
        clock = SimulatedClock(rig.document.bus.cycle_ms / 1000.0)
        with ExitStack() as stack:
            presses = PressBoard(time.monotonic if self.realtime else lambda: clock.now)
            stack.callback(presses.close)
            memory = SharedMemory.create(PieceRing.size(rig.cable_count))
            stack.callback(memory.close)
            send = PieceRing(memory, rig.cable_count).put
            prover = JogProver(rig, self.scene, self.start, presses, send)
            status = JogStatus(rig, board, prover, simulated_time=not self.realtime)
            listeners = stack.enter_context(advertised())
            stack.enter_context(serving(listeners, board, status, presses))
            mover = stack.enter_context(self._mover(board, presses, memory, clock))
            kept = stack.enter_context(
                nullcontext() if is_simulated(rig) else recording(free_folder("jog-session"))
            )
            status.folder = None if kept is None else kept.folder
            stand = move_winches(
                mover,
                rig,
                interlock,
                _Sink(self, prover, presses, status, kept),
                record=kept.folder if kept is not None else interlock.file.path,
                rehome=False,
                at_rest=lambda _stand, _true_pose: None,
            )
            status.take_end(stand.state, stand.cause)
        return stand

    @contextmanager
    def _mover(
        self,
        board: LocalRequests | SharedRequests,
        presses: PressBoard,
        pieces: SharedMemory,
        clock: SimulatedClock,
    ) -> Iterator[WinchMover]:
        """In real time the drives are opened and moved in a process of its own."""
        rig, listener = self.rig, self.listener
        motion = JogMotion(
            rig=rig.document,
            cables=rig.cable_count,
            cycle=rig.document.bus.cycle_ms / 1000.0,
            begin=_counts_at(rig, self.start, self.scene.load),
            presses=presses.memory,
            pieces=pieces,
            reference=MotionInterlock(rig).require_ready(),
        )
        if isinstance(board, LocalRequests):
            with open_drives(rig, self.start, self.scene.load, listener=listener) as drives:
                yield WinchesHere(motion, drives, clock, board)
            return
        if is_simulated(rig):
            ready_for_simulating_process(listener)
        with real_time_process(
            motion,
            partial(drives_of, rig.document, self.start, self.scene.load),
            board,
            need_real_time=self.need_real_time_rights and not is_simulated(rig),
            look_again=partial(left_alone, rig.document),
            listener=listener,
        ) as process:
            yield process


@dataclass(frozen=True, slots=True, eq=False)
class _Sink:
    """Forwards what happens to the prover, the status and the record."""

    session: _Session
    prover: JogProver
    presses: PressBoard
    status: JogStatus
    kept: WinchRecord | None

    def take_cycle(self, record: CycleRecord, _true_pose: Pose | None) -> None:
        self.prover.take_cycle(record)
        self.status.take_cycle(record)
        if record.at - self.presses.last_heard > IDLE:
            self.presses.end()
        if self.session.on_cycle is not None:
            self.session.on_cycle(record, self.presses, self.prover)
        if self.kept is not None:
            self.kept.take_cycle(record)

    def take_event(self, event: LoopEvent) -> None:
        self.status.take_event(event)
        if event.code not in ("moving", "traceback"):
            self.session.listener.note(f"{event.code}: {event.text}")
        if self.kept is not None:  # last: what a full disk does not take is told all the same
            self.kept.take_event(event)


def _counts_at(rig: Rig, pose: Pose, load: Load) -> tuple[int, ...]:
    """Where the drives stand at a pose, as a set-point there has it."""
    winches, tensions = WinchMap(rig), working_tensions(rig, pose, load).tensions
    counts = winches.counts(winches.unstrained(cable_lengths(rig, pose), tensions))
    return tuple(int(count) for count in np.rint(counts))
