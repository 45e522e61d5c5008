"""Small files of a run folder: ``run.json``, schemas for reading, and appended lines.

Unknown keys are ignored: a later version may add some. docs/run-folder.md describes all keys; a
damaged or edited run folder causes one message that names the key.

``run.json`` (``schema_version`` 1) has ``started`` (ISO 8601, UTC), ``interface``, ``simulated``,
``fast``, ``versions``, ``final_state``, ``cause``, ``cycles``, ``cameras`` (as in
``summary.json``) and ``troubles`` (missing data, a sentence each). Until the motion is over, and
if the program is killed, all after ``versions`` are empty or 0; until it begins, ``started`` is the
time at which the folder was created.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from model.errors import BadInput, InvalidFile
from model.files.documents import check_version, write_atomic
from model.files.output import keep_names
from model.files.reading import TABLE_LIMIT, parse_json, read_bytes, read_json, read_text
from model.files.validation import problems_of

AGAIN = "restore the file from a copy, or run the plan again into a new folder"

#: No run has a larger number; squares of these are finite.
LARGEST_RECORDED = 1e15

Number = Annotated[float, Field(ge=-LARGEST_RECORDED, le=LARGEST_RECORDED, allow_inf_nan=False)]
Maybe = Number | None
Count = Annotated[int, Field(ge=0, le=2**53)]


def _is_moment(text: str) -> str:
    datetime.fromisoformat(text)
    return text


class _Record(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)


class EventRecord(_Record):
    """One line of ``events.jsonl``."""

    time_s: Number
    code: str
    text: str


class CheckRecord(_Record):
    """One check of the run."""

    name: str
    passed: bool
    text: str


class StopRecord(_Record):
    """Times at which a stop was reached and left."""

    name: str
    kind: str
    reached_s: Maybe
    left_s: Maybe


class SizeRecord(_Record):
    """Size of an error over the run."""

    max: Maybe
    rms: Maybe

    @model_validator(mode="after")
    def _both_or_none(self) -> SizeRecord:
        if (self.max is None) != (self.rms is None):
            raise ValueError("max and rms must both be numbers, or neither")
        return self


class LimitedSizeRecord(SizeRecord):
    """Size of an error, with its limit."""

    limit: Number


class TagErrorRecord(SizeRecord):
    """Size of an error, with the number of images."""

    frames: Count
    frames_without_pose: Count


class CameraRecordDocument(_Record):
    """Statistics of a camera's images."""

    name: str
    source: str
    pictures: Count
    poses: Count
    dropped: Count
    measuring_ms: Maybe
    failed: str


class ClearanceRecord(_Record):
    """The smallest clearance."""

    required: Number
    planned_min: Maybe
    measured_min: Maybe
    measured_uncertainty: Maybe
    measured_at_most: Maybe
    pair: Annotated[list[str], Field(min_length=2, max_length=2)]
    at_s: Maybe
    source: Literal["tag", "encoder"]

    @model_validator(mode="after")
    def _whole(self) -> ClearanceRecord:
        span = (self.measured_min, self.measured_uncertainty, self.measured_at_most)
        if self.measured_min is not None and None in span:
            raise ValueError("a measured_min needs measured_uncertainty and measured_at_most")
        return self


class TensionRecord(_Record):
    """The range of tensions."""

    min: Maybe
    max: Maybe
    planned_min: Maybe
    planned_max: Maybe
    lower_limit: Number
    upper_limit: Number

    @model_validator(mode="after")
    def _whole(self) -> TensionRecord:
        for first, second in ((self.min, self.max), (self.planned_min, self.planned_max)):
            if (first is None) != (second is None):
                raise ValueError("a smallest tension needs a largest one")
        return self


class LatenessRecord(_Record):
    """Lateness of cycles."""

    p50: Maybe
    p99: Maybe
    max: Maybe


