"""Moves winches without a path: what `cdpr home` and `cdpr jog --cable` have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from executor.records import CycleRecord, LoopEvent
    from executor.reference import ReferenceDocument
    from executor.shared_board import SharedBoard
    from executor.status import WinchStatus
    from executor.winch_motion import WinchesStand
    from executor.winch_mover import MakeLaw, WinchMover
    from executor.winch_record import WinchRecord
    from executor.wishes import OwnBoard, WishBoard
    from simulation.power_loss import PowerLoss

#: Where the limit lies between the smallest and the largest tension, unless one is named.
LIMIT_SHARE = 0.6
#: Events of every motion, and one for the report of a defect alone.
_OF_COURSE = frozenset({"enabled", "moving", "held", "traceback"})


@dataclass(frozen=True, slots=True, eq=False)
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
        fast: Simulated time.
        without_real_time: Move even if real-time scheduling is denied.
        quiet: No progress.
        anew: The drives are referenced again afterwards.
        name: Of the folder below ``runs`` where a motion on a bus is on record.
    """

    rig: Rig
    pose: Pose
    limit: float
    speed: float
    make_law: MakeLaw
    lost_power: PowerLoss | None
    fast: bool
    without_real_time: bool
    quiet: bool
    anew: bool
    name: str


def limit_of(rig: Rig, limit_n: float | None) -> float:
    """The largest tension of the motion, [N].

    Raises:
        Refused: It is more than the rig's own, or nothing.
    """
    from cdpr.errors import Refused

    if limit_n is None:
        return rig.min_tension + LIMIT_SHARE * (rig.max_tension - rig.min_tension)
    if not rig.min_tension < limit_n <= rig.max_tension:
        raise Refused(
            f"a limit of {limit_n:g} N is not above {rig.min_tension:g} and up to"
            f" {rig.max_tension:g} N",
            where="--limit-n",
            why="the rig file allows such tensions only",
            next_step="name another limit",
        )
    return limit_n


def speed_of(rig: Rig, speed_mm_s: float) -> float:
    """The wished speed of the winches, where the rig allows it, [m/s]."""
    return min(speed_mm_s / 1000.0, rig.motion.speed)


def carry_out_by_law(
    motion: WinchMotion,
    at_rest: Callable[[WinchesStand, Pose | None, WishBoard], ReferenceDocument | None],
) -> WinchesStand:
    """Moves, in a process of its own or in simulated time; in the end drives hold by themselves.

    Args:
        motion: What is wished.
        at_rest: Called after a motion that came to its end, with where the simulated platform is;
            the drives must have held all the while before the reference that it makes is kept.

    Raises:
        Fault: It ended with a fault, which is latched; with its cause.
        StoppedByOperator: The operator stopped it.
        CdprError: Nothing was enabled, for the reason told.
    """
    from contextlib import ExitStack, nullcontext

    from cdpr.cli.output import progress_bar
    from cdpr.cli.run_folders import free_folder
    from cdpr.errors import Fault, StoppedByOperator
    from drivers.bus import IN_PROCESS
    from executor.command_server import serving
    from executor.custody import Custody
    from executor.machine import State
    from executor.running import announced, stop_requests
    from executor.shared_board import SharedBoard
    from executor.status import WinchStatus
    from executor.winch_motion import move_winches
    from executor.winch_record import recording
    from executor.wishes import OwnBoard

    rig, custody = motion.rig, Custody(motion.rig)
    in_process = rig.document.bus.interface == IN_PROCESS
    board: OwnBoard | SharedBoard = OwnBoard() if motion.fast else SharedBoard()
    status = WinchStatus(rig, board, simulated_time=motion.fast)
    with ExitStack() as stack:
        if isinstance(board, SharedBoard):
            stack.callback(board.close)
        stack.enter_context(stop_requests(board))
        listeners = stack.enter_context(announced())
        stack.enter_context(serving(listeners, board, status))
        mover = stack.enter_context(_mover(motion, board))
        kept = stack.enter_context(
            nullcontext() if in_process else recording(free_folder(motion.name))
        )
        status.folder = None if kept is None else kept.folder
        advance = stack.enter_context(progress_bar("moving, %", 100.0, not motion.quiet))
        stand = move_winches(
            mover,
            rig,
            custody,
            _Told(status, kept, advance, motion.quiet),
            record=kept.folder if kept is not None else custody.file.path,
            anew=motion.anew,
            at_rest=lambda stand, true_pose: at_rest(stand, true_pose, board),
        )
        status.take_end(stand.state, stand.cause)
    if stand.state is State.STOPPED:
        raise StoppedByOperator("stopped; the drives hold", next_step="begin anew when all is well")
    if stand.state is not State.FINISHED:
        raise Fault(
            stand.cause,
            where="winches",
            why="the motion was stopped, all drives together; they hold",
            next_step="find the cause; simulated drives begin anew"
            if in_process
            else "find the cause and look at the platform, then `cdpr reset RIG`",
        )
    return stand


@contextmanager
def _mover(motion: WinchMotion, board: OwnBoard | SharedBoard) -> Iterator[WinchMover]:
    """In real time the drives are opened and moved in a process of its own."""
    from functools import partial

    from cdpr.cli.drives import unreferenced_drives_of
    from drivers.bus import IN_PROCESS
    from executor.clock import SimulatedClock
    from executor.real_time_process import real_time_process
    from executor.shared_board import SharedBoard
    from executor.winch_mover import LawMotion, WinchesHere

    document = motion.rig.document
    cycle = document.bus.cycle_ms / 1000.0
    law = LawMotion(motion.rig.cable_count, cycle, motion.make_law, motion.limit, motion.speed)
    make_drives = partial(
        unreferenced_drives_of, document, motion.pose, motion.limit, motion.lost_power
    )
    if isinstance(board, SharedBoard):
        needed = document.bus.interface != IN_PROCESS and not motion.without_real_time
        with real_time_process(law, make_drives, board, need_real_time=needed) as process:
            yield process
    else:
        with make_drives() as drives:
            yield WinchesHere(law, drives, SimulatedClock(cycle), board)


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """Takes in what happens: for those who ask, for the record, and for who looks on."""

    status: WinchStatus
    kept: WinchRecord | None
    advance: Callable[[float], None]
    quiet: bool

    def take_cycle(self, record: CycleRecord, _true_pose: Pose | None) -> None:
        self.status.take_cycle(record)
        if self.kept is not None:
            self.kept.take_cycle(record)
        if record.cycle % 10 == 0:
            self.advance(record.index)

    def take_event(self, event: LoopEvent) -> None:
        from cdpr.cli.output import err

        self.status.take_event(event)
        if self.kept is not None:
            self.kept.take_event(event)
        if event.code == "no_real_time":
            err.print(f"[yellow]remark[/] {event.text}", soft_wrap=True)
        elif not (self.quiet or event.code in _OF_COURSE):
            err.print(f"{event.code}: {event.text}", markup=False, soft_wrap=True)
