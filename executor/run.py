"""One run from a prepared table to a run folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from cdpr.clearance import ClearanceModel
from cdpr.poses import Array, Pose
from drivers.drive_group import DriveGroup
from executor.clearance_table import ClearanceTable
from executor.clock import Clock
from executor.cycle_table import CycleTable
from executor.loop import CycleRecord, Loop, LoopEvent
from executor.machine import State
from executor.mcap_log import write_mcap
from executor.measured import ClearanceRow, clearance_table, encoder_rows
from executor.observer import Look
from executor.pose_table import PoseTable, no_poses
from executor.prepare import PreparedRun
from executor.realtime import real_time
from executor.report import build_report
from executor.run_folder import RunEvent, RunFolder
from executor.run_log import RunLog
from executor.summary import RunContext, summarize
from executor.versions import versions

#: Clearances from drive positions are computed this often along a run, [Hz].
CLEARANCE_RATE = 10.0

Trigger = Callable[[float], None]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What the motion left behind.

    Attributes:
        state: Where the run ended.
        cause: Why it did not finish, if it did not.
        log: Its cycles.
        started: When, UTC.
    """

    state: State
    cause: str
    log: RunLog
    started: datetime


class Execution:
    """The motion of one prepared run on configured drives."""

    def __init__(
        self,
        prepared: PreparedRun,
        group: DriveGroup,
        clock: Clock,
        *,
        stop_requested: Callable[[], bool],
    ) -> None:
        """Prepares the loop; nothing is sent.

        Args:
            prepared: The checked run.
            group: Configured drives.
            clock: Real or simulated.
            stop_requested: Asked every cycle.
        """
        self.prepared = prepared
        self._clock = clock
        self._log = RunLog(prepared.rig, prepared.checked)
        self._folder: RunFolder | None = None
        self._triggers: Trigger | None = None
        self._progress: Callable[[float], None] = lambda _share: None
        self._every = 1
        self.loop = Loop(
            prepared.checked,
            group,
            clock,
            stop_requested=stop_requested,
            on_cycle=self._on_cycle,
            on_event=self._on_event,
        )

    def run(
        self,
        folder: RunFolder,
        *,
        trigger: Trigger | None = None,
        camera_rate: float = CLEARANCE_RATE,
        progress: Callable[[float], None] | None = None,
    ) -> Outcome:
        """Moves along the path; ends with the drives holding by themselves.

        Args:
            folder: Where events are written as they happen.
            trigger: Called for every picture with its time [s].
            camera_rate: Pictures a second, [Hz].
            progress: Called with the number of rows that are done.
        """
        cycle = self.prepared.checked.table.cycle
        self._folder, self._triggers = folder, trigger
        self._every = max(1, round(1.0 / (camera_rate * cycle)))
        self._progress = progress or self._progress
        started = datetime.now(UTC)
        if self._clock.simulated:
            self.loop.run()
        else:
            with real_time() as denied:
                if denied:
                    self._on_event(LoopEvent(0, "no_real_time", denied))
                self.loop.run()
        return Outcome(self.loop.machine.state, self.loop.cause, self._log, started)

    def _on_cycle(self, record: CycleRecord) -> None:
        self._log.add(record)
        if record.cycle % self._every:
            return
        self._progress(record.index)
        if self._triggers is not None:
            self._triggers(record.cycle * self.prepared.checked.table.cycle)

    def _on_event(self, event: LoopEvent) -> None:
        if self._folder is not None:
            time = event.cycle * self.prepared.checked.table.cycle
            self._folder.append_event(RunEvent(time, event.code, event.text))


def conclude(
    prepared: PreparedRun,
    outcome: Outcome,
    folder: RunFolder,
    looks: Sequence[Look],
    *,
    interface: str,
    simulated: bool,
    fast: bool,
) -> dict[str, Any]:
    """Writes everything that the run left behind, its summary and its report.

    Returns:
        The summary.
    """
    cycles = outcome.log.table()
    poses = _pose_table(looks, cycles)
    clearance = _clearance(prepared, cycles, looks)
    folder.write_cycles(cycles)
    folder.write_poses(poses)
    folder.write_clearance(clearance)
    context = RunContext(
        plan=prepared.plan.plan,
        rig=prepared.rig,
        interface=interface,
        simulated=simulated,
        fast=fast,
        started=outcome.started,
        duration=len(cycles) * prepared.checked.table.cycle,
        final_state=outcome.state.value,
        events=tuple(folder.events()),
        versions=versions(),
        cause=outcome.cause,
    )
    summary = summarize(context, cycles, poses, clearance)
    folder.write_summary(summary)
    write_mcap(folder, context, cycles, poses, clearance)
    build_report(folder)
    return summary


def _pose_table(looks: Sequence[Look], cycles: CycleTable) -> PoseTable:
    if not looks:
        return no_poses()
    nowhere = Pose(np.full(3, np.nan), np.full((3, 3), np.nan))
    poses = [look.pose or nowhere for look in looks]
    unknown = np.full(4, np.nan)
    return PoseTable(
        frame=np.array([look.frame for look in looks], dtype=np.int64),
        time=np.array([look.time for look in looks]),
        status=tuple(look.status for look in looks),
        position=np.array([pose.position for pose in poses]),
        rotation=np.array([look.pose.quaternion if look.pose else unknown for look in looks]),
        covariance=np.array([look.covariance for look in looks]),
        tags=tuple(" ".join(map(str, look.tags)) for look in looks),
        reprojection=np.array([look.reprojection for look in looks]),
        planned=np.array([pose.position for pose in _planned(looks, cycles)]),
        picture=tuple(look.picture for look in looks),
    )


def _planned(looks: Sequence[Look], cycles: CycleTable) -> list[Pose]:
    """Where the platform should have been when each picture was taken."""
    times = np.array([look.time for look in looks])
    axes = [np.interp(times, cycles.time, cycles.planned[:, i]) for i in range(3)]
    nearest = np.clip(np.searchsorted(cycles.time, times), 0, len(cycles) - 1)
    return _poses(np.column_stack(axes), cycles.planned_rotation[nearest])


def _poses(positions: Array, quaternions: Array) -> list[Pose]:
    pairs = zip(positions, quaternions, strict=True)
    return [Pose.from_quaternion(position, quaternion) for position, quaternion in pairs]


def _clearance(prepared: PreparedRun, cycles: CycleTable, looks: Sequence[Look]) -> ClearanceTable:
    model = ClearanceModel(prepared.rig, prepared.scene)
    rows = [
        ClearanceRow(
            look.time,
            "tag",
            look.clearance.nearest,
            look.clearance.uncertainty,
            model.obstacles(planned),
        )
        for look, planned in zip(looks, _planned(looks, cycles), strict=True)
        if look.clearance is not None
    ]
    if model.obstacle_names:
        every = max(1, round(1.0 / (CLEARANCE_RATE * prepared.checked.table.cycle)))
        chosen = np.arange(0, len(cycles), every)
        rows += encoder_rows(
            model,
            cycles.time[chosen],
            _poses(cycles.encoder[chosen], cycles.encoder_rotation[chosen]),
            _poses(cycles.planned[chosen], cycles.planned_rotation[chosen]),
        )
    return clearance_table(model.obstacle_names, rows)
