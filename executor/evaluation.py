"""What a run leaves: first its verdict, then its tables, its summary and its report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from executor.cameras.multi_camera import CameraRecords
from executor.cameras.process import CameraSample
from executor.control.path_runs import Outcome
from executor.recording.clearance import (
    ClearanceRow,
    ClearanceTable,
    clearance_table,
    encoder_rows,
    source_of,
    tension_noise,
)
from executor.recording.mcap import write_mcap
from executor.recording.record_files import CameraRecord, RunCourse, versions
from executor.recording.run_folder import (
    CLEARANCE,
    COURSE,
    CYCLES,
    EVENTS,
    FUSED,
    MCAP,
    PICTURES,
    POSES,
    POSES_OF,
    REPORT,
    SUMMARY,
    RunEvent,
    RunFolder,
)
from executor.recording.summary import RunContext, summarize
from executor.recording.tables import OK, CycleTable, PoseTable, fused_table, no_poses
from executor.recording.verdict import HARMLESS, NOT_ENDED, ORDINARY, judge_without_tables
from executor.report import build_report
from executor.state_machine import SIMULATED, State
from executor.trajectory.prepare import PreparedRun
from model.clearance import ClearanceModel
from model.errors import BadInput, CdprError, Fault
from model.plan import Plan
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene
from model.winches import WinchMap
from tracking.clearance import MeasuredClearance, clearance_of
from tracking.measurement import NoPose, PoseMeasurement

#: Clearances from drive positions are computed this often along a run, [Hz].
CLEARANCE_RATE = 10.0

_File = tuple[str, Callable[[], object]]
"""A file's name, and what writes it."""


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedRun:
    """A run as it was, before any file of its end is written.

    Attributes:
        context: What it was.
        cycles: Every cycle.
        poses: What the cameras saw together.
        alone: What each of several cameras saw.
        clearance: How near it came.
        summary: The content of ``summary.json``.
    """

    context: RunContext
    cycles: CycleTable
    poses: PoseTable
    alone: dict[str, PoseTable]
    clearance: ClearanceTable
    summary: dict[str, Any]


def evaluate(
    prepared: PreparedRun,
    outcome: Outcome,
    seen: CameraRecords,
    course: RunCourse,
    troubles: Sequence[str] = (),
) -> EvaluatedRun:
    """The verdict over a run and what it rests on; writes nothing.

    Args:
        prepared: What was run.
        outcome: What the motion left behind.
        seen: What the cameras saw.
        course: Of the run, with its end.
        troubles: What of it is lost, a sentence each; with any the run does not pass.
    """
    cycles = outcome.log.table()
    poses = _pose_table(seen.together, cycles)
    alone = {name: _pose_table(looks, cycles) for name, looks in seen.alone.items()}
    clearance = _clearance(prepared.rig, prepared.scene, cycles, seen)
    plan, events = prepared.plan.plan, outcome.log.events
    context = _context_of(plan, prepared.rig, course, cycles, events, seen.cameras, troubles)
    summary = summarize(context, cycles, poses, clearance)
    return EvaluatedRun(context, cycles, poses, alone, clearance, summary)


def evaluate_cut_short(folder: RunFolder) -> EvaluatedRun:
    """The same of a run whose program was killed, from what its folder has.

    Raises:
        BadInput: A file of it was changed.
    """
    rig, plan, course = folder.rig(), folder.plan(), folder.course()
    cycles = folder.cycles_cut_short(rig.cable_count)
    poses = folder.poses() if folder.has(POSES) else no_poses()
    clearance = _clearance(rig, plan.scene, cycles, CameraRecords())
    events = folder.events()
    if not course.final_state:
        course = _ended_by_events(course, cycles, events)
    lost = course.cycles - len(cycles)
    troubles = [f"Of {course.cycles} cycles the last {lost} are not on record"] if lost > 0 else []
    looked = any((folder.path / PICTURES).glob("**/*.jpg"))  # the first image of each is kept
    if looked and not folder.has(POSES):
        troubles.append("What the cameras measured is not on record")
    context = _context_of(plan, rig, course, cycles, events, (), troubles)
    summary = summarize(context, cycles, poses, clearance)
    return EvaluatedRun(context, cycles, poses, folder.poses_by_camera(), clearance, summary)


def _ended_by_events(
    course: RunCourse, cycles: CycleTable, events: Sequence[RunEvent]
) -> RunCourse:
    """How a run ended that was killed after its end, before that was in ``run.json``.

    Only what cannot be mistaken counts: the drives held, the cycles reach up to there, and nothing
    was reported but a run that goes well or the operator's stop.
    """
    codes = {event.code for event in events}
    at_rest = len(cycles) and cycles.state[-1] == State.SECURING.value
    if not (at_rest and "held" in codes and codes <= ORDINARY | HARMLESS):
        return replace(course, final_state=NOT_ENDED)
    stops = [event.text for event in events if event.code == "stop"]
    if stops:
        return replace(course, final_state=State.STOPPED.value, cause=stops[0])
    return replace(course, final_state=State.FINISHED.value)


