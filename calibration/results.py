"""Calibration results as dated YAML files, beside the rig file and never written into it.

Every kind of result has the keys of `ResultDocument`, its own keys as in the rig file, and a
verdict: one sentence on what it is good for, and the next steps where it is not.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar

import yaml
from pydantic import AfterValidator, Field

from calibration.statistics import Interval
from model.errors import BadInput, path_of, require_text
from model.files.documents import (
    AnyNonNegative,
    AnyNumber,
    Document,
    content_hash,
    document_hash,
    write_atomic,
)
from model.files.output import make_missing_folder, require_new_file
from model.files.rig_file import RigDocument
from model.pages.page import html_table

USE = (
    "use it: pass the result's file with --calibration, in Python rig.with_calibration(), or write"
    " a new rig file with `cdpr calibrate apply`"
)
"""Next step for a result that is good enough."""


@dataclass(frozen=True, slots=True)
class Issue:
    """A reason why a calibration is not good enough.

    Attributes:
        reason: What is wrong, with the measured value and its limit.
        next_step: How to fix it.
    """

    reason: str
    next_step: str


@dataclass(frozen=True, slots=True)
class CalibrationVerdict:
    """What a calibration is good for.

    Attributes:
        error: Error of measurements made with it, 95 %, [m].
        wanted: Required error, [m].
        where: Location or conditions for that error, such as ``at 0.6 m``.
        reasons: Why it is not good enough; empty when it is.
        next_steps: How to fix each reason, or how to use a good result.
    """

    error: float
    wanted: float
    where: str
    reasons: tuple[str, ...]
    next_steps: tuple[str, ...]

    @classmethod
    def of(cls, error: float, wanted: float, where: str, issues: Sequence[Issue]) -> Self:
        """The verdict from a list of issues, each next step listed once."""
        reasons = tuple(issue.reason for issue in issues)
        steps = tuple(dict.fromkeys(issue.next_step for issue in issues)) or (USE,)
        return cls(error, wanted, where, reasons, steps)

    @property
    def good(self) -> bool:
        """Whether it is good enough."""
        return not self.reasons

    def __str__(self) -> str:
        """The verdict in a sentence."""
        if self.good:
            return f"good enough for {self.error * 1e3:.2g} mm {self.where}"
        return f"not good enough: {'; '.join(self.reasons)}"


def beyond(error: float, wanted: float) -> str:
    """An error and the smaller one that is required, as numbers that differ, [m]."""
    for digits in (2, 3):
        found, needed = (f"{value * 1e3:.{digits}g}" for value in (error, wanted))
        if found != needed:
            return f"{found} mm; {needed} mm are required"
    return f"just over {needed} mm; {needed} mm are required"


# Result files.


def _is_date(text: str) -> str:
    date.fromisoformat(text)
    return text


Bounds = Annotated[list[AnyNumber], Field(min_length=2, max_length=2)]
"""Both ends of a 95 % interval."""


class ResultDocument(Document, ABC):
    """Keys common to all calibration results."""

    order: ClassVar[int]
    """Results of lower order are applied first: those of higher order depend on them."""
    is_of_named_part: ClassVar[bool] = True
    """Whether `name` is that of a part of the rig: results of others cannot be compared."""

    schema_version: Literal[1] = 1
    kind: str
    name: str = Field(description="of what was calibrated, such as the camera in the rig file")
    date: Annotated[str, AfterValidator(_is_date)]
    rests_on: str = Field(
        default="", description="hash of the parts of the rig file taken as known"
    )
    data_sha256: str = Field(description="of the measurements")
    intervals: dict[str, Bounds] = Field(description="95 %, by name with unit")
    error_mm: AnyNonNegative = Field(description="of measurements with it, 95 %")
    wanted_mm: AnyNonNegative = Field(description="required error")
    verdict: str
    good_enough: bool
    next_steps: list[str]
    unused: dict[str, str] = Field(default={}, description="why data were left out, by name")
    hash: str = Field(default="", description="over the rest of the file")

    @property
    def follows(self) -> str:
        """Name of the result of its kind that is applied before, if given; empty for none."""
        return ""

    @property
    def file_name(self) -> str:
        """Name of its file."""
        return result_file_name(self.kind, self.name, self.date)

    def sealed(self) -> Self:
        """The result with its hash, which detects later edits."""
        return self.model_copy(update={"hash": document_hash(self, {"hash"})})

    @property
    def stated(self) -> dict[str, Interval]:
        """Estimates, by name with unit."""
        return {name: Interval.between(*ends) for name, ends in self.intervals.items()}

    def in_words(self) -> list[tuple[str, str]]:
        """Human-readable estimates: names with unit, and values with their half widths."""
        return [(name, str(interval)) for name, interval in self.stated.items()]

    def changes_to(self, other: Self) -> dict[str, float]:
        """Values of another result minus these, by name with unit."""
        mine, others = self.stated, other.stated
        return {name: others[name].value - mine[name].value for name in mine if name in others}

    @abstractmethod
    def apart_mm(self, other: Self) -> float:
        """RMS distance between measurements made with either result, [mm]."""

    @abstractmethod
    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this result applied.

        Raises:
            BadInput: The result is not about this rig.
        """

    def require_basis(self, parts: object, what: str) -> None:
        """Refuses a rig whose parts differ from those this result depends on.

        Args:
            parts: The JSON-like parts of the rig file that the result takes as known.
            what: Their names, for the message.

        Raises:
            BadInput: They differ.
        """
        if self.rests_on != content_hash(parts):
            raise BadInput(
                f"this result was made with {what} that differ from the rig's",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                why="the rig file was changed since, it is from another rig, or a calibration that"
                " was applied then is not applied now",
                next_step=f"pass the calibrations it was made with, or run `cdpr calibrate"
                f" {self.kind}` again",
            )


