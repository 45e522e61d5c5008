"""What a run leaves: its tables, its summary and its report, from what the motion left behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cdpr.clearance import ClearanceModel
from cdpr.poses import Array, Pose
from executor.clearance_table import ClearanceTable, source_of
from executor.cycle_table import CycleTable
from executor.drives_covariance import tension_noise
from executor.execution import Outcome
from executor.fused_table import fused_table
from executor.mcap_log import write_mcap
from executor.measured import ClearanceRow, clearance_table, encoder_rows
from executor.observer import Look
from executor.pose_table import OK, PoseTable, no_poses
from executor.prepare import PreparedRun
from executor.report import build_report
from executor.run_cameras import Seen
from executor.run_folder import RunFolder
from executor.summary import RunContext, summarize
from executor.versions import versions
from tracking.measured_clearance import MeasuredClearance, clearance_of
from tracking.measurement import NoPose, PoseMeasurement

#: Clearances from drive positions are computed this often along a run, [Hz].
CLEARANCE_RATE = 10.0


def conclude(
    prepared: PreparedRun,
    outcome: Outcome,
    folder: RunFolder,
    seen: Seen,
    *,
    interface: str,
    simulated: bool,
    fast: bool,
) -> dict[str, Any]:
    """Writes everything that the run left behind, its summary and its report.

    Args:
        prepared: What was run.
        outcome: What the motion left behind.
        folder: The run's folder.
        seen: What the cameras saw.
        interface: Of the bus.
        simulated: The drives were simulated.
        fast: Time was simulated.

    Returns:
        The summary.
    """
    cycles = outcome.log.table()
    poses = _pose_table(seen.together, cycles)
    alone = {name: _pose_table(looks, cycles) for name, looks in seen.alone.items()}
    clearance = _clearance(prepared, cycles, seen)
    folder.write_cycles(cycles)
    folder.write_poses(poses)
    for name, table in alone.items():
        folder.write_poses_of(name, table)
    folder.write_clearance(clearance)
    together = fused_table(cycles, poses)
    folder.write_fused(together)
    context = RunContext(
        plan=prepared.plan.plan,
        rig=prepared.rig,
        interface=interface,
        simulated=simulated,
        fast=fast,
        started=outcome.started,
        duration=_duration(cycles, prepared.checked.table.cycle),
        final_state=outcome.state.value,
        events=tuple(folder.events()),
        versions=versions(),
        cause=outcome.cause,
        cameras=seen.cameras,
    )
    summary = summarize(context, cycles, poses, clearance)
    folder.write_summary(summary)
    write_mcap(folder, context, cycles, poses, clearance, together, alone)
    build_report(folder)
    return summary


def _duration(cycles: CycleTable, cycle: float) -> float:
    """From the begin of the first cycle to the end of the last, [s]."""
    return float(cycles.time[-1]) + cycle if len(cycles) else 0.0


def _pose_table(looks: Sequence[Look], cycles: CycleTable) -> PoseTable:
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
        planned=np.array([pose.position for pose in _planned(looks, cycles)]),
        picture=tuple(look.picture for look in looks),
    )


def _planned(looks: Sequence[Look], cycles: CycleTable) -> list[Pose]:
    """Where the platform should have been when each picture was taken."""
    times = np.array([look.found.time for look in looks])
    axes = [np.interp(times, cycles.time, cycles.planned[:, i]) for i in range(3)]
    nearest = np.clip(np.searchsorted(cycles.time, times), 0, len(cycles) - 1)
    return _poses(np.column_stack(axes), cycles.planned_rotation[nearest])


def _poses(positions: Array, quaternions: Array) -> list[Pose]:
    pairs = zip(positions, quaternions, strict=True)
    return [Pose.from_quaternion(position, quaternion) for position, quaternion in pairs]


def _clearance(prepared: PreparedRun, cycles: CycleTable, seen: Seen) -> ClearanceTable:
    model = ClearanceModel(prepared.rig, prepared.scene)
    rows = _seen_rows(model, cycles, seen.together, "tag")
    for name, looks in seen.alone.items():
        measured = [replace(k, clearance=_clearance_at(model, k)) for k in looks]
        rows += _seen_rows(model, cycles, measured, source_of(name))
    if model.obstacle_names:
        every = max(1, round(1.0 / (CLEARANCE_RATE * prepared.checked.table.cycle)))
        chosen = np.arange(0, len(cycles), every)
        rows += encoder_rows(
            model,
            prepared.checked.winches,
            cycles.time[chosen],
            _poses(cycles.encoder[chosen], cycles.encoder_rotation[chosen]),
            _poses(cycles.planned[chosen], cycles.planned_rotation[chosen]),
            tension_noise(prepared.rig, cycles.tensions),
        )
    return clearance_table(model.obstacle_names, rows)


def _seen_rows(
    model: ClearanceModel, cycles: CycleTable, looks: Sequence[Look], source: str
) -> list[ClearanceRow]:
    """A row for each look with a clearance."""
    return [
        ClearanceRow.at(look.found.time, source, look.clearance, model.obstacles(planned))
        for look, planned in zip(looks, _planned(looks, cycles), strict=True)
        if look.clearance is not None
    ]


def _clearance_at(model: ClearanceModel, look: Look) -> MeasuredClearance | None:
    return clearance_of(model, look.found) if isinstance(look.found, PoseMeasurement) else None
