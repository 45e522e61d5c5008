"""Calibration results as dated YAML files, beside the rig file and never written into it.

Every kind of result has the keys of `ResultDocument` and its own, which are those of the rig file,
and a verdict: what it is good for in one sentence, and what to do where it is not.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeVar

import yaml
from pydantic import AfterValidator, Field

from calibration.statistics import Interval
from model.errors import BadInput
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
    "use it: pass the result's file with --calibration, or write a new rig file with"
    " `cdpr calibrate apply`"
)
"""What to do with a result that is good enough."""


@dataclass(frozen=True, slots=True)
class Issue:
    """Something that a calibration lacks.

    Attributes:
        reason: Why it is not good enough.
        next_step: What to do about it.
    """

    reason: str
    next_step: str


@dataclass(frozen=True, slots=True)
class CalibrationVerdict:
    """What a calibration is good for.

    Attributes:
        error: How far off what is measured with it may be, 95 %, [m].
        wanted: What is good enough, [m].
        where: The place or the conditions of that, such as ``at 0.6 m``.
        reasons: Why it is not good enough; empty if it is.
        next_steps: What to do about each, or with a good result.
    """

    error: float
    wanted: float
    where: str
    reasons: tuple[str, ...]
    next_steps: tuple[str, ...]

    @classmethod
    def of(cls, error: float, wanted: float, where: str, lacks: Sequence[Issue]) -> Self:
        """The verdict of what was found to be lacking; each next step once."""
        reasons = tuple(lack.reason for lack in lacks)
        steps = tuple(dict.fromkeys(lack.next_step for lack in lacks)) or (USE,)
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


# Result files.


def _is_date(text: str) -> str:
    date.fromisoformat(text)
    return text


Bounds = Annotated[list[AnyNumber], Field(min_length=2, max_length=2)]
"""Both ends of a 95 % interval."""


class ResultDocument(Document, ABC):
    """What every calibration result has."""

    order: ClassVar[int]
    """Results of lower order are applied first: those of higher order rest on them."""
    added: ClassVar[tuple[str, ...]] = ()
    """Keys that older files lack: left at their defaults they are not part of the hash."""

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
    def file_name(self) -> str:
        """What its file is called."""
        return result_file_name(self.kind, self.name, self.date)

    def sealed(self) -> Self:
        """The result with its hash, which reveals an edited one."""
        fields = type(self).model_fields
        unset = {key for key in self.added if getattr(self, key) == fields[key].default}
        return self.model_copy(update={"hash": document_hash(self, {"hash"} | unset)})

    @property
    def stated(self) -> dict[str, Interval]:
        """What was found, by name with unit."""
        return {name: Interval.between(*ends) for name, ends in self.intervals.items()}

    def in_words(self) -> list[tuple[str, str]]:
        """What was found, for people: names with unit, and values with their half widths."""
        return [(name, str(interval)) for name, interval in self.stated.items()]

    def changes_to(self, other: Self) -> dict[str, float]:
        """By how much another result's numbers are larger, by name with unit."""
        mine, others = self.stated, other.stated
        return {name: others[name].value - mine[name].value for name in mine if name in others}

    @abstractmethod
    def apart_mm(self, other: Self) -> float:
        """How far apart the same thing is measured with either result, RMS, [mm]."""

    @abstractmethod
    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this result in place.

        Raises:
            BadInput: The result is not about this rig.
        """

    def require_basis(self, parts: object, what: str) -> None:
        """Refuses a rig whose parts are others than those that this result rests on.

        Args:
            parts: The JSON-like parts of the rig file, as when the result was made.
            what: Their names, for the message.

        Raises:
            BadInput: They are others.
        """
        if content_hash(parts) != self.rests_on:
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
    """The keys of every result.

    Args:
        name: Of what was calibrated.
        on: The date.
        data_hash: Of the measurements.
        intervals: What was found, by name with unit.
        verdict: What it is good for.
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
    """What the file of a result is called."""
    return f"calibration_{kind}_{name}_{day}.yaml"


