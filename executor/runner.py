"""Runs a plan: checks it, arms the drives, moves, measures, computes the verdict, writes files.

Once the platform has moved, the verdict depends only on the motion: neither a file that
cannot be written nor an interrupt while the report is made changes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from executor.cameras.multi_camera import CameraRecords, CameraWatch
from executor.cameras.open import asked_rate, open_cameras
from executor.cameras.sources import (
    CameraChoice,
    cycles_per_image,
    require_synthetic_images,
    resolve_cameras,
)
from executor.control.path_runs import Outcome, PathMotion, run_along_path
from executor.drives import drives_of, is_simulated, require_drives, require_simulated_start
from executor.evaluation import EvaluatedRun, evaluate, not_evaluated, write_end
from executor.interlock.interlock import MotionInterlock
from executor.proposals import Proposal, motion_proposal, require_confirmed
from executor.realtime.process import Mover
from executor.realtime.scheduling import SimulatedClock
from executor.recording.record_files import RunCourse, dated_name
from executor.recording.recorder import Recorder
from executor.recording.run_folder import REPORT, RunEvent, RunFolder
from executor.recording.summary import versions
from executor.recording.tables import require_readable_record
from executor.remote.command_server import Commands, commands_from_start
from executor.remote.status import RunStatus
from executor.run_result import RunResult, folder_maker
from executor.state_machine import LoopEvent, State
from executor.supervision import Callbacks, GuardedListener, Supervisor
from executor.trajectory.setpoints import PreparedRun, prepare_plan
from executor.winch_runs import open_mover
from model.errors import (
    CdprError,
    StoppedByOperator,
    require_functions,
    require_types,
    truth_value,
)
from model.plan import Plan, require_same_rig
from model.pose import Pose
from model.progress import SILENT, Listener
from model.rig import Camera, Rig
from tracking.clearance import require_stated_errors

__all__ = ["RunOptions", "RunResult", "run", "run_prepared"]

_PASS_THE_RIG = "; then plan again, or pass `rig=`: a plan contains its rig"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RunOptions:
    """Options of a run; see `run`."""

    realtime: bool = True
    start: Pose | None = None
    clearance_stop: bool = True
    need_real_time_rights: bool = True
    listener: Listener = SILENT
    confirm: Callable[[Proposal], bool] | None = None
    on_event: Callable[[RunEvent], None] | None = None


def run(
    plan: Plan,
    rig: Rig,
    *,
    folder: Path | str | None = None,
    cameras: CameraChoice = None,
    realtime: bool = True,
    start: Pose | None = None,
    clearance_stop: bool = True,
    need_real_time_rights: bool = True,
    listener: Listener = SILENT,
    confirm: Callable[[Proposal], bool] | None = None,
    on_event: Callable[[RunEvent], None] | None = None,
    supervisor: Supervisor | None = None,
    plan_file: Path | str = "plan",
) -> RunResult:
    """Checks a plan, computes its set-points, arms the drives, moves, measures and reports.

    On the interface ``virtual`` drives, platform and camera are simulated in this process. `cdpr
    stop` and, in the main thread, Ctrl-C and any other exception of a signal handler stop all
    drives together along the path, which then hold.

    Args:
        plan: The plan.
        rig: The robot, and the bus of its drives.
        folder: Run folder to create; None for a dated one in ``runs``.
        cameras: Those that measure the platform: a source (index, device file or address), several
            by name as ``{"front": 0}`` or ``["front=0"]``, ``"synthetic"``, or ``[]`` for none;
            None for all of the rig file, synthetic on ``virtual``, an error on a bus.
        realtime: False for simulated time, as fast as possible.
        start: Pose of the simulated platform, ``world_from_platform``; None for the plan's start.
        clearance_stop: Stop along the path when the cameras measure too small a clearance.
        need_real_time_rights: Refuse to move drives on a bus without real-time scheduling.
        listener: Receives progress.
        confirm: Called once, before any device is opened; False cancels it. Without it the call
            itself confirms the motion.
        on_event: Receives each event of the run. It is called by the thread that supervises the
            motion and must return at once. An exception stops and fails the run;
            `KeyboardInterrupt` and `SystemExit` stop it as Ctrl-C does.
        supervisor: Turns interrupts into stops; None for what signal handlers raise.
        plan_file: Name of the plan in messages.

    Returns:
        The result, also of a run that was stopped or failed.

    Raises:
        BadInput: An argument cannot be used, or the plan was made for another rig.
        Refused: The plan does not pass the checks, the bus is latched, or the drives cannot be
            armed; nothing moved.
        HardwareMissing: A drive or a camera does not answer; nothing moved.
        Fault: A process of the program failed before anything moved.
        StoppedByOperator: Cancelled before anything moved.
        KeyboardInterrupt: Ctrl-C, after the drives stopped together and the record was written; so
            is the first exception of any other signal handler.
    """
    require_types((plan, Plan), (rig, Rig), (listener, Listener), optional=[(start, Pose)])
    require_functions(confirm=confirm, on_event=on_event)
    realtime = truth_value("realtime", realtime)
    options = RunOptions(
        realtime=realtime,
        start=start,
        clearance_stop=truth_value("clearance_stop", clearance_stop),
        need_real_time_rights=truth_value("need_real_time_rights", need_real_time_rights),
        listener=listener,
        confirm=confirm,
        on_event=on_event,
    )
    with commands_from_start("run", rig, supervisor, realtime=realtime) as commands:
        require_same_rig(plan, rig, plan_file)
        chosen = resolve_cameras(rig, cameras, is_simulated(rig))
        require_synthetic_images(chosen.values(), not realtime)
        require_drives(rig, realtime)
        if plan.scene.obstacles:
            is_sealed = rig.document.cameras == plan.rig.document.cameras
            require_stated_errors(rig, list(chosen), then=_PASS_THE_RIG if is_sealed else "")
        require_simulated_start(rig, start)
        make_folder = folder_maker(folder, dated_name())
        interlock = MotionInterlock(rig)
        interlock.require_free()
        prepared = prepare_plan(plan, interlock.referenced_rig(), listener)
        return run_prepared(prepared, make_folder, chosen, options, commands)


def run_prepared(
    prepared: PreparedRun,
    make_folder: Callable[[], RunFolder],
    cameras: Mapping[Camera, str],
    options: RunOptions,
    commands: Commands,
) -> RunResult:
    """Confirms, arms, moves, measures, computes the verdict, then writes the result files.

    A run refused before anything moved leaves no folder.

    Args:
        make_folder: See `executor.run_result.folder_maker`.
        cameras: From `resolve_cameras`; empty for none.
        commands: Those taken since the start of the verb.

    Raises:
        CdprError: As for `run`.
    """
    commands.require_no_stop()
    require_readable_record(prepared)
    proposal = motion_proposal(prepared, cameras, options.clearance_stop)
    require_confirmed(options.confirm, proposal)
    commands.require_no_stop()
    with options.listener.waiting("loading the report generator"):
        _preload_results()
    commands.require_no_stop()
    result = _Run(prepared, make_folder(), cameras, options, commands).recorded()
    commands.supervisor.finish()
    return result


def _preload_results() -> None:
    """Loads modules of the result files now, as a failure after the motion would lose data."""
    import cv2  # noqa: F401
    import scipy.spatial  # noqa: F401

    import executor.report.page
    import executor.report.run_data  # noqa: F401


@dataclass(slots=True, eq=False)
class _Run:
    """One run; its methods are in the order of time.

    Attributes:
        course: Start of the run; its time is that of the motion once this begins.
        callbacks: Functions of the caller.
        listener: The caller's.
        begun: The platform was about to move.
        recorder: Of cycles and events.
        outcome: Of the motion.
        seen: Camera records.
        troubles: Missing data, and what a function of the caller raised late, a sentence each.
        result: The verdict, once the files are written.
    """

    prepared: PreparedRun
    folder: RunFolder
    cameras: Mapping[Camera, str]
    options: RunOptions
    commands: Commands
    course: RunCourse = field(init=False)
    callbacks: Callbacks = field(init=False)
    listener: GuardedListener = field(init=False)
    begun: bool = False
    recorder: Recorder | None = None
    outcome: Outcome | None = None
    seen: CameraRecords | None = None
    troubles: list[str] = field(default_factory=list)
    result: RunResult | None = None

    def __post_init__(self) -> None:
        rig, fast = self.prepared.rig, not self.options.realtime
        interface, simulated = rig.document.bus.interface, is_simulated(rig)
        self.course = RunCourse(datetime.now(UTC), interface, simulated, fast, versions=versions())
        self.callbacks = Callbacks(self.commands.board.ask_stop)
        self.listener = GuardedListener(self.options.listener, self.callbacks)

    def recorded(self) -> RunResult:
        """Moves and measures, with a run folder."""
        folder = self.folder
        try:
            folder.write_plan(self.prepared.plan.plan.document)
            folder.write_rig(self.prepared.rig.document)
            folder.write_course(self.course)
            with folder.held():
                board, moves = self.commands.board, self._move_and_measure
                self.commands.supervisor.during(board, moves, self._conclude)
        except StoppedByOperator:
            self.callbacks.leave()
            raise
        finally:
            self._close()
            if not self.begun:
                folder.discard()
        self.callbacks.leave()
        assert self.result is not None
        return self.result

    def _move_and_measure(self) -> None:
        """Moves and takes images; a failure of the motion once begun is part of the outcome."""
        try:
            self._with_listeners()
        except Exception as error:
            if not self.begun or self.recorder is None:
                raise
            text = f"{type(error).__name__}: {error}".rstrip(": ")
            if self.outcome is None:
                text = f"the program failed during the motion: {text}"
                log, started = self.recorder.log, self.course.started
                self.outcome = Outcome(State.LATCHED, text, log, False, started)
            else:
                self.troubles.append(f"writing the results failed: {text}")

    def _with_listeners(self) -> None:
        """Moves while the command socket accepts requests such as `cdpr stop`."""
        prepared, options, board = self.prepared, self.options, self.commands.board
        listener, fast, on_event = self.listener, not options.realtime, options.on_event
        rows, cycle = len(prepared.checked.table), prepared.checked.table.cycle
        every = cycles_per_image(asked_rate(self.cameras), cycle)
        status = RunStatus(prepared, self.folder.path, board, simulated_time=fast)
        check_stop = self.commands.require_no_stop
        opening = partial(open_cameras, prepared, self.cameras, self.folder.path, check_stop)
        with ExitStack() as stack:
            stack.enter_context(self.commands.during_motion(status))
            cameras = stack.enter_context(opening(simulated_time=fast, listener=options.listener))
            with listener.progress("preparing, row", rows) as show:
                watch = (
                    CameraWatch(
                        cameras, status, board, self._take_event,
                        clearance_stop=options.clearance_stop, listener=listener,
                    )
                    if cameras
                    else None
                )  # fmt: skip
                recorder = self.recorder = Recorder(
                    prepared,
                    self.folder,
                    status,
                    trigger=watch.trigger if watch else None,
                    every=every,
                    progress=lambda row: show(
                        row, watch.rates if watch else "", f"{recorder.state.value}, row"
                    ),
                    announce=listener.note,
                    on_event=on_event and self.callbacks.guarded("on_event", on_event),
                    own_thread=options.realtime,
                )
                self.outcome = self._move(recorder)
                status.take_end(self.outcome.state, self.outcome.cause)
            self.seen = watch.finish(recorder.last) if watch else CameraRecords()

    def _move(self, recorder: Recorder) -> Outcome:
        """Arms the drives and runs the loop: here in simulated time, else in another process."""
        prepared, options = self.prepared, self.options

        def before_motion(denied: str) -> None:
            if denied:
                recorder.take_event(LoopEvent(0, 0.0, "no_real_time", denied))
                options.listener.remark(denied)
            self.course = replace(self.course, started=datetime.now(UTC))
            recorder.writer.take_file(partial(self.folder.write_course, self.course))
            self.begun = True
            self.commands.supervisor.on_motion()

        def mover(motion: PathMotion) -> AbstractContextManager[Mover]:
            start = options.start or prepared.scene.start
            return open_mover(
                prepared.rig,
                motion,
                partial(drives_of, prepared.rig.document, start, prepared.scene.load),
                self.commands.board,
                SimulatedClock(prepared.checked.table.cycle),
                need_real_time_rights=options.need_real_time_rights,
                listener=options.listener,
                after_stop="run it again when ready",
            )

        return run_along_path(prepared, mover, recorder, before_motion=before_motion)

    def _take_event(self, code: str, text: str, at: float) -> None:
        """Records an event of another source than the loop.

        Raises:
            CdprError: It cannot be written, which stops a moving platform.
        """
        assert self.recorder is not None
        try:
            self.recorder.take_event(LoopEvent(0, at, code, text))
        except CdprError:
            if self.outcome is None:
                raise

    def _conclude(self) -> None:
        """Computes the verdict, reports it, then writes the result files."""
        outcome, supervisor = self.outcome, self.commands.supervisor
        assert outcome is not None
        with self.listener.waiting("evaluating the run"):
            self._close()  # what is not on record fails the run, as during the motion
            course = self._course(outcome)
            evaluated, summary = self._evaluated(outcome, course)
        result = RunResult(self.folder.path, summary)
        supervisor.on_verdict(result)
        with self.listener.waiting("writing the run folder and report"):
            events, left_out = outcome.log.events, supervisor.leaves_files_out
            missing = write_end(self.folder, course, evaluated, events, left_out)
        if self.callbacks.error not in " ".join((course.cause, *course.troubles)):
            self.listener.warning(f"{self.callbacks.error}; the verdict does not depend on it")
        has_report = evaluated is not None and REPORT not in missing
        report = self.folder.report if has_report else None
        self.result = RunResult(self.folder.path, summary, missing, report)

    def _course(self, outcome: Outcome) -> RunCourse:
        """The course with the end of the motion."""
        late = self.callbacks.error
        if late and (outcome.state is State.STOPPED or late not in outcome.cause):
            self.troubles.append(late)
        return replace(
            self.course,
            started=outcome.started,
            final_state=outcome.state.value,
            cause=outcome.cause,
            cycles=len(outcome.log),
            cameras=() if self.seen is None else tuple(self.seen.cameras),
            troubles=tuple(self.troubles),
        )

    def _evaluated(
        self, outcome: Outcome, course: RunCourse
    ) -> tuple[EvaluatedRun | None, dict[str, Any]]:
        """The evaluation and its summary; if that fails, a summary without tables."""
        assert self.recorder is not None
        try:
            seen = self.seen or CameraRecords()
            evaluated = evaluate(self.prepared, outcome, seen, course, self.recorder)
        except Exception as error:
            trouble = f"{type(error).__name__}: {error}".rstrip(": ")
            return None, not_evaluated(self.prepared, outcome, course, trouble)
        return evaluated, evaluated.summary

    def _close(self) -> None:
        """Waits until all records are on disk."""
        if self.recorder is not None:
            self.recorder.writer.close()
