"""Result of a run: new folder, verdict, files, and its tables as columns."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from drivers.can_bus import IN_PROCESS
from executor.interlock.fault_latch import AFTER_A_FAULT
from executor.recording.clearance import ClearanceTable
from executor.recording.record_files import free_folder
from executor.recording.run_folder import CLEARANCE, CYCLES, POSES, RunFolder
from executor.recording.tables import CycleTable, PoseTable
from executor.safety.fault_messages import faults_among
from model.errors import BadInput, path_of
from model.files.reading import TABLE_LIMIT
from model.pages.page import html_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Why a file is missing where its disk, or the user's share of it, is full.
_FULL = {os.strerror(number) for number in (errno.ENOSPC, errno.EDQUOT)}
#: Codes of events after which drives may have no torque, so that its reset needs care.
_RELEASES = ("drive_fault", "not_held")

Columns = dict[str, NDArray[Any]]
"""A table of a run folder: read-only arrays of equal length by column name, with the unit in it.

The type of an array depends on its name only: text, whole numbers or other numbers."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """Result of a run; its tables are read from its folder on first access.

    Attributes:
        folder: Run folder, as an absolute path.
        summary: The content of ``summary.json``.
        missing: Files of the folder that could not be written, and why.
        report: The page about the run; None where it could not be made.
    """

    folder: Path
    summary: dict[str, Any]
    missing: Mapping[str, str] = field(default_factory=dict)
    report: Path | None = None
    _given: Path = field(init=False)

    def __post_init__(self) -> None:
        """Makes the paths independent of the current folder, unless that was removed."""
        object.__setattr__(self, "_given", self.folder)
        with suppress(OSError):
            object.__setattr__(self, "folder", self.folder.absolute())
            if self.report is not None:
                object.__setattr__(self, "report", self.report.absolute())

    @property
    def shown_folder(self) -> Path:
        """The folder in messages: as it was given, while that path leads to it."""
        with suppress(OSError):  # the current folder may have been removed
            if self._given.absolute() == self.folder:
                return self._given
        return self.folder

    @property
    def verdict(self) -> str:
        """``PASSED``, ``STOPPED`` or ``FAILED``."""
        return str(self.summary["verdict"])

    @property
    def passed(self) -> bool:
        """Whether the run finished within all limits."""
        return bool(self.summary["passed"])

    @property
    def sentence(self) -> str:
        """The verdict in a sentence."""
        return str(self.summary["sentence"])

    @property
    def exit_code(self) -> int:
        """0 for a run that passed, 130 when the operator stopped it, 1 otherwise."""
        if self.passed:
            return 0
        return 130 if self.verdict == "STOPPED" else 1

    def details(self) -> list[str]:
        """Reasons for the verdict; after a failure also fault pages and the next step."""
        lines = [str(reason) for reason in self.summary["reasons"]]
        if self.verdict == "FAILED":
            codes = faults_among(event["code"] for event in self.summary["events"])
            lines += [f"details: cdpr explain {code}" for code in codes]
            lines.append(f"next: {self._next_step()}")
        return lines

    def _next_step(self) -> str:
        """Next step after a failed run."""
        if self.summary["final_state"] in ("finished", "stopped"):
            return "check the report, and correct what the reasons name, before the next run"
        if self.summary.get("interface") == IN_PROCESS:
            return "find the cause, then run again into a new folder"
        if not {event["code"] for event in self.summary["events"]}.isdisjoint(_RELEASES):
            return AFTER_A_FAULT
        return "find the cause and check the platform, then run `cdpr reset RIG`"

    def missing_text(self) -> str:
        """Message on files that could not be written; empty if all were."""
        if not self.missing:
            return ""
        lines = [f"{self.shown_folder}: some files of the run could not be written"]
        for why in dict.fromkeys(self.missing.values()):
            names = [name for name, reason in self.missing.items() if reason == why]
            lines.append(f"  why: {', '.join(names)}: {why}")
        removed = "the folder was removed during the run, and its record with it"
        full = "free some disk space, then " if _FULL & {*self.missing.values()} else ""
        again = (
            f"{full}run `cdpr report {quote(str(self.shown_folder))}` to write the missing files"
        )
        cycles = self.folder / CYCLES
        if cycles.is_file() and cycles.stat().st_size > TABLE_LIMIT:
            again += " on a computer with more memory, which can read the record"
        if POSES in self.missing and not (self.folder / POSES).is_file():
            again += f"; {POSES} cannot be made again, so that the new verdict is FAILED"
        then = again if self.folder.is_dir() else removed
        lines.append(f"  next: the verdict and the exit code are valid; {then}")
        return "\n".join(lines)

    @cached_property
    def cycles(self) -> Columns:
        """Every cycle of the loop: the columns of ``cycles.csv``."""
        return CycleTable.read_columns(self.folder / CYCLES)

    @cached_property
    def poses(self) -> Columns:
        """Fused camera poses: the columns of ``poses.csv``."""
        return PoseTable.read_columns(self.folder / POSES)

    @cached_property
    def clearance(self) -> Columns:
        """Distances to obstacles: the columns of ``clearance.csv``."""
        return ClearanceTable.read_columns(self.folder / CLEARANCE)

    @property
    def _measured(self) -> dict[str, Any] | None:
        """The smallest measured clearance; None if none was measured."""
        known: dict[str, Any] | None = self.summary.get("clearance_mm")
        return None if known is None or known["measured_min"] is None else known

    @property
    def smallest_clearance(self) -> float:
        """The smallest measured clearance, [m]; NaN if none was measured."""
        known = self._measured
        return float("nan") if known is None else float(known["measured_min"]) / 1e3

    @property
    def clearance_interval(self) -> tuple[float, float]:
        """95 % interval of the true clearance where the smallest was measured, [m]; else NaN."""
        known = self._measured
        if known is None:
            return float("nan"), float("nan")
        low = known["measured_min"] - known["measured_uncertainty"]
        return low / 1e3, known["measured_at_most"] / 1e3

    def plot(self) -> Figure:
        """A figure of error, tensions and clearance over time."""
        from executor.report.figures import run_figure  # loads matplotlib

        return run_figure(self.cycles, self.clearance)

    def __repr__(self) -> str:
        """Verdict and folder."""
        return f"<RunResult {self.verdict} in {self.shown_folder}: {self.sentence}>"

    def _repr_html_(self) -> str:
        """For notebooks."""
        low, high = (bound * 1e3 for bound in self.clearance_interval)
        least = f"{self.smallest_clearance * 1e3:.2f} mm (95 % interval {low:.2f}–{high:.2f} mm)"
        rows = [
            ("verdict", self.verdict),
            ("why", self.sentence),
            ("folder", str(self.shown_folder)),
            ("clearance", least if self._measured else "not measured"),
        ]
        return html_table(f"Run {self.folder.name}", rows)


def load_run(folder: str | Path) -> RunResult:
    """The result of a finished run, from its folder.

    Raises:
        BadInput: There is no such folder, or a file of the run is missing or differs from its
            checksum (`executor.recording.checksums`).
    """
    opened = RunFolder.open(path_of(folder))
    page = opened.report if opened.report.is_file() else None
    return RunResult(opened.path, opened.summary(), report=page)


# New run folders.


def folder_maker(path: Path | str | None, name: str) -> Callable[[], RunFolder]:
    """Creates a run folder when it is called, at the end of a long preparation.

    Args:
        path: Of the folder; None for ``runs/NAME``, with the first number that is free then.
        name: For None.

    Raises:
        BadInput: It could not be created now.
    """
    given = free_folder(name) if path is None else path_of(path)
    RunFolder.require_free(given)
    return partial(_numbered, name) if path is None else partial(RunFolder.create, given)


def _numbered(name: str) -> RunFolder:
    while True:
        path = free_folder(name)
        try:
            return RunFolder.create(path)
        except BadInput:
            if not path.exists():  # else another program created it meanwhile
                raise
