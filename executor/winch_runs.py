"""Where a motion runs, and motions without a planned path: homing, jogging, jog sessions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from executor.control.winch_loop import LawMotion, MakeLaw
from executor.control.winch_motion import (
    AtRest,
    WinchRecord,
    WinchResult,
    move_winches,
    nothing_at_rest,
    recording,
)
from executor.drives import abandoned_drives_fault, is_simulated, unreferenced_drives_of
from executor.hold_to_run.presses import PressBoard
from executor.interlock.fault_latch import AFTER_A_FAULT
from executor.interlock.interlock import MotionInterlock
from executor.kernels import ready_to_simulate
from executor.realtime.child import MotionTask, ReadyDrives
from executor.realtime.process import MotionHere, Mover, real_time_process
from executor.realtime.scheduling import Clock, SimulatedClock
from executor.realtime.shared_memory import SharedRequests
from executor.recording.record_files import free_folder
from executor.recording.run_folder import RunFolder
from executor.remote.command_server import Commands
from executor.remote.status import WinchStatus
from executor.state_machine import REMARK, CycleRecord, LoopEvent, State
from executor.supervision import Callbacks, GuardedListener, LocalRequests
from model.errors import Fault, Refused, StoppedByOperator, path_of, real_number
from model.pose import Pose
from model.progress import Listener
from model.rig import Rig

if TYPE_CHECKING:
    from simulation.ground_truth import PowerLoss

#: Default tension limit, as a share of the range from smallest to largest tension.
LIMIT_SHARE = 0.6
#: Events of every motion, one for defect reports, and one that the listener gets as a remark.
_UNREPORTED = frozenset({"enabled", "moving", "held", "traceback", REMARK})


def limit_of(rig: Rig, limit: float | None) -> float:
    """The largest tension of a motion, [N]; None for `LIMIT_SHARE` of the rig's range.

    Raises:
        Refused: It is outside the rig's range.
    """
    if limit is None:
        return rig.min_tension + LIMIT_SHARE * (rig.max_tension - rig.min_tension)
    limit = real_number("limit", limit, "N")
    if not rig.min_tension < limit <= rig.max_tension:
        raise Refused(
            f"the tension limit of {limit:g} N is not above {rig.min_tension:g} N and at most"
            f" {rig.max_tension:g} N",
            where="`limit=`",
            why="that is the range of tensions in the rig file",
            next_step="choose a limit in this range",
        )
    return limit


def record_folder(rig: Rig, folder: Path | str | None, name: str) -> Callable[[], Path] | None:
    """Names the record folder of a motion when called, after its preparation; None for no record.

    Args:
        rig: The robot and its bus.
        folder: Which does not exist yet; None for ``runs/NAME``, with the first number that is free
            then, except with simulated drives, which leave no record.
        name: For None.

    Raises:
        BadInput: It could not be created now.
    """
    if folder is None:
        return None if is_simulated(rig) else partial(free_folder, name)
    RunFolder.require_free(given := path_of(folder))
    return lambda: given


def move_by_law(
    rig: Rig,
    commands: Commands,
    make_law: MakeLaw,
    make_folder: Callable[[], Path] | None,
    *,
    pose: Pose,
    limit: float,
    speed: float,
    realtime: bool,
    need_real_time_rights: bool,
    listener: Listener,
    lost_power: PowerLoss | None = None,
    rehome: bool = False,
    at_rest: AtRest = nothing_at_rest,
) -> WinchResult:
    """Moves, in the real-time process or in simulated time; ends with the drives holding.

    Args:
        rig: The robot and its bus.
        commands: Those taken since the start of the verb.
        make_law: See `MakeLaw`; picklable.
        make_folder: See `record_folder`.
        pose: Approximate pose of its platform, ``world_from_platform``.
        limit: Largest tension, [N].
        speed: Fastest winch, [m/s].
        realtime: False for simulated time.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        lost_power: Effect of a power loss on simulated drives.
        rehome: The drives are referenced again afterwards.
        at_rest: See `AtRest`.

    Raises:
        Fault: It ended with a fault, which is latched; with its cause. Or a function of the
            listener raised an exception, which stopped it.
        StoppedByOperator: The operator stopped it.
        KeyboardInterrupt: Ctrl-C stopped it, as does another signal handler's exception; the
            drives hold.
        CdprError: Nothing was enabled.
    """
    callbacks = Callbacks(commands.board.ask_stop)

    def move() -> WinchResult:
        return move_supervised(
            rig,
            commands,
            LawMotion(rig.cable_count, rig.cycle, make_law, limit, speed),
            partial(unreferenced_drives_of, rig.document, pose, limit, lost_power),
            WinchStatus(rig, commands.board, simulated_time=not realtime),
            make_folder,
            clock=SimulatedClock(rig.cycle),
            need_real_time_rights=need_real_time_rights,
            listener=listener,
            callbacks=callbacks,
            showing=_progress(GuardedListener(listener, callbacks)),
            rehome=rehome,
            at_rest=at_rest,
        )

    stored = ", and the reference is stored" if rehome else ""
    return supervised(rig, commands, move, callbacks, stored=stored)


def supervised(
    rig: Rig,
    commands: Commands,
    move: Callable[[], WinchResult],
    callbacks: Callbacks,
    *,
    stored: str = "",
) -> WinchResult:
    """Moves while the supervisor can request a stop.

    Args:
        commands: Those taken since the start of the verb.
        move: Moves until the drives hold on their own.
        callbacks: Functions of the caller that it calls.
        stored: What is stored once it has finished, as a clause.

    Raises:
        Fault: It ended with a fault, which is latched, with its cause; or one of ``callbacks``
            raised an exception, which stopped it.
        StoppedByOperator: The operator stopped it.
        SystemExit: Raised by one of ``callbacks``, as `KeyboardInterrupt` may be.
        KeyboardInterrupt: Ctrl-C stopped it, as does another signal handler's exception; the
            drives hold.
    """
    supervisor = commands.supervisor
    commands.require_no_stop()
    try:
        result = supervisor.during(commands.board, move)
    except StoppedByOperator:  # after the motion, such as while the platform is measured
        _raise_failure(callbacks, "was stopped")
        raise
    if result.state in (State.STOPPED, State.FINISHED):
        supervisor.finish()
        how = "was stopped" if result.state is State.STOPPED else f"had finished{stored}"
        _raise_failure(callbacks, how)
    if result.state is State.STOPPED:
        raise StoppedByOperator("stopped; the drives hold", next_step="start again when ready")
    if result.state is not State.FINISHED:
        why = "the motion was stopped, all drives together"
        next_step = "find the cause, then begin again: the simulated drives ended with the motion"
        if not is_simulated(rig):
            why += "; `cdpr status RIG` shows which hold"
            next_step = AFTER_A_FAULT
        raise Fault(result.cause, where="winches", why=why, next_step=next_step)
    return result


def _raise_failure(callbacks: Callbacks, how: str) -> None:
    """Raises what a function of the caller raised, and how the motion ended."""
    callbacks.leave()
    if callbacks.error:
        why, next_step = f"the motion {how}; the drives hold", "correct this function"
        error = Fault(callbacks.error, where="winches", why=why, next_step=next_step)
        raise error from callbacks.cause


@contextmanager
def open_mover(
    rig: Rig,
    task: MotionTask,
    make_drives: Callable[..., AbstractContextManager[ReadyDrives]],
    board: LocalRequests | SharedRequests,
    clock: Clock,
    *,
    need_real_time_rights: bool,
    listener: Listener,
    after_stop: str = "",
) -> Iterator[Mover]:
    """Opens the drives of a motion: here in simulated time, else in the real-time process.

    Args:
        task: The motion, which is closed.
        make_drives: Opens them; takes a `listener` where it is called in this process.
        board: Local in simulated time.
        clock: Of simulated time.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        after_stop: As for `MotionHere`.
    """
    with closing(task):
        if isinstance(board, LocalRequests):
            with make_drives(listener=listener) as drives:
                yield MotionHere(task, drives, clock, board, after_stop)
            return
        if simulated := is_simulated(rig):
            ready_to_simulate(listener, only_missing=True)
        with real_time_process(
            task,
            make_drives,
            board,
            need_real_time=need_real_time_rights and not simulated,
            check_drives=partial(abandoned_drives_fault, rig.document),
            listener=listener,
        ) as process:
            yield process


@contextmanager
def _progress(listener: Listener) -> Iterator[Callable[[CycleRecord], None]]:
    """Shows the progress of a law, which is the record's index."""
    with listener.progress("moving, %", 100.0) as advance:

        def take(record: CycleRecord) -> None:
            if record.cycle % 10 == 0:
                advance(record.index)

        yield take


