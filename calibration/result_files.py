"""Calibration result files: read by kind, applied to a rig, compared."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from calibration.extrinsics.result import ExtrinsicsResult
from calibration.geometry.result import RigResult
from calibration.intrinsics.readout import ReadoutResult
from calibration.intrinsics.result import CameraResult
from calibration.results import ResultDocument
from calibration.statistics import Interval
from calibration.tag_map.result import TagsResult
from model.cameras import in_order, left_out_errors
from model.errors import BadInput, require_types
from model.files.documents import load_yaml, read_yaml, write_atomic
from model.progress import SILENT, Listener
from model.rig import Rig

KINDS: dict[str, type[ResultDocument]] = {
    "camera": CameraResult,
    "readout": ReadoutResult,
    "tags": TagsResult,
    "extrinsics": ExtrinsicsResult,
    "rig": RigResult,
}


def load_result(path: Path) -> ResultDocument:
    """Reads a result file.

    Raises:
        BadInput: The file cannot be read, is not a calibration result, or was edited.
        InvalidFile: With every problem, its line and column.
    """
    result = load_yaml(path, _kind_of(path))
    if result.hash != result.sealed().hash:
        raise BadInput(
            "the result's hash does not match its content",
            where=str(path),
            why="the file was edited, damaged, or written by a version with other defaults",
            next_step=f"run `cdpr calibrate {result.kind}` again; put your own values into"
            " the rig file",
        )
    return result


def _kind_of(path: Path) -> type[ResultDocument]:
    plain = read_yaml(path).data
    kind = plain.get("kind") if isinstance(plain, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise BadInput(
            "not a calibration result",
            where=str(path),
            why=f"its kind must be one of {', '.join(KINDS)}; it is {kind!r}",
            next_step="pass a file calibration_*.yaml written by `cdpr calibrate`",
        )
    return KINDS[kind]


def write_calibrated_rig(
    path: Path, rig: Rig, results: Sequence[ResultDocument], listener: Listener = SILENT
) -> Rig:
    """Writes a new rig file with results applied to a rig; returns the new rig.

    Comments of the rig's own file are not copied; comments at its top name the results, and each
    error that a new lens leaves out.

    Args:
        path: The file to write; an existing file is never replaced.
        rig: As in its own file.
        results: In any order.
        listener: Receives the remarks too.

    Raises:
        BadInput: The file exists or cannot be written, or a result is not about this rig.
    """
    if path.exists():
        raise BadInput(
            "the file exists already",
            where=str(path),
            why="a calibration never replaces a rig file",
            next_step="choose a new name",
        )
    better = rig.with_calibration(*results, listener=listener)
    used = [f"{one.kind} {one.name} of {one.date}" for one in in_order(results)]
    plain = better.document.model_dump(mode="json", exclude_unset=True)
    body = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None)
    head = [f"{rig.name} with calibration {', '.join(used)}; written by `cdpr calibrate apply`"]
    head += left_out_errors(rig.document.cameras, better.document.cameras)
    write_atomic(path, "".join(f"# {line}\n" for line in head) + body)
    return better


# Comparison of two results: what changed, and whether their intervals explain it.


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """Change of one parameter between two results.

    Attributes:
        name: With unit.
        first: In the first result.
        second: In the second.
        by: Second value minus the first.
        allowed: Difference explained by chance, 95 %.
    """

    name: str
    first: Interval
    second: Interval
    by: float
    allowed: float

    @property
    def beyond(self) -> bool:
        """Whether the change exceeds chance."""
        return abs(self.by) > self.allowed


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two results.

    Attributes:
        changes: By parameter.
        only_in_one: Names of parameters that only one of the results has.
        apart_mm: RMS distance between measurements made with either result, [mm].
        stated_mm: Distance that both stated errors allow, 95 %, [mm].
    """

    changes: tuple[ParameterChange, ...]
    only_in_one: tuple[str, ...]
    apart_mm: float
    stated_mm: float

    @property
    def agree(self) -> bool:
        """Whether both agree within their stated errors."""
        return self.apart_mm <= self.stated_mm

    @property
    def next_step(self) -> str:
        """The recommended action."""
        if self.agree:
            return "use the newer one, or the one with the smaller intervals"
        return "find what was changed, moved or refocused in between, then calibrate again"

    def facts(self) -> list[tuple[str, str]]:
        """Human-readable verdict, next step and parameters."""
        numbers = [
            (
                change.name,
                f"{change.by:+.3g}, within {change.allowed:.2g} by chance"
                f"{': CHANGED' if change.beyond else ''}",
            )
            for change in self.changes
        ]
        alone = [(name, "in one result only") for name in self.only_in_one]
        return [("verdict", str(self)), ("next", self.next_step), *numbers, *alone]

    def as_dict(self) -> dict[str, object]:
        """Machine-readable comparison."""
        return {
            "verdict": str(self),
            "agree": self.agree,
            "next_steps": [self.next_step],
            "apart_mm": self.apart_mm,
            "stated_mm": self.stated_mm,
            "changes": {
                change.name: {
                    "by": change.by,
                    "allowed": change.allowed,
                    "beyond": change.beyond,
                    "first": change.first.bounds,
                    "second": change.second.bounds,
                }
                for change in self.changes
            },
            "only_in_one": list(self.only_in_one),
        }

    def __str__(self) -> str:
        """The verdict in a sentence."""
        beyond = sum(change.beyond for change in self.changes)
        what = f"{beyond} of {len(self.changes)} numbers changed by more than their intervals"
        if self.agree:
            return (
                f"they agree: {self.apart_mm:.2g} mm apart, {self.stated_mm:.2g} mm stated; {what}"
            )
        return (
            f"they differ: {self.apart_mm:.2g} mm apart, more than the stated"
            f" {self.stated_mm:.2g} mm; {what}"
        )


def compare(first: ResultDocument, second: ResultDocument) -> Comparison:
    """Compares two results of one kind and part; those of a whole rig may have any names.

    Raises:
        BadInput: They differ in kind or part.
    """
    require_types((first, ResultDocument), (second, ResultDocument))
    if first.kind != second.kind or (first.is_of_named_part and first.name != second.name):
        raise BadInput(
            f"a result of kind {first.kind} for {first.name!r} cannot be compared with one of kind"
            f" {second.kind} for {second.name!r}",
            next_step="pass two results of the same kind for the same part",
        )
    mine, others = first.stated, second.stated
    changes = [
        ParameterChange(name, mine[name], others[name], by, _apart(mine[name], others[name], by))
        for name, by in first.changes_to(second).items()
    ]
    return Comparison(
        changes=tuple(changes),
        only_in_one=tuple(sorted(mine.keys() ^ others.keys())),
        apart_mm=first.apart_mm(second),
        stated_mm=math.hypot(first.error_mm, second.error_mm),
    )


def _apart(one: Interval, other: Interval, by: float) -> float:
    """Change of an estimate that both intervals allow in its direction, 95 %."""
    sign = math.copysign(1.0, by)
    return math.hypot(one.half_width + sign * one.skew, other.half_width - sign * other.skew)
