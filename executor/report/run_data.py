"""All that a report is made from, read once from a run folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cdpr.plan import Plan
from cdpr.rig import Rig
from executor.clearance_table import ClearanceTable
from executor.cycle_table import CycleTable
from executor.pose_table import PoseTable
from executor.run_folder import RunEvent, RunFolder


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
    """A run as it lies on disk; ``alone`` is what each of several cameras measured, by its name."""

    folder: RunFolder
    plan: Plan
    rig: Rig
    cycles: CycleTable
    poses: PoseTable
    alone: dict[str, PoseTable]
    clearance: ClearanceTable
    summary: dict[str, Any]
    events: tuple[RunEvent, ...]

    @property
    def fast(self) -> bool:
        """True when time was simulated."""
        return bool(self.summary["fast"])


def read_run(folder: RunFolder) -> RunData:
    """Reads a run folder.

    Raises:
        BadInput: A file of it is missing or was changed.
    """
    return RunData(
        folder=folder,
        plan=folder.plan(),
        rig=folder.rig(),
        cycles=folder.cycles(),
        poses=folder.poses(),
        alone=folder.poses_by_camera(),
        clearance=folder.clearance(),
        summary=folder.summary(),
        events=tuple(folder.events()),
    )
