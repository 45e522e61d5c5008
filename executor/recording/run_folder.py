"""The run folder: created once, written during the run, read by the report."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from executor.recording.checksums import REBUILT, require_unchanged_files
from executor.recording.clearance import ClearanceTable
from executor.recording.record_files import (
    AGAIN,
    RunCourse,
    SummaryDocument,
    append_lines,
    read_events,
    read_record,
    whole_lines,
)
from executor.recording.table_files import Table, TableFile
from executor.recording.tables import CycleTable, PoseTable
from model.errors import BadInput, Fault
from model.files.documents import write_atomic
from model.files.plan_file import PlanDocument
from model.files.reading import IMAGE_LIMIT, read_bytes
from model.files.rig_file import RigDocument
from model.plan import Plan, load_plan, save_plan
from model.rig import Rig, rig_from_document

PLAN, RIG, COURSE = "plan.json", "rig.json", "run.json"
SUMMARY, EVENTS, POSES, POSES_OF = "summary.json", "events.jsonl", "poses.csv", "poses-{}.csv"
CYCLES, CLEARANCE, FUSED = "cycles.csv", "clearance.csv", "fused.csv"
MCAP, REPORT, PICTURES = "run.mcap", "report.html", "pictures"
#: Of a motion of winches without a path, whose folder is no run folder.
WINCHES = "winches.csv"
#: Written before anything moves.
BEGUN = (PLAN, RIG, COURSE, EVENTS)
NEEDED = (*BEGUN, CYCLES, POSES, CLEARANCE, SUMMARY)
JPEG_QUALITY = 88


@dataclass(frozen=True, slots=True)
class RunEvent:
    """Event of a run.

    Attributes:
        time_s: Since the start of the run.
        code: Stable code, such as ``finished`` or ``following_error``.
        text: One sentence.
    """

    time_s: float
    code: str
    text: str

    @property
    def line(self) -> str:
        """Its line in the file of events."""
        return json.dumps(asdict(self), ensure_ascii=False) + "\n"


class RunFolder:
    """A run folder; make one with `create` or `open`.

    Args:
        path: The folder, which exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, path: Path) -> RunFolder:
        """Creates a new folder with its subfolder of images, and missing parents.

        Raises:
            BadInput: The path exists, or it cannot be created or written to.
        """
        cls.require_free(path)
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise _not_made(path, error.strerror or str(error)) from None
        folder = cls(path)
        try:
            (path / PICTURES).mkdir()
            (path / EVENTS).touch()
        except OSError as error:
            folder.discard()
            raise _not_made(path, error.strerror or str(error)) from None
        return folder

    @staticmethod
    def require_free(path: Path) -> None:
        """Requires that a folder can be created there, before a long preparation.

        Raises:
            BadInput: The path exists, or its parent is not a folder or is read-only.
        """
        if os.path.lexists(path):
            why = "a run never writes into another run's folder"
            then = "choose another folder or remove this one"
            raise BadInput("exists already", where=str(path), why=why, next_step=then)
        above = next(folder for folder in path.absolute().parents if os.path.exists(folder))
        if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise _not_made(path, f"{above} is not a writable folder")

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """The folder of a run that ended.

        Raises:
            BadInput: There is no such folder, or files of the run are missing or were changed.
        """
        if not (os.path.isdir(path) and os.access(path, os.R_OK | os.X_OK)):
            then = "give a folder that `cdpr run -o` created and that you may read"
            raise BadInput("no such run folder", where=str(path), next_step=then)
        require_unchanged_files(path)
        if missing := cls(path)._missing(NEEDED):
            raise cls(path)._incomplete(missing)
        return cls(path)

    @classmethod
    def open_cut_short(cls, path: Path) -> RunFolder:
        """The folder of a run that ended, or of one whose program was killed.

        Raises:
            BadInput: There is no such folder, it is not a run folder, the run is still active, or
                files of a run that ended were changed, or are missing and not among `REBUILT`.
        """
        folder = cls(path)
        if folder.is_whole or folder._missing(BEGUN):
            return cls.open(path)  # ended, or raises with what is missing
        require_unchanged_files(path)
        if folder._lost() or folder.is_active():
            raise folder._incomplete(folder._lost())
        return folder

    def _missing(self, names: Sequence[str]) -> list[str]:
        return [name for name in names if not os.path.isfile(self.path / name)]

    def _lost(self) -> list[str]:
        """Missing files of a run that ended, which no other file can replace."""
        return [] if self._missing([SUMMARY]) else sorted({*self._missing(NEEDED)} - REBUILT)

    def _incomplete(self, missing: Sequence[str]) -> BadInput:
        what = f"incomplete run folder: {', '.join(missing)} missing"
        why, then = "the run was interrupted", f"`cdpr report {quote(str(self.path))}` adds them"
        if self.is_active():
            what, why, then = "the run is still in progress", "", "wait, or see `cdpr monitor`"
        elif os.path.isfile(self.path / WINCHES):
            what = "the record of a motion of winches without a path, not of a run"
            why = "homing and jogs of single cables have no plan, verdict or report"
            then = f"read its {WINCHES}, such as by pandas.read_csv, and its {EVENTS}"
        elif self._missing(BEGUN):
            why += ", or this is another kind of folder"
            then = "give a folder that `cdpr run -o` created, or run the plan again"
        elif self._lost():
            why, then = "removed after the run; no other file holds the same data", AGAIN
        return BadInput(what, where=str(self.path), why=why, next_step=then)

    def has(self, name: str) -> bool:
        """Whether a file exists, not empty, and is whole if it was appended to or can be cut."""
        with suppress(OSError), (self.path / name).open("rb") as stream:
            stream.seek(-1, os.SEEK_END)
            return stream.read() == b"\n" or name not in (CYCLES, MCAP)
        return False

    @property
    def is_whole(self) -> bool:
        """Whether every file of a finished run exists."""
        return not self._missing(NEEDED)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Marks the run as active until the block or this program ends."""
        with (self.path / EVENTS).open("r+b") as stream:  # NFS: LOCK_EX only on writable files
            with suppress(OSError):  # a file system without locks
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield

    def is_active(self) -> bool:
        """Whether the program that writes the folder is still running."""
        with suppress(OSError), (self.path / EVENTS).open("rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False

    def discard(self) -> None:
        """Removes the folder: for a run that was refused before anything moved."""
        shutil.rmtree(self.path, ignore_errors=True)

    @property
    def mcap(self) -> Path:
        """Path of ``run.mcap``."""
        return self.path / MCAP

    @property
    def report(self) -> Path:
        """Path of ``report.html``."""
        return self.path / REPORT

    def write_plan(self, document: PlanDocument) -> None:
        """Keeps a copy of the plan.

        Raises:
            BadInput: The folder cannot be written to.
        """
        save_plan(document, self.path / PLAN)

    def plan(self) -> Plan:
        """The plan that was run.

        Raises:
            BadInput: The file was changed.
        """
        return load_plan(self.path / PLAN)

    def write_rig(self, document: RigDocument) -> None:
        """Keeps a copy of the rig file that the run used.

        Raises:
            BadInput: The folder cannot be written to.
        """
        self._write_json(RIG, document.model_dump(mode="json"))

    def rig(self) -> Rig:
        """The rig that was run.

        Raises:
            BadInput: The file was changed.
        """
        return rig_from_document(read_record(self.path / RIG, RigDocument)[0])

    def write_table(self, name: str, table: Table) -> None:
        """Writes one of the CSV files."""
        table.write_csv(self.path / name)

    def cycles(self) -> CycleTable:
        """Reads ``cycles.csv``.

        Raises:
            BadInput: It was changed, or has other cables than ``rig.json``.
        """
        return self._with_cables(CycleTable.read_csv(self.path / CYCLES), self.rig().cable_count)

    def cycles_cut_short(self, cable_count: int) -> CycleTable:
        """Reads the complete lines of ``cycles.csv`` of a killed program, if any.

        Raises:
            BadInput: A complete line cannot be read.
        """
        path = self.path / CYCLES
        if not (path.is_file() and (lines := whole_lines(path))):
            return CycleTable.empty(cable_count)
        return self._with_cables(CycleTable.of_file(TableFile(path, "\n".join(lines))), cable_count)

    def _with_cables(self, table: CycleTable, cables: int) -> CycleTable:
        if table.cable_count != cables:
            raise BadInput(
                f"{CYCLES} has {table.cable_count} cables, {RIG} has {cables}",
                where=str(self.path),
                why="files of different runs are mixed, or a file was changed after the run",
                next_step=AGAIN,
            )
        return table

    def write_course(self, course: RunCourse) -> None:
        """Writes ``run.json``, with room for its end.

        Raises:
            BadInput: The folder cannot be written to.
        """
        course.save(self.path / COURSE)

    def write_end_of_course(self, course: RunCourse) -> None:
        """As `write_course`; on a full disk overwrites the file.

        Raises:
            BadInput: The folder cannot be written to.
        """
        course.overwrite(self.path / COURSE)

    def course(self) -> RunCourse:
        """Reads ``run.json``.

        Raises:
            BadInput: It was changed.
        """
        return RunCourse.load(self.path / COURSE)

    def poses(self) -> PoseTable:
        """Reads ``poses.csv``."""
        return PoseTable.read_csv(self.path / POSES)

    def poses_by_camera(self) -> dict[str, PoseTable]:
        """Reads the poses of each of several cameras; empty for a single camera."""
        names = sorted(one.name for one in self.course().cameras or self.rig().cameras)
        files = {name: self.path / POSES_OF.format(name) for name in names if len(names) > 1}
        return {name: PoseTable.read_csv(file) for name, file in files.items() if file.is_file()}

    def clearance(self) -> ClearanceTable:
        """Reads ``clearance.csv``."""
        return ClearanceTable.read_csv(self.path / CLEARANCE)

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Writes ``summary.json`` (see `executor.recording.summary`)."""
        self._write_json(SUMMARY, summary)

    def summary(self) -> dict[str, Any]:
        """Reads ``summary.json``.

        Raises:
            BadInput: It is not JSON, of another version, or damaged.
        """
        return read_record(self.path / SUMMARY, SummaryDocument)[1]

    def append_event(self, event: RunEvent) -> None:
        """Appends a line to ``events.jsonl``; it is on disk when this returns.

        Raises:
            Fault: The disk is full or gone.
        """
        self._append(EVENTS, event.line, fsync=True)

    def append_cycles(self, lines: str, *, fsync: bool) -> None:
        """Appends lines to ``cycles.csv``; with ``fsync`` they are on disk when this returns.

        Raises:
            Fault: The disk is full or gone.
        """
        self._append(CYCLES, lines, fsync=fsync)

    def events(self) -> list[RunEvent]:
        """Reads ``events.jsonl``; a last line truncated by a crash is left out.

        Raises:
            BadInput: Another line cannot be read.
        """
        path = self.path / EVENTS
        return [RunEvent(**dict(event)) for event in read_events(path, whole_lines(path))]

    def write_events(self, events: Sequence[RunEvent]) -> None:
        """Rewrites ``events.jsonl``, if some events could not be appended.

        Raises:
            BadInput: The folder cannot be written to.
        """
        write_atomic(self.path / EVENTS, "".join(event.line for event in events))

    def write_image(self, frame: int, image: NDArray[np.uint8], camera: str = "") -> str:
        """Keeps a camera image, grey or BGR, as JPEG.

        Args:
            frame: Frame number.
            image: Shape (height, width) or (height, width, 3).
            camera: Name of the camera, if there are several; each has its own folder.

        Returns:
            Its name inside the folder, ``pictures/frame_<frame>.jpg`` or
            ``pictures/<camera>/frame_<frame>.jpg``.

        Raises:
            Fault: The disk is full or gone.
        """
        import cv2

        name = "/".join([PICTURES, *([camera] if camera else []), f"frame_{frame:06d}.jpg"])
        done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            raise ValueError(f"no image: shape {image.shape}, type {image.dtype}")
        try:
            (self.path / name).parent.mkdir(exist_ok=True)
            (self.path / name).write_bytes(data.tobytes())
        except OSError as error:
            raise self._not_written(name, error) from None
        return name

    def has_image(self, name: str) -> bool:
        """Whether an image that was kept still exists; archives often lack them."""
        return os.path.isfile(self.path / name)  # False for a name that cannot be a path

    def image(self, name: str) -> bytes:
        """The JPEG of a name from `write_image`.

        Raises:
            BadInput: It does not exist, or is not in the folder of images.
        """
        try:
            file = (self.path / name).resolve()
            if not file.is_relative_to((self.path / PICTURES).resolve()):
                raise FileNotFoundError(0, f"it is not in {PICTURES}")
            return read_bytes(file, IMAGE_LIMIT)
        except OSError as error:
            what, why = "the image cannot be read", error.strerror or str(error)
            raise BadInput(what, where=str(self.path / name), why=why) from None

    def _append(self, name: str, text: str, *, fsync: bool) -> None:
        try:
            append_lines(self.path / name, text, fsync=fsync)
        except OSError as error:
            raise self._not_written(name, error) from None

    def _write_json(self, name: str, data: Any) -> None:
        text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
        write_atomic(self.path / name, text + "\n")

    def _not_written(self, name: str, error: OSError) -> Fault:
        return Fault(
            "the run folder cannot be written",
            where=str(self.path / name),
            why=error.strerror or str(error),
            next_step="free some space; the motion continues without the record",
        )


def _not_made(path: Path, why: str) -> BadInput:
    return BadInput(
        "the run folder cannot be created",
        where=str(path),
        why=why,
        next_step="choose another folder with write permission and free space",
    )
