"""Two calibration results of one thing: what changed, and whether their intervals explain it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calibration.results import ResultDocument
from calibration.statistics import Interval
from model.errors import BadInput


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """What became of a number.

    Attributes:
        name: With unit.
        first: In the first result.
        second: In the second.
        by: How much larger it is in the second.
        allowed: How far both may lie apart by chance, 95 %.
    """

    name: str
    first: Interval
    second: Interval
    by: float
    allowed: float

    @property
    def beyond(self) -> bool:
        """Whether chance does not explain it."""
        return abs(self.by) > self.allowed


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two results side by side.

    Attributes:
        changes: Number by number.
        only_in_one: Names of numbers that just one of the results has.
        apart_mm: How far apart the same thing is measured with either, RMS, [mm].
        stated_mm: How far both may lie apart by what they state, 95 %, [mm].
    """

    changes: tuple[ParameterChange, ...]
    only_in_one: tuple[str, ...]
    apart_mm: float
    stated_mm: float

    @property
    def agree(self) -> bool:
        """Whether both measure alike within what they state."""
        return self.apart_mm <= self.stated_mm

    @property
    def next_step(self) -> str:
        """What to do now."""
        if self.agree:
            return "use the newer one, or the one with the smaller intervals"
        return "find what was changed, moved or refocused in between, then calibrate again"

    def as_dict(self) -> dict[str, object]:
        """For programs."""
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
    """Compares two results of one kind and name.

    Raises:
        BadInput: They are of different kinds or things.
    """
    if (first.kind, first.name) != (second.kind, second.name):
        raise BadInput(
            f"a result of kind {first.kind} for {first.name!r} cannot be compared with one of kind"
            f" {second.kind} for {second.name!r}",
            next_step="pass two results of the same kind for the same part",
        )
    mine, others = first.stated, second.stated
    changes = [
        ParameterChange(name, mine[name], others[name], by, _apart(mine[name], others[name]))
        for name, by in first.changes_to(second).items()
    ]
    return Comparison(
        changes=tuple(changes),
        only_in_one=tuple(sorted(mine.keys() ^ others.keys())),
        apart_mm=first.apart_mm(second),
        stated_mm=math.hypot(first.error_mm, second.error_mm),
    )


def _apart(one: Interval, other: Interval) -> float:
    return math.hypot(one.half_width, other.half_width)
