"""Moves winches without a path: what homing and jogging one cable have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from drivers.drive_group import CycleStatus
from executor.control.winch_loop import LawMotion, MakeLaw, WinchesHere, WinchMover
from executor.control.winch_motion import WinchesStand, WinchRecord, move_winches, recording
from executor.drives import is_simulated, left_alone, unreferenced_drives_of
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference
from executor.kernels import ready_for_simulating_process
from executor.realtime.job import Armed, Ended, MotionTask, ReadyDrives
from executor.realtime.process import RealTimeProcess, real_time_process
from executor.realtime.scheduling import Clock, SimulatedClock
from executor.realtime.shared_memory import SharedRequests
from executor.recording.record_files import free_folder
from executor.remote.command_socket import advertised, serving
from executor.remote.status import WinchStatus
from executor.state_machine import CycleRecord, LoopEvent, State
from executor.supervision import LocalRequests, RequestBoard, Supervisor
from model.errors import Fault, Refused, StoppedByOperator
from model.pose import Pose
from model.progress import Advance, Listener
from model.rig import Rig

if TYPE_CHECKING:
    from simulation.ground_truth import PowerLoss

#: Where the limit lies between the smallest and the largest tension, unless one is named.
LIMIT_SHARE = 0.6
#: Events of every motion, and one for the report of a defect alone.
_OF_COURSE = frozenset({"enabled", "moving", "held", "traceback"})

AtRest = Callable[[WinchesStand, Pose | None, RequestBoard], HomingReference | None]
"""Called after a motion that finished, with where the simulated platform is and where a stop
is wished; the drives must have held all the while before the reference that it makes is kept."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class WinchMotion:
    """A motion that is wished for.

    Attributes:
        rig: The robot and its bus.
        pose: Where its platform is about, ``world_from_platform``.
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
        make_law: From the rig as its drives count, limited, and where they stand, [counts]; it can
            be sent to another process.
        lost_power: What became of drives that are simulated in this process.
        realtime: False for simulated time.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        rehome: The drives are referenced again afterwards.
        name: Of the folder below ``runs`` where a motion on a bus is on record.
        listener: Receives progress.
        supervisor: Turns interrupts into stops.
    """

    rig: Rig
    pose: Pose
    limit: float
    speed: float
    make_law: MakeLaw
    lost_power: PowerLoss | None
    realtime: bool
    need_real_time_rights: bool
    rehome: bool
    name: str
    listener: Listener
    supervisor: Supervisor


def limit_of(rig: Rig, limit: float | None) -> float:
    """The largest tension of a motion, [N]; None for `LIMIT_SHARE` of the rig's range.

    Raises:
        Refused: It is more than the rig's own, or nothing.
    """
    if limit is None:
        return rig.min_tension + LIMIT_SHARE * (rig.max_tension - rig.min_tension)
    if not rig.min_tension < limit <= rig.max_tension:
        raise Refused(
            f"a limit of {limit:g} N is not above {rig.min_tension:g} and up to"
            f" {rig.max_tension:g} N",
            where="--limit-n",
            why="the rig file allows such tensions only",
            next_step="name another limit",
        )
    return limit


def move_by_law(motion: WinchMotion, at_rest: AtRest) -> WinchesStand:
    """Moves, in a process of its own or in simulated time; in the end drives hold by themselves.

    Args:
        motion: What is wished.
        at_rest: See `AtRest`.

    Raises:
        Fault: It ended with a fault, which is latched; with its cause.
        StoppedByOperator: The operator stopped it.
        KeyboardInterrupt: Ctrl-C stopped it; the drives hold.
        CdprError: Nothing was enabled, for the reason given.
    """
    return with_board(
        motion.rig,
        motion.supervisor,
        lambda board: _supervised(motion, board, at_rest),
        realtime=motion.realtime,
    )