def _context_of(
    plan: Plan,
    rig: Rig,
    course: RunCourse,
    cycles: CycleTable,
    events: Sequence[RunEvent],
    cameras: tuple[CameraRecord, ...] = (),
    troubles: Sequence[str] = (),
) -> RunContext:
    """What a run was, beside its tables; on any bus simulated drives say so themselves."""
    simulated = course.simulated or any(event.code == SIMULATED for event in events)
    return RunContext(
        plan=plan,
        rig=rig,
        interface=course.interface,
        simulated=simulated,
        fast=course.fast,
        started=course.started,
        duration=_duration(cycles, rig.cycle),
        final_state=course.final_state,
        events=tuple(events),
        versions=versions(),
        cause=course.cause,
        cameras=cameras,
        troubles=tuple(troubles),
    )


def not_evaluated(
    prepared: PreparedRun, outcome: Outcome, course: RunCourse, trouble: str
) -> dict[str, Any]:
    """A summary of what is known where the tables of a run could not be made, for any reason."""
    verdict = judge_without_tables(course.final_state, course.cause, trouble)
    return {
        "schema_version": 1,
        "verdict": verdict.word,
        "passed": verdict.passed,
        "sentence": verdict.sentence,
        "reasons": verdict.reasons,
        "rig": prepared.rig.name,
        "scene": prepared.scene.name,
        "interface": course.interface,
        "final_state": course.final_state,
        "cycles": len(outcome.log),
        "events": [asdict(event) for event in outcome.log.events],
    }


def write_end(
    folder: RunFolder,
    course: RunCourse,
    result: EvaluatedRun | None,
    events: Sequence[RunEvent],
    given_up: Callable[[], bool] = lambda: False,
) -> dict[str, str]:
    """Writes every file of a run's end, each as far as it can be.

    Args:
        folder: Of the run.
        course: With its end.
        result: What it was; None where it could not be evaluated.
        events: All of them.
        given_up: Asked before each file whether the rest shall be left out.

    Returns:
        Names of the files that could not be written, and why.
    """
    files: list[_File] = [
        (COURSE, partial(folder.write_end_of_course, course)),
        (EVENTS, partial(_complete_events, folder, events)),
    ]
    if result is not None:
        files += _files(folder, result)
    return _written(files, given_up)


def write_results(folder: RunFolder, result: EvaluatedRun) -> None:
    """Writes what is missing in the folder that a run was evaluated from, and its report.

    Raises:
        Fault: Not all could be written.
    """
    files = _files(folder, result)
    lacking = [file for file in files if file[0] == REPORT or not folder.has(file[0])]
    missing = _written(lacking, lambda: False)
    if missing:
        name, why = next(iter(missing.items()))
        raise Fault(
            f"not written: {', '.join(missing)}",
            where=str(folder.path),
            why=f"{name}: {why}",
            next_step="make the folder writable, or free some space",
        )


def rewrite_report(folder: RunFolder) -> None:
    """Writes the report again, from the files of a run alone; of one cut short, what is missing.

    Raises:
        BadInput: A file of the run was changed, or the folder cannot be written to.
    """
    if folder.is_whole:
        build_report(folder)
    else:
        write_results(folder, evaluate_cut_short(folder))


def _files(folder: RunFolder, result: EvaluatedRun) -> list[_File]:
    """The files and who writes them; the first matter most."""
    cycles, poses, clearance = result.cycles, result.poses, result.clearance

    def write_channels() -> None:
        together = fused_table(cycles, poses)
        write_mcap(folder, result.context, cycles, poses, clearance, together, result.alone)

    return [
        (CYCLES, partial(folder.write_cycles, cycles)),
        (POSES, partial(folder.write_poses, poses)),
        *(
            (POSES_OF.format(name), partial(folder.write_poses_of, name, table))
            for name, table in result.alone.items()
        ),
        (CLEARANCE, partial(folder.write_clearance, clearance)),
        (SUMMARY, partial(folder.write_summary, result.summary)),
        (FUSED, lambda: folder.write_fused(fused_table(cycles, poses))),
        (MCAP, write_channels),
        (REPORT, partial(build_report, folder)),
    ]


