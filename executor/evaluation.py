"""Evaluation of a run: verdict, tables, summary and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from executor.cameras.multi_camera import CameraRecords
from executor.cameras.process import CameraSample
from executor.control.path_runs import Outcome
from executor.recording.checksums import CHECKSUMS, write_checksums
from executor.recording.clearance import (
    ClearanceRow,
    ClearanceTable,
    clearance_table,
    encoder_rows,
    source_of,
)
from executor.recording.mcap import write_mcap
from executor.recording.record_files import AGAIN, RunCourse
from executor.recording.recorder import Recorder
from executor.recording.run_folder import (
    BEGUN,
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
from executor.recording.summary import summarize
from executor.recording.tables import OK, CycleTable, PoseTable, fused_table
from executor.recording.verdict import FAILED, NOT_ENDED, Check, RunContext, Verdict
from executor.report import build_report
from executor.safety.fault_messages import HARMLESS, ORDINARY
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from model.clearance import ClearanceModel
from model.errors import BadInput, CdprError, Fault
from model.pose import Array, Pose, interpolate
from model.rig import Rig
from model.scene import Scene
from tracking.clearance import MeasuredClearance, clearance_of
from tracking.measurement import NoPose, PoseMeasurement

#: Files that `rewrite_report` makes from the others.
_FROM_OTHERS = (FUSED, MCAP, REPORT)
#: Files that it writes again where they exist.
_RENEWED = (CHECKSUMS, REPORT)
_MAKE_ROOM = "make the folder writable, or free some space"
_File = tuple[str, Callable[[], object]]
"""A file's name, and the function that writes it."""


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedRun:
    """An evaluated run, before its results are written.

    Attributes:
        context: Plan, rig and outcome.
        cycles: Every cycle.
        poses: Fused poses of the cameras.
        alone: Poses of each of several cameras.
        clearance: Distances to obstacles.
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
    recorder: Recorder,
) -> EvaluatedRun:
    """Computes the verdict of a run and its tables.

    First it has the end of the run, cycles that could not be appended, and the camera poses
    written, which would be lost if the program were killed during the evaluation of a long run.

    Args:
        course: Of the run, with its end.
        recorder: Of the run; its cycles are appended, or never will be.
    """
    folder, take_file = recorder.folder, recorder.writer.take_file
    take_file(partial(_written, [(COURSE, partial(folder.write_end_of_course, course))]))
    cycles = outcome.log.table()
    unwritten = recorder.writer.unwritten  # the disk may have recovered since
    if unwritten and _written([(CYCLES, partial(folder.write_table, CYCLES, cycles))]):
        troubles = (*course.troubles, *_lost_cycles(course, unwritten))
        course = replace(course, troubles=troubles)
    poses = _pose_table(seen.together, cycles)
    alone = {name: _pose_table(samples, cycles) for name, samples in seen.alone.items()}
    if len(poses):
        take_file(partial(_written, _pose_files(folder, poses, alone)))
    clearance = _clearance(prepared.rig, prepared.scene, cycles, seen)
    context = RunContext(prepared.plan.plan, prepared.rig, course, tuple(outcome.log.events))
    summary = summarize(context, cycles, poses, clearance)
    return EvaluatedRun(context, cycles, poses, alone, clearance, summary)


def _lost_cycles(course: RunCourse, lost: int) -> list[str]:
    """Cycles that could not be written, in a sentence, if any."""
    text = f"Of {course.cycles} cycles the last {lost} are not on record"
    return [text] if lost > 0 and text not in course.troubles else []


def evaluate_folder(folder: RunFolder) -> EvaluatedRun:
    """Evaluates a run from the files in its folder, also of a program that was killed.

    Raises:
        BadInput: A file of it was changed, or is missing though the run ended and cannot be made
            again.
    """
    rig, plan, course = folder.rig(), folder.plan(), folder.course()
    cycles = folder.cycles_cut_short(rig.cable_count)
    poses = folder.poses() if folder.has(POSES) else PoseTable.empty()
    events = folder.events()
    if not course.final_state:
        course = _ended_by_events(course, cycles, events)
    if len(cycles) == course.cycles - 1 and not folder.has(CYCLES):
        cycles = _with_last_row(folder, cycles)
    troubles = [*course.troubles, *_lost_cycles(course, course.cycles - len(cycles))]
    if folder.has(CLEARANCE):
        clearance = folder.clearance()
    else:
        clearance = _clearance(rig, plan.scene, cycles, CameraRecords())
        if plan.scene.obstacles and np.isfinite(poses.position).any():
            if any((folder.path / name).is_file() for name in (SUMMARY, CHECKSUMS)):
                raise BadInput(
                    f"{CLEARANCE} is missing and cannot be recomputed",
                    where=str(folder.path),
                    why="no other table holds the clearance that the cameras measured",
                    next_step=AGAIN,
                )
            troubles.append("The clearance that the cameras measured is not on record")
    has_images = any((folder.path / PICTURES).glob("**/*.jpg"))  # the first image of each is kept
    if has_images and not folder.has(POSES):
        troubles.append("What the cameras measured is not on record")
    if len(poses) and not course.cameras:
        troubles.append("Whether the cameras failed is not on record")
    course = replace(course, troubles=tuple(troubles))
    context = RunContext(plan, rig, course, tuple(events))
    summary = summarize(context, cycles, poses, clearance)
    return EvaluatedRun(context, cycles, poses, folder.poses_by_camera(), clearance, summary)


def _with_last_row(folder: RunFolder, cycles: CycleTable) -> CycleTable:
    """All cycles if the last row, which lacks its line break, is whole: as it would be written."""
    try:
        table = folder.cycles()
    except BadInput:
        return cycles
    last = (folder.path / CYCLES).read_bytes().rpartition(b"\n")[2].removesuffix(b"\r")
    return table if table.csv_rows(first=-1).encode() == last + b"\n" else cycles


def _ended_by_events(
    course: RunCourse, cycles: CycleTable, events: Sequence[RunEvent]
) -> RunCourse:
    """The end of a run whose program was killed after it, before ``run.json`` was written.

    Only unambiguous evidence counts: the drives held, the cycles reach that point, and all events
    are those of a good run or of the operator's stop.
    """
    codes = {event.code for event in events}
    at_rest = len(cycles) and cycles.state[-1] == State.SECURING.value
    if not (at_rest and "held" in codes and codes <= ORDINARY | HARMLESS):
        return replace(course, final_state=NOT_ENDED)
    stops = [event.text for event in events if event.code == "stop"]
    if stops:
        return replace(course, final_state=State.STOPPED.value, cause=stops[0])
    return replace(course, final_state=State.FINISHED.value)


def not_evaluated(
    prepared: PreparedRun, outcome: Outcome, course: RunCourse, trouble: str
) -> dict[str, Any]:
    """A summary without tables, where these could not be computed."""
    verdict = _judge_without_tables(course.final_state, course.cause, trouble)
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


def _judge_without_tables(final_state: str, cause: str, trouble: str) -> Verdict:
    """The verdict on a run whose tables could not be computed.

    Args:
        final_state: ``finished``, ``stopped`` or any other for a fault.
        cause: Why it did not finish, if it did not.
        trouble: Why there are no tables.
    """
    known = Check("evaluated", False, f"The measurements could not be evaluated: {trouble}.")
    if final_state == "finished":
        end = Check("finished", True, "The platform reached the goal.")
        return Verdict(FAILED, "The run reached the goal, but was not evaluated.", (end, known))
    word = "was stopped" if final_state == "stopped" else "ended with a fault"
    cause_text = cause.rstrip(".") or f"the final state is {final_state!r}"
    end = Check("finished", False, f"The run ended before the goal: {cause_text}.")
    return Verdict(FAILED, f"The run {word} before the goal.", (end, known))


def write_end(
    folder: RunFolder,
    course: RunCourse,
    result: EvaluatedRun | None,
    events: Sequence[RunEvent],
    given_up: Callable[[], bool] = lambda: False,
) -> dict[str, str]:
    """Writes every result file of a run, each as far as possible.

    Args:
        course: With its end, if there is no evaluation.
        result: The evaluation; None if it failed.
        given_up: Called before each file that can be made from the others; True leaves it out.

    Returns:
        Names of the files that could not be written, and why.
    """
    end = course if result is None else result.context.course
    files: list[_File] = [
        (COURSE, partial(folder.write_end_of_course, end)),
        (EVENTS, partial(_complete_events, folder, events)),
    ]
    if result is not None:
        files += _files(folder, result)
    return _reasons(folder, _written(files, given_up))


def write_results(folder: RunFolder, result: EvaluatedRun) -> None:
    """Writes the missing files of an evaluated run's folder, and its report.

    Raises:
        Fault: A file could not be written; it names the file that is the cause.
    """
    files = _files(folder, result)
    todo = [file for file in files if file[0] in _RENEWED or not folder.has(file[0])]
    missing = _written(todo)
    if missing:
        name, error = next(iter(missing.items()))
        unwritable = error.why and error.where == str(folder.path / name)
        raise Fault(
            f"not written: {', '.join(missing)}",
            where=str(folder.path),
            why=f"{name}: {_reasons(folder, missing)[name]}",
            next_step=_MAKE_ROOM if unwritable else error.next_step,
        )


def rewrite_report(folder: RunFolder) -> None:
    """Rewrites the report from the files of a run, and all files that are missing.

    Raises:
        BadInput: A file of the run was changed, or the folder cannot be written to.
    """
    if folder.is_whole and all(map(folder.has, (FUSED, MCAP))):
        build_report(folder)
    else:
        write_results(folder, evaluate_folder(folder))


def _files(folder: RunFolder, result: EvaluatedRun) -> list[_File]:
    """The files and their writers, most important first."""
    cycles, poses, clearance = result.cycles, result.poses, result.clearance
    fused = cache(partial(fused_table, cycles, poses))  # of two files; slow for a run of hours

    def write_channels() -> None:
        write_mcap(folder, result.context, cycles, poses, clearance, fused(), result.alone)

    files: list[_File] = [
        (CYCLES, partial(folder.write_table, CYCLES, cycles)),
        *_pose_files(folder, poses, result.alone),
        (CLEARANCE, partial(folder.write_table, CLEARANCE, clearance)),
        (SUMMARY, partial(folder.write_summary, result.summary)),
        (FUSED, lambda: folder.write_table(FUSED, fused())),
        (MCAP, write_channels),
    ]
    sums = partial(write_checksums, folder.path, [*BEGUN, *dict(files)])
    return [*files, (CHECKSUMS, sums), (REPORT, partial(build_report, folder))]


def _pose_files(folder: RunFolder, poses: PoseTable, alone: Mapping[str, PoseTable]) -> list[_File]:
    tables = {POSES: poses, **{POSES_OF.format(name): table for name, table in alone.items()}}
    return [(name, partial(folder.write_table, name, table)) for name, table in tables.items()]


def _written(
    files: Sequence[_File], given_up: Callable[[], bool] = lambda: False
) -> dict[str, CdprError]:
    """Writes each; returns the errors of those that failed."""
    missing: dict[str, CdprError] = {}
    for name, write in files:
        try:
            if name in _FROM_OTHERS and given_up():
                missing[name] = Fault("interrupted")
            elif name in (SUMMARY, CHECKSUMS) and missing.keys() - {*_FROM_OTHERS}:
                missing[name] = next(iter(missing.values()))  # they mark a folder with its tables
            else:
                write()
        except CdprError as error:
            missing[name] = error
        except Exception as error:  # out of memory, or a defect: continue with the other files
            missing[name] = Fault(f"{type(error).__name__}: {error}".rstrip(": "))
    return missing


def _reasons(folder: RunFolder, missing: Mapping[str, CdprError]) -> dict[str, str]:
    """Why each file is missing: the cause of those it is made from; what is wrong with others."""
    causes = {str(folder.path / name): error for name, error in missing.items()}
    reasons = {}
    for name, error in missing.items():
        first = causes.get(error.where, error)
        reasons[name] = first.why or first.what
        if error.where and error.where not in causes:
            reasons[name] = f"{error.where}: {error.what}" + f" ({error.why})" * bool(error.why)
    return reasons


def _complete_events(folder: RunFolder, events: Sequence[RunEvent]) -> None:
    """Rewrites the events if some could not be appended during the run."""
    try:
        complete = len(folder.events()) == len(events)
    except BadInput:
        complete = False
    if not complete:
        folder.write_events(events)


def _pose_table(samples: Sequence[CameraSample], cycles: CycleTable) -> PoseTable:
    if not samples:
        return PoseTable.empty()
    position, rotation = np.full((len(samples), 3), np.nan), np.full((len(samples), 4), np.nan)
    covariance = np.full((len(samples), 6, 6), np.nan)
    reprojection = np.full(len(samples), np.nan)
    tags = [""] * len(samples)
    for k, sample in enumerate(samples):
        found = sample.found
        if isinstance(found, PoseMeasurement):
            position[k], rotation[k] = found.pose.position, found.pose.quaternion
            covariance[k], reprojection[k] = found.covariance, found.reprojection
            tags[k] = " ".join(map(str, found.tags))
    return PoseTable(
        frame=np.array([sample.frame for sample in samples], dtype=np.int64),
        time=np.array([sample.found.time for sample in samples]),
        status=tuple(
            sample.found.reason if isinstance(sample.found, NoPose) else OK for sample in samples
        ),
        position=position,
        rotation=rotation,
        covariance=covariance,
        tags=tuple(tags),
        reprojection=reprojection,
        planned=_planned_positions(samples, cycles),
        picture=tuple(sample.picture for sample in samples),
    )


def _planned(samples: Sequence[CameraSample], cycles: CycleTable) -> list[Pose]:
    """Planned poses at the time of each image, between those of two cycles."""
    times = np.array([sample.found.time for sample in samples])
    rows = np.interp(times, cycles.time, np.arange(len(cycles)))
    before = rows.astype(np.int64)
    starts, ends = (
        _poses(cycles.planned[row], cycles.planned_rotation[row])
        for row in (before, np.minimum(before + 1, len(cycles) - 1))
    )
    return list(map(interpolate, starts, ends, rows - before))


def _planned_positions(samples: Sequence[CameraSample], cycles: CycleTable) -> Array:
    """Planned positions at each image, shape (n, 3), [m]; NaN if no cycle was sent."""
    if not len(cycles):
        return np.full((len(samples), 3), np.nan)
    times = np.array([sample.found.time for sample in samples])
    axes = [np.interp(times, cycles.time, cycles.planned[:, i]) for i in range(3)]
    return np.column_stack(axes)


def _poses(positions: Array, quaternions: Array) -> list[Pose]:
    pairs = zip(positions, quaternions, strict=True)
    return [Pose.from_quaternion(position, quaternion) for position, quaternion in pairs]


def _clearance(rig: Rig, scene: Scene, cycles: CycleTable, seen: CameraRecords) -> ClearanceTable:
    model = ClearanceModel(rig, scene)
    rows = _measured_rows(model, cycles, seen.together, "tag")
    for name, samples in seen.alone.items():
        measured = [replace(sample, clearance=_clearance_at(model, sample)) for sample in samples]
        rows += _measured_rows(model, cycles, measured, source_of(name))
    rows += encoder_rows(model, cycles, scene.obstacle_clearance)
    return clearance_table(model.obstacle_names, rows)


def _measured_rows(
    model: ClearanceModel, cycles: CycleTable, samples: Sequence[CameraSample], source: str
) -> list[ClearanceRow]:
    """A row per sample with a clearance; none before the first cycle."""
    if not (samples and len(cycles)):
        return []
    return [
        ClearanceRow.at(sample.found.time, source, sample.clearance, model.obstacles(planned))
        for sample, planned in zip(samples, _planned(samples, cycles), strict=True)
        if sample.clearance is not None
    ]


def _clearance_at(model: ClearanceModel, sample: CameraSample) -> MeasuredClearance | None:
    return clearance_of(model, sample.found) if isinstance(sample.found, PoseMeasurement) else None
