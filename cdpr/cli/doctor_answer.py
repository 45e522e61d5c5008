"""One thing that `cdpr doctor` looked at."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Answer:
    """One thing that was looked at.

    Attributes:
        name: What.
        good: Whether it is as a run needs it.
        text: What was found.
        fix: The next step where it is not good.
    """

    name: str
    good: bool
    text: str
    fix: str = ""