def common_keys(
    name: str,
    on: date,
    data_hash: str,
    intervals: Mapping[str, Interval],
    verdict: CalibrationVerdict,
    unused: Mapping[str, str],
    rests_on: object = None,
) -> dict[str, Any]:
    """The keys common to every result.

    Args:
        intervals: Estimates with their intervals, by name with unit.
        unused: Why data were left out, by name.
        rests_on: The JSON-like parts of the rig file that were taken as known; None for none.
    """
    return {
        "name": name,
        "date": on.isoformat(),
        "rests_on": "" if rests_on is None else content_hash(rests_on),
        "data_sha256": data_hash,
        "intervals": {key: interval.bounds for key, interval in intervals.items()},
        "error_mm": verdict.error * 1e3,
        "wanted_mm": verdict.wanted * 1e3,
        "verdict": str(verdict),
        "good_enough": verdict.good,
        "next_steps": list(verdict.next_steps),
        "unused": dict(unused),
    }


def result_file_name(kind: str, name: str, day: str) -> str:
    """File name of a result."""
    return f"calibration_{kind}_{name}_{day}.yaml"


def require_file_name(name: str, where: str) -> None:
    """Refuses a name that cannot be part of a file name, before the long computation.

    Raises:
        BadInput: The name is empty, or has a slash or a null character.
    """
    require_text(name=name)
    if not name or "/" in name or "\0" in name:
        raise BadInput(
            f"{name!r} cannot be part of a file name",
            where=where,
            next_step="use a name without a slash",
        )


def write_result(folder: Path, result: ResultDocument) -> Path:
    """Writes a sealed result into a folder, atomically; returns the file's path.

    Raises:
        BadInput: The folder cannot be written to.
    """
    path = folder / result.file_name
    plain = result.sealed().model_dump(mode="json")
    write_atomic(path, yaml.safe_dump(plain, sort_keys=False, allow_unicode=True))
    return path


# Hash of the measurements behind a result, in one form for all kinds.


def data_hash(pieces: Iterable[bytes]) -> str:
    """``sha256:`` and the hash of all pieces in order."""
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return f"sha256:{digest.hexdigest()}"


# A finished calibration, and where to write it.


Result = TypeVar("Result", bound=ResultDocument, covariant=True)
Found = TypeVar("Found", covariant=True)
Quality = TypeVar("Quality", covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration(Generic[Result, Found, Quality]):
    """A finished calibration.

    Attributes:
        result: As written to the file: estimates, intervals, verdict.
        page: The report, HTML.
        found: The fit behind the result.
        quality: Its assessed quality.
        facts: Human-readable details beside the estimates.
        files: Paths of result and report, where written.
    """

    result: Result
    page: str
    found: Found
    quality: Quality
    facts: Sequence[tuple[str, str]] = ()
    files: tuple[Path, ...] = ()

    @property
    def verdict(self) -> str:
        """What it is good for, in a sentence."""
        return self.result.verdict

    @property
    def good_enough(self) -> bool:
        """Whether its verdict is good."""
        return self.result.good_enough

    def __repr__(self) -> str:
        """Kind, name, date and verdict."""
        about = self.result
        return f"<Calibration {about.kind} {about.name}, {about.date}: {about.verdict}>"

    def _repr_html_(self) -> str:
        """Table of results for notebooks."""
        rows = [*self.result.in_words(), ("verdict", self.verdict)]
        return html_table(f"Calibration {self.result.kind} {self.result.name}", rows)

    def saved_in(self, folder: Path | None) -> Self:
        """Writes result and report into a folder, if any; returns the calibration with their paths.

        Raises:
            BadInput: The folder cannot be written to.
        """
        if folder is None:
            return self
        written = write_result(folder, self.result)
        report = written.with_suffix(".html")
        write_atomic(report, self.page)
        return replace(self, files=(written, report))


@dataclass(frozen=True, slots=True)
class Destination:
    """Where to write a result.

    Attributes:
        folder: For the result file and its report; None writes nothing.
        replace: Files of the same name and day may be replaced.
        on: The result's date; today when left out.
    """

    folder: Path | None = None
    replace: bool = False
    on: date = field(default_factory=lambda: date.today())

    @classmethod
    def of(cls, output: Destination | str | Path | None) -> Destination:
        """A destination; for a folder, one that does not replace files of the same day."""
        if isinstance(output, Destination):
            return output
        return cls(None if output is None else path_of(output))

    def require_free(self, kind: str, name: str) -> Destination:
        """Itself, its folder created before the computation, so that no work is lost.

        Raises:
            BadInput: It cannot be created or written to, or holds such a result or report.
        """
        if self.folder is None:
            return self
        result = self.folder / result_file_name(kind, name, self.on.isoformat())
        if self.folder.is_dir():
            for file in (result, result.with_suffix(".html")):
                require_new_file(file, self.replace)
        make_missing_folder(self.folder)
        return self
