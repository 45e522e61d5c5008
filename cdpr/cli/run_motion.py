"""The moving part of `cdpr run`, `jog` and `demo`: arms, moves, measures, writes the run folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from executor.camera_process import CameraProcess
    from executor.execution import Outcome
    from executor.observer import Look
    from executor.prepare import PreparedRun
    from executor.recorder import Recorder
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
    camera_name: str | None
    fast: bool
    start: Pose | None
    without_real_time: bool
    clearance_stop: bool
    quiet: bool


def run_prepared(
    prepared: PreparedRun,
    output: Path,
    camera_name: str | None,
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
        camera_name: From `choose_camera`.
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
    job = _Job(prepared, folder, camera_name, fast, start, without_real_time, clearance_stop, quiet)
    moved = False

    def before_motion() -> None:
        nonlocal moved
        moved = True

    try:
        folder.write_plan(prepared.plan.plan.document)
        folder.write_rig(prepared.rig.document)
        outcome, looks = _move_and_look(job, before_motion)
    finally:
        if not moved:
            folder.discard()
    interface = prepared.rig.document.bus.interface
    with spinner("writing the run folder and its report", not quiet):
        return conclude(
            prepared,
            outcome,
            folder,
            looks,
            interface=interface,
            simulated=interface == IN_PROCESS,
            fast=fast,
        )


def _move_and_look(job: _Job, before_motion: Callable[[], None]) -> tuple[Outcome, list[Look]]:
    """The motion and its pictures; `cdpr stop` and its like reach the run all the time."""
    from contextlib import ExitStack

    from rich.markup import escape

    from cdpr.cli.cameras import open_camera
    from cdpr.cli.output import err, progress_bar
    from executor.command_server import serving
    from executor.recorder import Recorder
    from executor.records import LoopEvent
    from executor.running import announced, stop_requests
    from executor.shared_board import SharedBoard
    from executor.status import RunStatus
    from executor.wishes import OwnBoard

    prepared = job.prepared
    rows, cycle = len(prepared.checked.table), prepared.checked.table.cycle
    rate = prepared.rig.cameras[0].rate if job.camera_name else PROGRESS_RATE
    pictures = int(prepared.duration * rate)
    board: OwnBoard | SharedBoard = OwnBoard() if job.fast else SharedBoard()
    status = RunStatus(prepared, job.folder.path, board, simulated_time=job.fast)
    camera_at = (prepared.rig, prepared.scene, job.camera_name, job.folder.path)
    with (
        ExitStack() as stack,
        stop_requests(board),
        announced() as listeners,
        serving(listeners, board, status),
        open_camera(*camera_at, pictures, job.fast) as camera,
    ):
        if isinstance(board, SharedBoard):
            stack.callback(board.close)
        with progress_bar("moving", rows, not job.quiet) as advance:
            told = ""

            def picture(time: float, asked: float, true_pose: Pose | None) -> None:
                nonlocal told
                assert camera is not None
                camera.trigger(time, asked, true_pose)
                if camera.near and job.clearance_stop and not board.read().stop:
                    board.ask_stop(too_near=camera.near)
                    err.print(f"[red]too near[/] {escape(camera.near)}", soft_wrap=True)
                if camera.trouble and not told:
                    recorder.take_event(LoopEvent(0, asked, "camera_sees_nothing", camera.trouble))
                    err.print(f"[yellow]remark[/] {camera.trouble}", soft_wrap=True)
                told = camera.trouble

            recorder = Recorder(
                prepared,
                job.folder,
                status,
                trigger=picture if camera else None,
                every=max(1, round(1.0 / (rate * cycle))),
                progress=advance,
                announce=lambda text: None if job.quiet else err.print(text, markup=False),
            )
            outcome = _move(job, board, recorder, before_motion)
            status.take_end(outcome.state, outcome.cause)
        return outcome, _looks(camera, recorder, job) if camera else []


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
    from cdpr.cli.drives import open_drives
    from cdpr.errors import StoppedByOperator
    from executor.clock import SimulatedClock
    from executor.execution import run_here

    def last_chance() -> None:
        if board.read().stop:
            raise StoppedByOperator("stopped before anything moved")
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
    from executor.real_time_process import run_in_real_time
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


def _looks(camera: CameraProcess, recorder: Recorder, job: _Job) -> list[Look]:
    """What the camera saw; when it failed, that it did, for every picture."""
    from cdpr.cli.output import progress_bar
    from cdpr.errors import CdprError
    from executor.observer import unseen
    from executor.run_folder import RunEvent

    asked = recorder.asked
    last = asked[-1] if asked else 0.0
    with progress_bar("measuring pictures", camera.triggered, not job.quiet) as advance:
        try:
            looks = camera.finish(advance)
        except CdprError as error:  # the motion is over; without pictures the run is still a record
            job.folder.append_event(RunEvent(last, "camera", error.what))
            return [unseen(k, time, error.what) for k, time in enumerate(asked)]
    if camera.dropped:
        told = f"{camera.dropped} of {len(asked)} pictures left out: the one before was not done"
        job.folder.append_event(RunEvent(last, "pictures_dropped", told))
    return looks
