"""The folder that a run leaves: made once, written while the run goes on, read by the report."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from cdpr.documents import problems_of, read_text, write_atomic
from cdpr.errors import BadInput, Fault, InvalidFile
from cdpr.plan import Plan, load_plan, save_plan
from cdpr.plan_file import PlanDocument
from cdpr.rig import Rig, rig_from_document
from cdpr.rig_file import RigDocument
from executor.clearance_table import ClearanceTable
from executor.cycle_table import CycleTable
from executor.fused_table import FusedTable
from executor.pose_table import PoseTable

PLAN, RIG, SUMMARY, EVENTS = "plan.json", "rig.json", "summary.json", "events.jsonl"
CYCLES, POSES, CLEARANCE = "cycles.csv", "poses.csv", "clearance.csv"
FUSED, POSES_OF = "fused.csv", "poses-{}.csv"
MCAP, REPORT, PICTURES = "run.mcap", "report.html", "pictures"
NEEDED = (PLAN, RIG, CYCLES, POSES, CLEARANCE, SUMMARY, EVENTS)
JPEG_QUALITY = 88


@dataclass(frozen=True, slots=True)
class RunEvent:
    """Something that happened during a run.

    Attributes:
        time_s: Since the start of the run.
        code: Stable short name, such as ``finished`` or ``following_error``.
        text: One sentence.
    """

    time_s: float
    code: str
    text: str


class RunFolder:
    """A run's folder; make one with `create` or `open`.

    Args:
        path: The folder, which exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, path: Path) -> RunFolder:
        """Makes a new folder, empty but for its folder of pictures.

        Raises:
            BadInput: The path exists, its parent is missing, or it cannot be written to.
        """
        cls.require_free(path)
        try:
            path.mkdir()
        except OSError as error:
            raise BadInput(
                "the run folder cannot be made",
                where=str(path),
                why=error.strerror or str(error),
                next_step="choose a place whose folder exists and that you may write to",
            ) from None
        folder = cls(path)
        try:
            (path / PICTURES).mkdir()
            (path / EVENTS).touch()
        except OSError as error:
            folder.discard()
            raise BadInput(
                "the run folder cannot be written to",
                where=str(path),
                why=error.strerror or str(error),
                next_step="free some space or choose another place",
            ) from None
        return folder

    @staticmethod
    def require_free(path: Path) -> None:
        """Says before a long preparation that a folder cannot be made there.

        Raises:
            BadInput: The path exists, or its parent is missing or read-only.
        """
        if path.exists() or path.is_symlink():
            raise BadInput(
                "exists already",
                where=str(path),
                why="a run never writes into the folder of another",
                next_step="choose another folder or remove this one",
            )
        if not path.parent.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
            raise BadInput(
                "the run folder cannot be made",
                where=str(path),
                why=f"{path.parent} is no folder that you may write to",
                next_step="choose a place whose folder exists and that you may write to",
            )

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """The folder of a run that ended.

        Raises:
            BadInput: There is no such folder, or a file of the run is missing; all are named.
        """
        if not path.is_dir():
            raise BadInput(
                "no such run folder",
                where=str(path),
                next_step="give the folder that `cdpr run -o` made",
            )
        missing = [name for name in NEEDED if not (path / name).is_file()]
        if missing:
            raise BadInput(
                f"not a whole run folder: {', '.join(missing)} missing",
                where=str(path),
                why="the run was cut short, or this is another folder",
                next_step="give a folder that `cdpr run -o` made, or run the plan again",
            )
        return cls(path)

    def discard(self) -> None:
        """Removes the folder: for a run that was refused before anything moved."""
        shutil.rmtree(self.path, ignore_errors=True)

    @property
    def mcap(self) -> Path:
        """Where ``run.mcap`` is."""
        return self.path / MCAP

    @property
    def report(self) -> Path:
        """Where ``report.html`` is."""
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
        try:
            document = RigDocument.model_validate(self._read_json(RIG))
        except ValidationError as error:
            problems = problems_of(error, RigDocument, {})
            raise InvalidFile(str(self.path / RIG), problems) from None
        return rig_from_document(document)

    def write_cycles(self, table: CycleTable) -> None:
        """Writes ``cycles.csv``."""
        table.write_csv(self.path / CYCLES)

    def cycles(self) -> CycleTable:
        """Reads ``cycles.csv``."""
        return CycleTable.read_csv(self.path / CYCLES)

    def write_poses(self, table: PoseTable) -> None:
        """Writes ``poses.csv``."""
        table.write_csv(self.path / POSES)

    def poses(self) -> PoseTable:
        """Reads ``poses.csv``."""
        return PoseTable.read_csv(self.path / POSES)

    def write_poses_of(self, camera: str, table: PoseTable) -> None:
        """Writes ``poses-<camera>.csv``: what one of several cameras measured alone."""
        table.write_csv(self.path / POSES_OF.format(camera))

    def poses_by_camera(self) -> dict[str, PoseTable]:
        """Reads what each of several cameras measured alone; nothing of a run with one."""
        begin, end = POSES_OF.split("{}")
        names = [path.name for path in self.path.glob(POSES_OF.format("*"))]
        return {
            name.removeprefix(begin).removesuffix(end): PoseTable.read_csv(self.path / name)
            for name in sorted(names)
        }

    def write_clearance(self, table: ClearanceTable) -> None:
        """Writes ``clearance.csv``."""
        table.write_csv(self.path / CLEARANCE)

    def clearance(self) -> ClearanceTable:
        """Reads ``clearance.csv``."""
        return ClearanceTable.read_csv(self.path / CLEARANCE)

    def write_fused(self, table: FusedTable) -> None:
        """Writes ``fused.csv``."""
        table.write_csv(self.path / FUSED)

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Writes ``summary.json`` (see `executor.summary`)."""
        self._write_json(SUMMARY, summary)

    def summary(self) -> dict[str, Any]:
        """Reads ``summary.json``.

        Raises:
            BadInput: It is no JSON or of another version.
        """
        summary = self._read_json(SUMMARY)
        if not isinstance(summary, dict) or summary.get("schema_version") != 1:
            raise BadInput(
                "not a summary of schema_version 1",
                where=str(self.path / SUMMARY),
                next_step="run the plan again with this version of cdpr",
            )
        return summary

    def append_event(self, event: RunEvent) -> None:
        """Adds a line to ``events.jsonl``; it is on disk when this returns.

        Raises:
            Fault: The disk is full or gone.
        """
        try:
            with (self.path / EVENTS).open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(asdict(event), ensure_ascii=False) + "\n")
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise self._not_written(EVENTS, error) from None

    def events(self) -> list[RunEvent]:
        """Reads ``events.jsonl``; a last line that was cut by a crash is left out.

        Raises:
            BadInput: Another line cannot be read.
        """
        lines = read_text(self.path / EVENTS).splitlines(keepends=True)
        events = []
        for number, line in enumerate(lines, start=1):
            try:
                events.append(RunEvent(**json.loads(line)))
            except (ValueError, TypeError):
                if number == len(lines) and not line.endswith("\n"):
                    break
                raise BadInput("not an event", where=f"{self.path / EVENTS}:{number}") from None
        return events

    def write_picture(self, frame: int, image: NDArray[np.uint8], camera: str = "") -> str:
        """Keeps a camera picture, grey or BGR, as JPEG.

        Args:
            frame: Number of the moment at which it was taken.
            image: Shape (height, width) or (height, width, 3).
            camera: Which of several cameras took it; each has a folder of its own.

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
            raise ValueError(f"no picture: shape {image.shape}, type {image.dtype}")
        try:
            (self.path / name).parent.mkdir(exist_ok=True)
            (self.path / name).write_bytes(data.tobytes())
        except OSError as error:
            raise self._not_written(name, error) from None
        return name

    def picture(self, name: str) -> bytes:
        """The JPEG that `write_picture` named.

        Raises:
            BadInput: It is gone, or not in the folder of pictures.
        """
        try:
            place = (self.path / name).resolve()
            if not place.is_relative_to((self.path / PICTURES).resolve()):
                raise FileNotFoundError(0, f"it is not in {PICTURES}")
            return place.read_bytes()
        except OSError as error:
            raise BadInput(
                "the picture cannot be read",
                where=str(self.path / name),
                why=error.strerror or str(error),
            ) from None

    def _write_json(self, name: str, data: Any) -> None:
        text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
        write_atomic(self.path / name, text + "\n")

    def _read_json(self, name: str) -> Any:
        try:
            return json.loads(read_text(self.path / name))
        except json.JSONDecodeError as error:
            raise BadInput(
                f"not valid JSON: {error.msg}",
                where=f"{self.path / name}:{error.lineno}:{error.colno}",
                next_step="restore the file, or run the plan again into a new folder",
            ) from None

    def _not_written(self, name: str, error: OSError) -> Fault:
        return Fault(
            "the run folder cannot be written to",
            where=str(self.path / name),
            why=error.strerror or str(error),
            next_step="free some space; the motion does not depend on it, the record does",
        )