def with_board(
    rig: Rig,
    supervisor: Supervisor,
    move: Callable[[LocalRequests | SharedRequests], WinchesStand],
    *,
    realtime: bool,
) -> WinchesStand:
    """Moves with a board of wishes that the supervisor can write to.

    Args:
        rig: The robot.
        supervisor: Turns interrupts into stops.
        move: Moves until the drives hold by themselves.
        realtime: The board is shared with another process.

    Raises:
        Fault: It ended with a fault, which is latched; with its cause.
        StoppedByOperator: The operator stopped it.
        KeyboardInterrupt: Ctrl-C stopped it; the drives hold.
    """
    board = SharedRequests() if realtime else LocalRequests()
    try:
        stand = supervisor.during(board, lambda: move(board))
    finally:
        if isinstance(board, SharedRequests):
            board.close()
    if stand.state in (State.STOPPED, State.FINISHED):
        supervisor.finish()
    if stand.state is State.STOPPED:
        raise StoppedByOperator("stopped; the drives hold", next_step="start again when ready")
    if stand.state is not State.FINISHED:
        raise Fault(
            stand.cause,
            where="winches",
            why="the motion was stopped, all drives together; `cdpr status RIG` shows which hold",
            next_step="find the cause; simulated drives start fresh"
            if is_simulated(rig)
            else "find the cause and look at the platform, then `cdpr reset RIG`",
        )
    return stand


def _supervised(
    motion: WinchMotion, board: LocalRequests | SharedRequests, at_rest: AtRest
) -> WinchesStand:
    """`cdpr stop` and its like reach the motion all the time."""
    rig, interlock = motion.rig, MotionInterlock(motion.rig)
    status = WinchStatus(rig, board, simulated_time=not motion.realtime)
    with ExitStack() as stack:
        listeners = stack.enter_context(advertised())
        stack.enter_context(serving(listeners, board, status))
        mover = stack.enter_context(_mover(motion, board))
        kept = stack.enter_context(
            nullcontext() if is_simulated(rig) else recording(free_folder(motion.name))
        )
        status.folder = None if kept is None else kept.folder
        advance = stack.enter_context(motion.listener.progress("moving, %", 100.0))
        stand = move_winches(
            mover,
            rig,
            interlock,
            _EventSink(status, kept, advance, motion.listener),
            record=kept.folder if kept is not None else interlock.file.path,
            rehome=motion.rehome,
            at_rest=lambda stand, true_pose: at_rest(stand, true_pose, board),
        )
        status.take_end(stand.state, stand.cause)
    return stand


def _mover(
    motion: WinchMotion, board: LocalRequests | SharedRequests
) -> AbstractContextManager[WinchMover]:
    rig = motion.rig
    return winch_mover(
        rig,
        LawMotion(rig.cable_count, rig.cycle, motion.make_law, motion.limit, motion.speed),
        partial(unreferenced_drives_of, rig.document, motion.pose, motion.limit, motion.lost_power),
        board,
        clock=SimulatedClock(rig.cycle),
        need_real_time_rights=motion.need_real_time_rights,
        listener=motion.listener,
    )


@contextmanager
def winch_mover(
    rig: Rig,
    task: MotionTask,
    make_drives: Callable[..., AbstractContextManager[ReadyDrives]],
    board: LocalRequests | SharedRequests,
    *,
    clock: Clock,
    need_real_time_rights: bool,
    listener: Listener,
) -> Iterator[WinchMover]:
    """What moves winches: in real time the drives are opened and moved in a process of its own.

    Args:
        rig: The robot and its bus.
        task: What is done with the drives.
        make_drives: Opens them; takes a `listener` where it is called in this process.
        board: Of operator requests.
        clock: In simulated time.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        listener: Receives progress.
    """
    if isinstance(board, LocalRequests):
        with make_drives(listener=listener) as drives:
            yield WinchesHere(task, drives, clock, board)
        return
    simulated = is_simulated(rig)
    if simulated:
        ready_for_simulating_process(listener)
    with real_time_process(
        task,
        make_drives,
        board,
        need_real_time=need_real_time_rights and not simulated,
        look_again=partial(left_alone, rig.document),
        listener=listener,
    ) as process:
        yield process