def _written(files: Sequence[_File], given_up: Callable[[], bool]) -> dict[str, str]:
    """Writes each; what could not be, and why."""
    missing = {}
    for name, write in files:
        try:
            if given_up():
                missing[name] = "interrupted"
            elif name == SUMMARY and missing:  # it stands for a folder with all its tables
                missing[name] = next(iter(missing.values()))
            else:
                write()
        except CdprError as error:
            missing[name] = error.why or error.what
        except Exception as error:  # out of memory, or a defect: the other files are written
            missing[name] = f"{type(error).__name__}: {error}".rstrip(": ")
    return missing


def _complete_events(folder: RunFolder, events: Sequence[RunEvent]) -> None:
    """Those that could not be appended while the run went on are written now."""
    try:
        complete = len(folder.events()) == len(events)
    except BadInput:
        complete = False
    if not complete:
        folder.write_events(events)


def _duration(cycles: CycleTable, cycle: float) -> float:
    """From the begin of the first cycle to the end of the last, [s]."""
    return float(cycles.time[-1]) + cycle if len(cycles) else 0.0


def _pose_table(looks: Sequence[CameraSample], cycles: CycleTable) -> PoseTable:
    if not looks:
        return no_poses()
    unknown = PoseMeasurement(
        float("nan"),
        Pose(np.full(3, np.nan), np.full((3, 3), np.nan)),
        np.full((6, 6), np.nan),
        (),
        float("nan"),
        "",
    )
    found = [k.found if isinstance(k.found, PoseMeasurement) else unknown for k in looks]
    nothing = np.full(4, np.nan)
    return PoseTable(
        frame=np.array([look.frame for look in looks], dtype=np.int64),
        time=np.array([look.found.time for look in looks]),
        status=tuple(k.found.reason if isinstance(k.found, NoPose) else OK for k in looks),
        position=np.array([one.pose.position for one in found]),
        rotation=np.array([nothing if one is unknown else one.pose.quaternion for one in found]),
        covariance=np.array([one.covariance for one in found]),
        tags=tuple(" ".join(map(str, one.tags)) for one in found),
        reprojection=np.array([one.reprojection for one in found]),
        planned=_planned_positions(looks, cycles),
        picture=tuple(look.picture for look in looks),
    )


def _planned(looks: Sequence[CameraSample], cycles: CycleTable) -> list[Pose]:
    """Where the platform should have been when each image was taken."""
    times = np.array([look.found.time for look in looks])
    nearest = np.clip(np.searchsorted(cycles.time, times), 0, len(cycles) - 1)
    return _poses(_planned_positions(looks, cycles), cycles.planned_rotation[nearest])


def _planned_positions(looks: Sequence[CameraSample], cycles: CycleTable) -> Array:
    """Shape (n, 3), [m]; NaN when no cycle was ever sent."""
    if not len(cycles):
        return np.full((len(looks), 3), np.nan)
    times = np.array([look.found.time for look in looks])
    axes = [np.interp(times, cycles.time, cycles.planned[:, i]) for i in range(3)]
    return np.column_stack(axes)


def _poses(positions: Array, quaternions: Array) -> list[Pose]:
    pairs = zip(positions, quaternions, strict=True)
    return [Pose.from_quaternion(position, quaternion) for position, quaternion in pairs]


def _clearance(rig: Rig, scene: Scene, cycles: CycleTable, seen: CameraRecords) -> ClearanceTable:
    model = ClearanceModel(rig, scene)
    rows = _seen_rows(model, cycles, seen.together, "tag")
    for name, looks in seen.alone.items():
        measured = [replace(k, clearance=_clearance_at(model, k)) for k in looks]
        rows += _seen_rows(model, cycles, measured, source_of(name))
    if model.obstacle_names and len(cycles):
        every = max(1, round(1000.0 / (CLEARANCE_RATE * rig.document.bus.cycle_ms)))
        chosen = np.arange(0, len(cycles), every)
        rows += encoder_rows(
            model,
            WinchMap(rig),
            cycles.time[chosen],
            _poses(cycles.encoder[chosen], cycles.encoder_rotation[chosen]),
            _poses(cycles.planned[chosen], cycles.planned_rotation[chosen]),
            tension_noise(rig, cycles.tensions),
        )
    return clearance_table(model.obstacle_names, rows)


def _seen_rows(
    model: ClearanceModel, cycles: CycleTable, looks: Sequence[CameraSample], source: str
) -> list[ClearanceRow]:
    """A row for each look with a clearance; none before the first cycle."""
    if not (looks and len(cycles)):
        return []
    return [
        ClearanceRow.at(look.found.time, source, look.clearance, model.obstacles(planned))
        for look, planned in zip(looks, _planned(looks, cycles), strict=True)
        if look.clearance is not None
    ]


def _clearance_at(model: ClearanceModel, look: CameraSample) -> MeasuredClearance | None:
    return clearance_of(model, look.found) if isinstance(look.found, PoseMeasurement) else None
