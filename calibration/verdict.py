"""What a calibration is good for, in one sentence, and what to do where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

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