@dataclass(frozen=True, slots=True, eq=False)
class _EventSink:
    """Forwards what happens to the status, the listener and the record."""

    status: WinchStatus
    kept: WinchRecord | None
    advance: Advance
    listener: Listener

    def take_cycle(self, record: CycleRecord, _true_pose: Pose | None) -> None:
        self.status.take_cycle(record)
        if record.cycle % 10 == 0:
            self.advance(record.index)
        if self.kept is not None:
            self.kept.take_cycle(record)

    def take_event(self, event: LoopEvent) -> None:
        self.status.take_event(event)
        if event.code == "no_real_time":
            self.listener.remark(event.text)
        elif event.code not in _OF_COURSE:
            self.listener.note(f"{event.code}: {event.text}")
        if self.kept is not None:  # last: what a full disk does not take is told all the same
            self.kept.take_event(event)


# Release and reset of drives in the real-time process: what they mean for latch and reference.


#: By what the reference is lost where no brake holds the drums.
_RELEASED = "the drives were released by the operator, and no brake holds the cables"
_CUT_SHORT = Ended(State.LATCHED, "the program was terminated", holding=False, true_pose=None)


class Unrecorded:
    """Keeps no record of cycles in which nothing moves; see `executor.realtime.job.Records`."""

    def take_cycle(self, record: CycleRecord, true_pose: Pose | None) -> None:
        """Nothing is kept."""

    def take_event(self, event: LoopEvent) -> None:
        """Nothing is kept."""


def is_braked(rig: Rig) -> bool:
    """Every winch has a brake that closes when its drive is released."""
    return all(winch.brake for winch in rig.winches)


def release_drives(
    rig: Rig, interlock: MotionInterlock, process: RealTimeProcess, on_armed: Callable[[str], None]
) -> CycleStatus:
    """Takes the torque off; what becomes of the bus and the reference is kept.

    Args:
        rig: The robot.
        interlock: Of that rig.
        process: For `executor.control.standstill.Release`.
        on_armed: Called when all is ready, with what the system did not grant.

    Returns:
        The drives' last word, without torque.

    Raises:
        StoppedByOperator: The operator stopped it.
        CdprError: They could not be set up, or were not released; then a fault is latched.
    """
    record = interlock.file.path.parent
    armed = process.arm(Unrecorded())
    on_armed(armed.denied)
    interlock.begin(record, interlock.still_counts(armed.stands_at))
    ended = _CUT_SHORT
    try:
        ended = process.run()
        left = process.stands_now() if ended.state is State.FINISHED else None
    except BaseException:
        ended = _CUT_SHORT
        raise
    finally:
        if ended.state is not State.FINISHED:
            cause = f"while releasing the drives: {ended.cause}"
            interlock.end(State.LATCHED, cause, record, holding=False, stands_at=None)
    if left is None:
        raise ended.error or Fault(ended.cause, where="release")
    interlock.end(
        State.FINISHED,
        "",
        record,
        holding=is_braked(rig),
        stands_at=left.positions.tolist(),
        let_go=_RELEASED,
    )
    return left


@dataclass(frozen=True, slots=True, eq=False)
class DrivesReset:
    """How drives are after a reset.

    Attributes:
        left: Their last word.
        restarted: Nodes that were found without their set-up.
    """

    left: CycleStatus
    restarted: tuple[int, ...]


def reset_drives(interlock: MotionInterlock, process: RealTimeProcess) -> DrivesReset:
    """Resets drives in fault; those that hold keep holding.

    Where all held all the while, as after a program that was killed, their reference still counts
    from where they are.

    Args:
        interlock: Of their rig.
        process: For `executor.control.standstill.FaultReset`.

    Raises:
        CdprError: A drive does not answer, may not be reset now, or stays in fault.
    """
    armed: Armed = process.arm(Unrecorded())
    ended = process.run()
    if ended.state is not State.FINISHED:
        raise ended.error or Fault(ended.cause, where="reset")
    left = process.stands_now()
    if ended.holding and not armed.restarted:
        interlock.confirm_held(left.positions.tolist())
    return DrivesReset(left, armed.restarted)
