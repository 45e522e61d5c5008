"""A run of a prepared plan on simulated drives, with a script of what happens in which cycle."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cdpr.poses import Array
from drivers.bus import BusSettings, open_bus
from drivers.cia402.states import DriveState
from drivers.drive_group import DriveGroup, make_drive_group
from executor.prepare import PreparedRun
from executor.run import Execution, Outcome
from executor.run_folder import RunEvent, RunFolder
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
        stop: What the executor sees as the operator's wish.
        lateness: What the clock tells, in cycles.
        simulated: This clock costs no time.
    """

    prepared: PreparedRun
    rehearsal: Rehearsal
    group: DriveGroup
    folder: RunFolder
    script: Callable[[Stage], None]
    cycle: int = -1
    stop: bool = False
    lateness: float = 0.0
    simulated: bool = True
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

    def execution(self) -> Execution:
        """Armed and ready to move."""
        execution = Execution(
            self.prepared,
            self.group,
            self,
            stop_requested=lambda: self.stop,
        )
        execution.loop.arm()
        return execution

    def run(self) -> Outcome:
        """The whole motion."""
        return self.execution().run(self.folder)

    def events(self) -> list[RunEvent]:
        return self.folder.events()


@contextmanager
def staged(prepared: PreparedRun, path: Path, script: Callable[[Stage], None]) -> Iterator[Stage]:
    """Drives on a virtual bus of their own, configured, with the platform at the plan's start."""
    settings = BusSettings("virtual", f"scenario-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = Rehearsal(prepared.rig, far, prepared.scene.start, prepared.scene.load)
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