def move_supervised(
    rig: Rig,
    commands: Commands,
    task: MotionTask,
    make_drives: Callable[..., AbstractContextManager[ReadyDrives]],
    status: WinchStatus,
    make_folder: Callable[[], Path] | None,
    *,
    clock: Clock,
    need_real_time_rights: bool,
    listener: Listener,
    callbacks: Callbacks,
    showing: AbstractContextManager[Callable[[CycleRecord], None]],
    presses: PressBoard | None = None,
    unreported: Collection[str] = _UNREPORTED,
    rehome: bool = False,
    at_rest: AtRest = nothing_at_rest,
) -> WinchResult:
    """Moves while the command socket accepts requests such as `cdpr stop`, and records it.

    Args:
        commands: Those taken since the start of the verb.
        make_drives: See `open_mover`.
        status: Answers on the command socket.
        make_folder: See `record_folder`.
        callbacks: Of the listener while drives are enabled.
        showing: Called after every cycle, before the status.
        presses: Where the command socket writes held controls.
        unreported: Codes of events that the listener does not get.
        rehome: The drives are referenced again afterwards.
        at_rest: See `AtRest`.
    """
    interlock = MotionInterlock(rig)
    with ExitStack() as stack:
        stack.enter_context(commands.during_motion(status, presses))
        moving = stack.enter_context(
            open_mover(
                rig,
                task,
                make_drives,
                commands.board,
                clock,
                need_real_time_rights=need_real_time_rights,
                listener=listener,
            )
        )
        log = stack.enter_context(recording(make_folder()) if make_folder else nullcontext())
        if log is not None:
            status.take_folder(log.folder)
        result = move_winches(
            moving,
            rig,
            interlock,
            _Records(
                status,
                log,
                stack.enter_context(showing),
                GuardedListener(listener, callbacks),
                listener.remark,
                unreported,
            ),
            record=log.folder if log is not None else interlock.file.path,
            rehome=rehome,
            at_rest=at_rest,
        )
        status.take_end(result.state, result.cause)
    return result if log is None else replace(result, folder=log.folder.absolute())


@dataclass(frozen=True, slots=True, eq=False)
class _Records:
    """Forwards cycles and events to the status, the listener and the record.

    ``remark`` may raise: it is called before the drives are enabled.
    """

    status: WinchStatus
    log: WinchRecord | None
    show: Callable[[CycleRecord], None]
    listener: Listener
    remark: Callable[[str], None]
    unreported: Collection[str]

    def take_cycle(self, record: CycleRecord, _true_pose: Pose | None) -> None:
        self.show(record)
        self.status.take_cycle(record)
        if self.log is not None:
            self.log.take_cycle(record)

    def take_event(self, event: LoopEvent) -> None:
        self.status.take_event(event)
        if event.code == "no_real_time":
            self.remark(event.text)
        elif event.code not in self.unreported:
            self.listener.note(f"{event.code}: {event.text}")
        if self.log is not None:  # last: a full disk must not prevent the report
            self.log.take_event(event)