def require_file_name(name: str, where: str) -> None:
    """The name becomes part of a file's; reported before the long work, not after it.

    Raises:
        BadInput: It cannot.
    """
    if not name or "/" in name or "\0" in name:
        raise BadInput(
            f"{name!r} cannot be part of a file name",
            where=where,
            next_step="use a name without a slash",
        )


def write_result(folder: Path, result: ResultDocument) -> Path:
    """Writes a result into a folder, sealed, whole or not at all; returns the file.

    Raises:
        BadInput: The folder cannot be written to.
    """
    path = folder / result.file_name
    plain = result.sealed().model_dump(mode="json")
    write_atomic(path, yaml.safe_dump(plain, sort_keys=False, allow_unicode=True))
    return path


def in_order(results: Sequence[ResultDocument]) -> list[ResultDocument]:
    """Results in the order in which they are applied."""
    return sorted(results, key=lambda result: result.order)


# The hash of the measurements that a result rests on, in one form for all kinds.


def data_hash(pieces: Iterable[bytes]) -> str:
    """``sha256:`` and the hash of all pieces in their order."""
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return f"sha256:{digest.hexdigest()}"


# A finished calibration, and where it is written.


Result = TypeVar("Result", bound=ResultDocument, covariant=True)
Found = TypeVar("Found", covariant=True)
Quality = TypeVar("Quality", covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration(Generic[Result, Found, Quality]):
    """A finished calibration.

    Attributes:
        result: As it is written to a file: numbers, intervals, verdict.
        page: The report, HTML.
        found: What it rests on.
        quality: What it is good for.
        facts: What was found beside the numbers, for people.
        files: Result and report, where they were written.
    """

    result: Result
    page: str
    found: Found
    quality: Quality
    facts: Sequence[tuple[str, str]] = ()
    files: tuple[Path, ...] = ()

    @property
    def order(self) -> int:
        """When it is applied; with what follows, what `Rig.with_calibration` takes."""
        return self.result.order

    @property
    def kind(self) -> str:
        """What was calibrated, such as ``camera``."""
        return self.result.kind

    @property
    def name(self) -> str:
        """Which of its kind."""
        return self.result.name

    @property
    def date(self) -> str:
        """When, ISO 8601."""
        return self.result.date

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this result in place.

        Raises:
            BadInput: The result is not about this rig.
        """
        return self.result.corrected(rig)

    def __repr__(self) -> str:
        """What was calibrated, and what it is good for."""
        return f"<Calibration {self.kind} {self.name}, {self.date}: {self.result.verdict}>"

    def _repr_html_(self) -> str:
        """For notebooks."""
        rows = [*self.result.in_words(), ("verdict", self.result.verdict)]
        return html_table(f"Calibration {self.kind} {self.name}", rows)

    def saved_in(self, folder: Path | None) -> Self:
        """The calibration with its result and report written into a folder; None writes nothing.

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
    """Where a result goes.

    Attributes:
        folder: For the result file and its report; None writes nothing.
        replace: Files of the same name and day may be replaced.
        on: The result's date; today when left out.
    """

    folder: Path | None = None
    replace: bool = False
    on: date = field(default_factory=lambda: datetime.now(UTC).date())

    @classmethod
    def of(cls, output: Destination | str | Path | None) -> Destination:
        """A destination as it is; of a folder, what a result there replaces is refused."""
        if isinstance(output, Destination):
            return output
        return cls(None if output is None else Path(output))

    def require_free(self, kind: str, name: str) -> None:
        """Makes the folder before the work, so that no work is lost.

        Raises:
            BadInput: It cannot be made or written to, or holds such a result or report.
        """
        if self.folder is None:
            return
        result = self.folder / result_file_name(kind, name, self.on.isoformat())
        if self.folder.is_dir():
            for file in (result, result.with_suffix(".html")):
                require_new_file(file, self.replace)
        make_missing_folder(self.folder)