class SummaryDocument(_Record):
    """``summary.json`` (schema_version 1)."""

    schema_version: Literal[1]
    verdict: Literal["PASSED", "FAILED", "STOPPED"]
    passed: bool
    sentence: str
    reasons: list[str]
    checks: list[CheckRecord]
    interface: str
    simulated: bool
    fast: bool
    started: Annotated[str, AfterValidator(_is_moment)]
    duration_s: Number
    cycles: Count
    cycle_ms: Number
    lost_replies: Count
    rejected_frames: Count
    error_frames: Count
    path_length_mm: Number
    travelled_mm: Maybe
    stops: list[StopRecord]
    following_error_mm: LimitedSizeRecord
    encoder_error_mm: SizeRecord
    tag_error_mm: TagErrorRecord | None
    cameras: list[CameraRecordDocument]
    clearance_mm: ClearanceRecord | None
    tension_n: TensionRecord
    lateness_ms: LatenessRecord | None
    final_state: str
    events: list[EventRecord]
    versions: dict[str, str]

    @model_validator(mode="after")
    def _verdict_fits(self) -> SummaryDocument:
        if self.passed != (self.verdict == "PASSED"):
            raise ValueError(f"the verdict is {self.verdict}, but passed is {self.passed}")
        return self


def _is_moment_somewhere(text: str) -> str:
    if datetime.fromisoformat(text).tzinfo is None:
        raise ValueError("has no time zone")
    return text


class CourseDocument(_Record):
    """``run.json`` (schema_version 1)."""

    schema_version: Literal[1]
    started: Annotated[str, AfterValidator(_is_moment_somewhere)]
    interface: str
    simulated: bool
    fast: bool
    versions: dict[str, str]
    final_state: str
    cause: str
    cycles: Count
    cameras: list[CameraRecordDocument] = []
    troubles: list[str] = []


Record = TypeVar("Record", bound=BaseModel)


def read_record(path: Path, model: type[Record]) -> tuple[Record, dict[str, Any]]:
    """Reads a JSON file of a run folder: checked, and unchanged.

    Raises:
        BadInput: It cannot be read.
        InvalidFile: It is of another version, or has invalid keys; all are named.
    """
    data = read_json(path, AGAIN)
    if isinstance(data, dict):
        check_version(data, model, path, {}, "run the plan again into a new folder")
    try:
        return model.model_validate(data), data
    except ValidationError as error:
        raise InvalidFile(str(path), problems_of(error, model, {}), AGAIN) from None


def read_events(path: Path, lines: Sequence[str]) -> list[EventRecord]:
    """The events in complete lines of ``events.jsonl``.

    Raises:
        BadInput: A line cannot be read.
    """
    events = []
    for number, line in enumerate(lines, start=1):
        try:
            events.append(EventRecord.model_validate(parse_json(line)))
        except ValueError:
            raise BadInput("not an event", where=f"{path}:{number}", next_step=AGAIN) from None
    return events


def append_lines(path: Path, text: str, *, fsync: bool) -> None:
    """Appends complete lines or nothing; with ``fsync`` they are on disk when this returns.

    Raises:
        OSError: The disk is full or gone.
    """
    with path.open("ab", buffering=0) as stream:
        before = os.fstat(stream.fileno()).st_size
        try:
            data = memoryview(text.encode())
            while data:
                data = data[stream.write(data) :]
            if fsync:
                os.fsync(stream.fileno())
                if before == 0:  # the file may be new
                    keep_names(path.parent)
        except OSError:
            with suppress(OSError):
                stream.truncate(before)  # the next line would follow a partial line
            raise


def whole_lines(path: Path) -> list[str]:
    """The complete lines of an appended file; a truncated last line is left out.

    Raises:
        BadInput: It cannot be read, or is not text.
    """
    data = read_bytes(path, TABLE_LIMIT)
    try:
        return data[: data.rfind(b"\n") + 1].decode().split("\n")[:-1]
    except UnicodeDecodeError:
        return read_text(path, TABLE_LIMIT).split("\n")  # raises with the reason


