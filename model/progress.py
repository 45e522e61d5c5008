"""What a long operation reports while it is under way; the caller decides what becomes of it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class Advance(Protocol):
    """Moves a progress bar."""

    def __call__(self, value: float, note: str = "", text: str = "") -> None:
        """Reports the progress.

        Args:
            value: Progress so far, in the unit of the bar's total.
            note: A short remark beside the bar.
            text: Replaces the text in front of the bar; empty keeps it.
        """


class Listener:
    """Receives the reports of a library function; this one ignores all of them.

    A program that shows them overrides what it needs, as `cdpr.cli.output.Terminal` does. Every
    method may be called from the thread that called the library, and must not raise.
    """

    def note(self, text: str) -> None:
        """Reports an ordinary event, in one line: a stop on the path was reached."""

    def remark(self, text: str) -> None:
        """Reports something that the operator should know and that stops nothing."""

    def warning(self, text: str) -> None:
        """Reports what changes the operation, such as a stop for too little clearance."""

    def waiting(self, text: str) -> AbstractContextManager[None]:
        """Is entered around a step that takes a moment and has no measure of progress."""
        return nullcontext()

    def progress(self, text: str, total: float | None) -> AbstractContextManager[Advance]:
        """Is entered around a step whose progress is measured; yields what moves the bar.

        Args:
            text: In front of the bar.
            total: Value at the end, or None where it is not known.
        """
        return nullcontext(_ignored)


def _ignored(value: float, note: str = "", text: str = "") -> None:
    """Progress of an operation that runs unobserved."""


#: Ignores all reports.
SILENT = Listener()
