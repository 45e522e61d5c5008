"""A run of a prepared plan on simulated drives, with a script of what happens in which cycle."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cdpr.poses import Array, Pose
from drivers.bus import BusSettings, open_bus
from drivers.cia402.states import DriveState
from drivers.drive_group import DriveGroup, make_drive_group
from executor.execution import Outcome, run_here
from executor.prepare import PreparedRun
from executor.recorder import Recorder, Trigger
from executor.run_folder import RunEvent, RunFolder
from executor.status import RunStatus
from executor.wishes import OwnBoard
from simulation.drive import SimulatedDrive
from simulation.rehearsal import Rehearsal

_CHANNELS = itertools.count()


@dataclass
class Stage:
    """Everything of one run; it is the run's clock too.

    Attributes:
        prepared: What is run.
        rehearsal: The simulated drives and platform.
        group: The executor's side of them.
        folder: The run folder.
        script: Called at the beginning of every cycle with the stage.
        cycle: Counted from 0.
        board: What the executor sees as the operator's wishes.
        status: What it tells those who ask.
        lateness: What the clock tells, in cycles.
    """

    prepared: PreparedRun
    rehearsal: Rehearsal
    group: DriveGroup
    folder: RunFolder
    script: Callable[[Stage], None]
    cycle: int = -1
    board: OwnBoard = field(default_factory=OwnBoard)
    lateness: float = 0.0
    status: RunStatus | None = None
    drive_states: list[tuple[DriveState, ...]] = field(default_factory=list)

    def next_cycle(self) -> float:
        """The next cycle begins; what the script has for it happens."""
        self.cycle += 1
        self.drive_states.append(tuple(drive.state for drive in self.drives))
        self.script(self)
        late, self.lateness = self.lateness, 0.0
        return late

    def time_left(self) -> float:
        """Replies are there already."""
        return 0.0

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return self.rehearsal.drives

    @property
    def time(self) -> float:
        """Cycles times their length."""
        return max(0, self.cycle) * self.prepared.checked.table.cycle

    def run(
        self,
        trigger: Trigger | None = None,
        progress: Callable[[float], None] = lambda _row: None,
        before_motion: Callable[[], None] = lambda: None,
    ) -> Outcome:
        """Arms and does the whole motion."""
        self.status = RunStatus(self.prepared, self.folder.path, self.board, simulated_time=True)
        recorder = Recorder(
            self.prepared,
            self.folder,
            self.status,
            trigger=trigger,
            every=10,
            progress=progress,
            announce=lambda _text: None,
        )
        return run_here(
            self.prepared,
            self.group,
            self,
            self.board,
            recorder,
            true_pose=None,
            carry=self.rehearsal.carry,
            before_motion=before_motion,
        )

    def events(self) -> list[RunEvent]:
        return self.folder.events()


@contextmanager
def staged(
    prepared: PreparedRun, path: Path, script: Callable[[Stage], None], start: Pose | None = None
) -> Iterator[Stage]:
    """Drives on a virtual bus of their own, configured; the platform stands at the start."""
    settings = BusSettings("virtual", f"scenario-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = Rehearsal(prepared.rig, far, start or prepared.scene.start, prepared.scene.load)
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
    """Where in the table the drives are told to be, from the one drive that turns most.

    Args:
        prepared: The run.
        targets: What was sent, shape (n, m), [counts].

    Returns:
        Index of each cycle, shape (n,); how inexact it is because counts are whole, shape (n,); and
        how far each target is from that place of the table, shape (n, m), [counts].
    """
    table = prepared.checked.table.counts
    rows = np.arange(len(table), dtype=np.float64)
    most = int(np.argmax(np.abs(table[-1] - table[0])))
    sign = np.sign(table[-1, most] - table[0, most])
    index = np.interp(sign * targets[:, most], sign * table[:, most], rows)
    slope = np.interp(index, rows, np.abs(np.gradient(table[:, most])))
    there = np.column_stack([np.interp(index, rows, column) for column in table.T])
    return index, 1.0 / np.maximum(slope, 1e-9), np.abs(targets - there)
