"""Moves winches without a path: what `cdpr home` and `cdpr jog --cable` have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from drivers.drive_group import CycleStatus
    from executor.real_time_job import ReadyDrives
    from executor.records import CycleRecord, LoopEvent
    from executor.reference import ReferenceDocument
    from executor.status import WinchStatus
    from executor.winch_laws import WinchLaw
    from executor.winch_motion import WinchesStand
    from executor.wishes import WishBoard
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
        make_law: From the rig as its drives count, limited, and where they stand, [counts].
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
    make_law: Callable[[Rig, Sequence[int]], WinchLaw]
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
    at_rest: Callable[[WinchesStand, ReadyDrives, WishBoard], ReferenceDocument | None],
) -> WinchesStand:
    """Moves, in this process; ends with the drives holding by themselves.

    Args:
        motion: What is wished.
        at_rest: Called after a motion that came to its end, while the drives are still there; they
            must have held all the while before the reference that it makes is kept.

    Raises:
        Fault: It ended with a fault, which is latched; with its cause.
        StoppedByOperator: The operator stopped it.
        CdprError: Nothing was enabled, for the reason told.
    """
    from cdpr.cli.drives import open_drives
    from cdpr.errors import Fault, StoppedByOperator
    from cdpr.scene import nothing_in_the_way
    from drivers.bus import IN_PROCESS
    from executor.command_server import serving
    from executor.machine import State
    from executor.running import announced, stop_requests
    from executor.status import WinchStatus
    from executor.winch_motion import careful, counted_here, require_below, require_held
    from executor.wishes import OwnBoard

    rig = motion.rig
    limited: list[tuple[Rig, list[int]]] = []

    def set_up_as(told: CycleStatus) -> tuple[Rig, float]:
        require_below(rig, told, motion.limit)
        counts = told.positions.tolist()
        counted = counted_here(rig, counts, motion.pose)
        limited.append((careful(counted, limit=motion.limit, speed=motion.speed), counts))
        return counted, motion.limit

    board = OwnBoard()
    status = WinchStatus(rig, board, simulated_time=motion.fast)
    load = nothing_in_the_way(rig).load
    with (
        stop_requests(board),
        announced() as listeners,
        serving(listeners, board, status),
        open_drives(
            rig, motion.pose, load, lost_power=motion.lost_power, set_up_as=set_up_as
        ) as drives,
    ):
        as_set_up, counts = limited[0]
        law = motion.make_law(as_set_up, counts)

        def settled(stand: WinchesStand) -> ReferenceDocument | None:
            reference = at_rest(stand, drives, board)
            require_held(rig, stand, drives.group.read_positions())
            return reference

        stand = _moved(motion, as_set_up, law, drives, board, status, settled)
        status.take_end(stand.state, stand.cause)
    if stand.state is State.STOPPED:
        raise StoppedByOperator("stopped; the drives hold", next_step="begin anew when all is well")
    if stand.state is not State.FINISHED:
        raise Fault(
            stand.cause,
            where="winches",
            why="the motion was stopped, all drives together; they hold",
            next_step="find the cause and look at the platform, then `cdpr reset RIG`"
            if rig.document.bus.interface != IN_PROCESS
            else "find the cause; simulated drives begin anew",
        )
    return stand


def _moved(
    motion: WinchMotion,
    rig: Rig,
    law: WinchLaw,
    drives: ReadyDrives,
    board: WishBoard,
    status: WinchStatus,
    settled: Callable[[WinchesStand], ReferenceDocument | None],
) -> WinchesStand:
    from contextlib import nullcontext

    from cdpr.cli.output import err, progress_bar
    from cdpr.cli.run_folders import free_folder
    from drivers.bus import IN_PROCESS
    from executor.clock import RealClock, SimulatedClock
    from executor.custody import Custody
    from executor.realtime import real_time, require_real_time
    from executor.winch_motion import move_winches
    from executor.winch_record import recording

    cycle, custody = rig.document.bus.cycle_ms / 1000.0, Custody(motion.rig)
    simulated = rig.document.bus.interface == IN_PROCESS
    with (
        nullcontext("") if motion.fast else real_time() as denied,
        nullcontext() if simulated else recording(free_folder(motion.name)) as kept,
        progress_bar("moving, %", 100.0, not motion.quiet) as advance,
    ):
        status.folder = None if kept is None else kept.folder
        require_real_time(denied, needed=not (simulated or motion.without_real_time))
        if denied:
            err.print(f"[yellow]remark[/] {denied}", soft_wrap=True)

        def on_cycle(record: CycleRecord) -> None:
            status.take_cycle(record, law.progress)
            if kept is not None:
                kept.take_cycle(record)
            if record.cycle % 10 == 0:
                advance(100.0 * law.progress)

        def on_event(event: LoopEvent) -> None:
            status.take_event(event)
            if kept is not None:
                kept.take_event(event)
            if not (motion.quiet or event.code in _OF_COURSE):
                err.print(f"{event.code}: {event.text}", markup=False, soft_wrap=True)

        return move_winches(
            rig,
            law,
            drives.group,
            SimulatedClock(cycle) if motion.fast else RealClock(cycle),
            board,
            custody,
            record=kept.folder if kept is not None else custody.file.path,
            anew=motion.anew,
            at_rest=settled,
            on_cycle=on_cycle,
            on_event=on_event,
        )
