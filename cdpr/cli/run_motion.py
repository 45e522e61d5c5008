"""The moving part of `cdpr run`, `jog` and `demo`: arms, moves, measures, writes the run folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cdpr.poses import Pose
    from cdpr.rig import Camera
    from executor.execution import Outcome
    from executor.prepare import PreparedRun
    from executor.recorder import Recorder
    from executor.run_cameras import Seen
    from executor.run_folder import RunFolder
    from executor.shared_board import SharedBoard
    from executor.wishes import OwnBoard


#: Without a camera the progress is told this often, [Hz].
PROGRESS_RATE = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """One run and how it is to be done."""

    prepared: PreparedRun
    folder: RunFolder
    eyes: Mapping[Camera, str]
    fast: bool
    start: Pose | None
    without_real_time: bool
    clearance_stop: bool
    quiet: bool


def run_prepared(
    prepared: PreparedRun,
    output: Path,
    eyes: Mapping[Camera, str],
    *,
    fast: bool,
    start: Pose | None,
    without_real_time: bool,
    clearance_stop: bool = True,
    quiet: bool,
) -> dict[str, Any]:
    """Arms, moves, measures and writes the run folder; returns the run's summary.

    A run that is refused before anything moved leaves no folder.

    Args:
        prepared: The checked run.
        output: The run folder to make.
        eyes: From `choose_cameras`; empty for none.
        fast: Simulated time.
        start: Where the simulated platform stands; None at the plan's start.
        without_real_time: Move drives on a bus even if real-time scheduling is denied.
        clearance_stop: Stop along the path when the camera sees too little clearance.
        quiet: No progress.
    """
    from cdpr.cli.output import spinner
    from drivers.bus import IN_PROCESS
    from executor.run import conclude
    from executor.run_folder import RunFolder

    folder = RunFolder.create(output)
    job = _Job(prepared, folder, eyes, fast, start, without_real_time, clearance_stop, quiet)
    moved = False

    def before_motion() -> None:
        nonlocal moved
        moved = True

    try:
        folder.write_plan(prepared.plan.plan.document)
        folder.write_rig(prepared.rig.document)
        outcome, seen = _move_and_look(job, before_motion)
    finally:
        if not moved:
            folder.discard()
    interface = prepared.rig.document.bus.interface
    with spinner("writing the run folder and its report", not quiet):
        return conclude(
            prepared,
            outcome,
            folder,
            seen,
            interface=interface,
            simulated=interface == IN_PROCESS,
            fast=fast,
        )


def _move_and_look(job: _Job, before_motion: Callable[[], None]) -> tuple[Outcome, Seen]:
    """The motion and its pictures; `cdpr stop` and its like reach the run all the time."""
    from contextlib import ExitStack
    from functools import partial

    from cdpr.cli.cameras import asked_rate, open_cameras
    from cdpr.cli.output import err, progress_bar
    from cdpr.cli.run_watch import RunWatch
    from executor.command_server import serving
    from executor.recorder import Recorder
    from executor.records import LoopEvent
    from executor.run_cameras import Seen
    from executor.running import announced, stop_requests
    from executor.shared_board import SharedBoard
    from executor.status import RunStatus
    from executor.wishes import OwnBoard

    prepared = job.prepared
    rows, cycle = len(prepared.checked.table), prepared.checked.table.cycle
    rate = asked_rate(job.eyes) if job.eyes else PROGRESS_RATE
    pictures = int(prepared.duration * rate)
    board: OwnBoard | SharedBoard = OwnBoard() if job.fast else SharedBoard()
    status = RunStatus(prepared, job.folder.path, board, simulated_time=job.fast)
    opening = partial(
        open_cameras, prepared.rig, prepared.scene, job.eyes, job.folder.path, pictures, board
    )
    with (
        ExitStack() as stack,
        stop_requests(board),
        announced() as listeners,
        serving(listeners, board, status),
        opening(simulated_time=job.fast, quiet=job.quiet) as cameras,
    ):
        if isinstance(board, SharedBoard):
            stack.callback(board.close)
        with progress_bar("moving", rows, not job.quiet) as advance:

            def tell(code: str, text: str, at: float) -> None:
                recorder.take_event(LoopEvent(0, at, code, text))

            stops = job.clearance_stop
            watch = (
                RunWatch(cameras, status, board, tell, clearance_stop=stops) if cameras else None
            )
            recorder = Recorder(
                prepared,
                job.folder,
                status,
                trigger=watch.trigger if watch else None,
                every=max(1, round(1.0 / (rate * cycle))),
                progress=lambda row: advance(row, watch.rates if watch else ""),
                announce=lambda text: None if job.quiet else err.print(text, markup=False),
            )
            outcome = _move(job, board, recorder, before_motion)
            status.take_end(outcome.state, outcome.cause)
        return outcome, watch.finish(recorder.last, job.quiet) if watch else Seen()


def _move(
    job: _Job,
    board: OwnBoard | SharedBoard,
    recorder: Recorder,
    before_motion: Callable[[], None],
) -> Outcome:
    """Arms the drives and runs the loop: here in simulated time, else in a process of its own."""
    from executor.shared_board import SharedBoard

    if isinstance(board, SharedBoard):
        return _move_in_real_time(job, board, recorder, before_motion)
    from cdpr.cli.cameras import require_no_stop
    from cdpr.cli.drives import open_drives
    from executor.clock import SimulatedClock
    from executor.execution import run_here

    def last_chance() -> None:
        require_no_stop(board)
        before_motion()

    prepared = job.prepared
    start, load = job.start or prepared.scene.start, prepared.scene.load
    with open_drives(prepared.rig, start, load) as drives:
        return run_here(
            prepared,
            drives.group,
            SimulatedClock(prepared.checked.table.cycle),
            board,
            recorder,
            true_pose=drives.true_pose,
            carry=drives.carry,
            before_motion=last_chance,
        )


def _move_in_real_time(
    job: _Job, board: SharedBoard, recorder: Recorder, before_motion: Callable[[], None]
) -> Outcome:
    from functools import partial

    from rich.markup import escape

    from cdpr.cli.drives import drives_of
    from cdpr.cli.output import err
    from drivers.bus import IN_PROCESS
    from executor.path_in_real_time import run_in_real_time
    from executor.records import LoopEvent

    def armed(denied: str) -> None:
        if denied:
            recorder.take_event(LoopEvent(0, 0.0, "no_real_time", denied))
            err.print(f"[yellow]remark[/] {escape(denied)}", soft_wrap=True)
        before_motion()

    prepared = job.prepared
    simulated = prepared.rig.document.bus.interface == IN_PROCESS
    start, load = job.start or prepared.scene.start, prepared.scene.load
    return run_in_real_time(
        prepared,
        partial(drives_of, prepared.rig.document, start, load),
        board,
        recorder,
        pose_every=recorder.every if simulated else 0,
        need_real_time=not (simulated or job.without_real_time),
        before_motion=armed,
    )