@dataclass(frozen=True, slots=True)
class CameraRecord:
    """Statistics of one camera's images in a run.

    Attributes:
        name: Of the camera in the rig file.
        source: Of its images.
        pictures: Number of requested images.
        poses: Number of images with a pose.
        dropped: Number of images due while it was busy, and not requested.
        measuring_ms: Median processing time; None if no image was measured.
        failed: Why it failed, or empty.
    """

    name: str
    source: str
    pictures: int
    poses: int
    dropped: int
    measuring_ms: float | None
    failed: str


#: Initial size of the file, [bytes], so that the end of the run fits on a full disk.
SIZE = 8192


@dataclass(frozen=True, slots=True)
class RunCourse:
    """Start and end of a run.

    Attributes:
        started: Start time, UTC.
        interface: Of the bus.
        simulated: The drives are simulated in the run's own process.
        fast: Simulated time.
        versions: Of programs and libraries, by name.
        final_state: Of the motion; empty until its end.
        cause: Why it did not finish, if it did not.
        cycles: Number of cycles; 0 until the end.
        cameras: Statistics of each camera's images; empty until the end.
        troubles: Missing data, a sentence each; any of them fails the run.
    """

    started: datetime
    interface: str
    simulated: bool
    fast: bool
    versions: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    final_state: str = ""
    cause: str = ""
    cycles: int = 0
    cameras: tuple[CameraRecord, ...] = ()
    troubles: tuple[str, ...] = ()

    @classmethod
    def load(cls, path: Path) -> RunCourse:
        """Reads the file.

        Raises:
            BadInput: It cannot be read.
            InvalidFile: It has invalid keys; all are named.
        """
        kept, _ = read_record(path, CourseDocument)
        values = {one.name: getattr(kept, one.name) for one in fields(cls)}
        values["started"] = datetime.fromisoformat(kept.started)
        values["cameras"] = tuple(CameraRecord(**dict(one)) for one in kept.cameras)
        return cls(**values | {"troubles": tuple(kept.troubles)})

    def save(self, path: Path) -> None:
        """Writes the file atomically.

        Raises:
            BadInput: The folder cannot be written to.
        """
        write_atomic(path, self._text().ljust(SIZE) + "\n")

    def overwrite(self, path: Path) -> None:
        """As `save`; on a full disk overwrites the file, with its texts cut to fit.

        Raises:
            BadInput: The file is gone, or cannot be written to.
        """
        try:
            self.save(path)
        except BadInput:
            if not self._overwritten(path):
                raise

    def _overwritten(self, path: Path) -> bool:
        text = self._text().encode()
        if len(text) > SIZE:
            text = self._short()._text().encode()
        with suppress(OSError), path.open("r+b", buffering=0) as stream:
            stream.write(text.ljust(SIZE) + b"\n")
            os.fsync(stream.fileno())
            return True
        return False

    def _short(self) -> RunCourse:
        cameras = (
            replace(camera, source=camera.source[:100], failed=camera.failed[:100])
            for camera in self.cameras
        )
        troubles = (trouble[:100] for trouble in self.troubles[:8])
        return replace(
            self, cause=self.cause[:256], cameras=tuple(cameras), troubles=tuple(troubles)
        )

    def _text(self) -> str:
        started = self.started.isoformat(timespec="milliseconds")
        data = {"schema_version": 1, **asdict(self), "started": started}
        return json.dumps(data, indent=1, ensure_ascii=False)


# Default run folders.


RUNS = Path("runs")


def free_folder(name: str) -> Path:
    """``runs/NAME``, with the first free number if it exists; another program may create it."""
    names = (RUNS / (name if n == 1 else f"{name}-{n}") for n in count(1))
    return next(path for path in names if not path.exists())


def dated_name() -> str:
    """Name of a run folder: date and local time."""
    return datetime.now().strftime("%Y-%m-%d_%H%M%S")
