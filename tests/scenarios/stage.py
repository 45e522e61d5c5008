"""A run of a prepared plan on simulated drives, with a script of events by cycle."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.state_machine import DriveState
from drivers.drive_group import DriveGroup
from drivers.factory import make_drive_group
from executor.cameras.multi_camera import CameraRecords
from executor.control.path_runs import Outcome, PathMotion, run_along_path
from executor.evaluation import evaluate, write_end
from executor.realtime.child import ReadyDrives
from executor.realtime.process import MotionHere
from executor.recording.record_files import RunCourse
from executor.recording.recorder import FrameTrigger, Recorder
from executor.recording.run_folder import RunEvent, RunFolder
from executor.remote.status import RunStatus
from executor.supervision import LocalRequests
from executor.trajectory.setpoints import PreparedRun
from model.pose import Array, Pose
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.cia402_rig import SimulatedCia402Rig

_CHANNELS = itertools.count()

CRUISING = 90
"""A cycle of the short plan's run at its full speed, which it has from cycle 30 to 300."""


@dataclass
class Stage:
    """All parts of one run; also its clock.

    Attributes:
        prepared: The run.
        rehearsal: The simulated drives and platform.
        group: The executor's side of them.
        folder: The run folder.
        script: Called at the beginning of every cycle with the stage.
        cycle: Counted from 0.
        board: Operator requests.
        status: Of the run.
        lateness: Reported by the clock, in cycles.
        now: Its time with all lateness so far, [s].
        armed: The positions were read; from here on cycles count.
    """

    prepared: PreparedRun
    rehearsal: SimulatedCia402Rig
    group: DriveGroup
    folder: RunFolder
    script: Callable[[Stage], None]
    cycle: int = -1
    board: LocalRequests = field(default_factory=LocalRequests)
    lateness: float = 0.0
    now: float = 0.0
    armed: bool = False
    status: RunStatus | None = None
    recorder: Recorder | None = None
    mover: MotionHere | None = None
    drive_states: list[tuple[DriveState, ...]] = field(default_factory=list)

    def next_cycle(self) -> float:
        """The next cycle begins; what the script has for it happens. Arming is before the first."""
        if not self.armed:
            self.now += self.prepared.checked.table.cycle
            return 0.0
        self.cycle += 1
        self.drive_states.append(tuple(drive.state for drive in self.drives))
        self.script(self)
        late, self.lateness = self.lateness, 0.0
        self.now += (1.0 + late) * self.prepared.checked.table.cycle
        return late

    def time_left(self) -> float:
        """Replies are there already."""
        return 0.0

    def wait_to_decide(self) -> None:
        """Returns at once: no time passes within a cycle."""

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return self.rehearsal.drives

    @property
    def time(self) -> float:
        """Cycles times their length."""
        return max(0, self.cycle) * self.prepared.checked.table.cycle

    def run(
        self,
        trigger: FrameTrigger | None = None,
        progress: Callable[[float], None] = lambda _row: None,
        before_motion: Callable[[], None] = lambda: None,
    ) -> Outcome:
        """Arms and does the whole motion."""

        def on_armed(_denied: str) -> None:
            self.armed = True
            before_motion()

        self.status = RunStatus(self.prepared, self.folder.path, self.board, simulated_time=True)
        recorder = self.recorder = Recorder(
            self.prepared,
            self.folder,
            self.status,
            trigger=trigger,
            every=10,
            progress=progress,
            announce=lambda _text: None,
        )
        return run_along_path(self.prepared, self._mover, recorder, before_motion=on_armed)

    @contextmanager
    def _mover(self, motion: PathMotion) -> Iterator[MotionHere]:
        rehearsal = self.rehearsal
        drives = ReadyDrives(
            self.prepared.rig, self.group, lambda: rehearsal.pose, rehearsal.carry, ()
        )
        self.mover = MotionHere(motion, drives, self, self.board)
        with closing(motion):
            yield self.mover

    def events(self) -> list[RunEvent]:
        return self.folder.events()


def concluded(stage: Stage, outcome: Outcome) -> dict[str, Any]:
    """The summary of a run whose folder is written as the program writes it."""
    prepared, folder = stage.prepared, stage.folder
    folder.write_plan(prepared.plan.plan.document)
    folder.write_rig(prepared.rig.document)
    state, cause = outcome.state.value, outcome.cause
    course = RunCourse(outcome.started, "virtual", True, True, state, cause)
    assert stage.recorder is not None
    result = evaluate(prepared, outcome, CameraRecords(), course, stage.recorder)
    assert write_end(folder, course, result, outcome.log.events) == {}
    return result.summary


@contextmanager
def staged(
    prepared: PreparedRun, path: Path, script: Callable[[Stage], None], start: Pose | None = None
) -> Iterator[Stage]:
    """Configured drives on a separate virtual bus, with the platform at the start."""
    settings = BusSettings("virtual", f"scenario-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = SimulatedCia402Rig(
            prepared.rig, far, start or prepared.scene.start, prepared.scene.load
        )
        group = make_drive_group(prepared.rig, near, rehearsal.pump)
        group.configure()
        yield Stage(prepared, rehearsal, group, RunFolder.create(path), script)
        group.close()


def at(cycle: int, happens: Callable[[Stage], object]) -> Callable[[Stage], None]:
    """A script with one thing in it."""

    def script(stage: Stage) -> None:
        if stage.cycle == cycle:
            happens(stage)

    return script


def path_indices(prepared: PreparedRun, targets: Array) -> tuple[Array, Array, Array]:
    """Table indices of the targets, from the drive that moves most.

    Args:
        prepared: The run.
        targets: Set-points sent, shape (n, m), [counts].

    Returns:
        Index of each cycle, shape (n,); its uncertainty due to whole counts, shape (n,); and the
        distance of each target from the table at that index, shape (n, m), [counts].
    """
    table = prepared.checked.table.counts
    rows = np.arange(len(table), dtype=np.float64)
    most = int(np.argmax(np.abs(table[-1] - table[0])))
    sign = np.sign(table[-1, most] - table[0, most])
    index = np.interp(sign * targets[:, most], sign * table[:, most], rows)
    slope = np.interp(index, rows, np.abs(np.gradient(table[:, most])))
    there = np.column_stack([np.interp(index, rows, column) for column in table.T])
    return index, 1.0 / np.maximum(slope, 1e-9), np.abs(targets - there)
