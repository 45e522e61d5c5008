"""Data of a report, read once from a run folder."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from executor.recording.clearance import ClearanceTable
from executor.recording.record_files import AGAIN
from executor.recording.run_folder import PICTURES, RunEvent, RunFolder
from executor.recording.tables import CycleTable, PoseTable
from model.errors import BadInput
from model.pages.page import prose
from model.plan import Plan
from model.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
    """A run as on disk; ``alone`` has the poses of each of several cameras, by name."""

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
        """Whether time was simulated."""
        return bool(self.summary["fast"])


def read_run(folder: RunFolder) -> RunData:
    """Reads a run folder.

    Raises:
        BadInput: A file of it is missing or was changed.
    """
    run = RunData(
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
    _require_agreement(run)
    return run


def _require_agreement(run: RunData) -> None:
    """Requires files of one run: the same stops."""
    stops = [stop.name for stop in run.plan.scene.stops]
    found = [stop["name"] for stop in run.summary["stops"]]
    if found != stops:
        raise BadInput(
            f"summary.json has the stops {found}, plan.json {stops}",
            where=str(run.folder.path),
            why="files of different runs are mixed",
            next_step=AGAIN,
        )


def missing_images(folder: RunFolder, tables: Iterable[PoseTable]) -> str:
    """States how many images are missing of those that the run kept; empty for none.

    Args:
        tables: Its poses, and those of each of several cameras.
    """
    kept = {name for table in tables for name in table.picture if name}
    missing = sum(not folder.has_image(name) for name in kept)
    return f"images missing from {PICTURES}/: {missing} of {len(kept)}" if missing else ""


# Markdown of the pages about faults.


def markdown(text: str) -> str:
    """Renders the Markdown of fault pages: headings, paragraphs, code and emphasis."""
    parts = []
    for block in filter(None, map(str.strip, text.split("\n\n"))):
        kind, content = ("h3", block[3:]) if block.startswith("## ") else ("p", block)
        content = re.sub(r"`([^`]+)`", r"<code>\1</code>", prose(" ".join(content.split())))
        content = re.sub(r"\*([^*]+)\*", r"<em>\1</em>", content)
        parts.append(f"<{kind}>{content}</{kind}>")
    return "".join(parts)
