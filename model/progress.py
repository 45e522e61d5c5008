"""Reports of a long operation while it runs; the caller decides how to show them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

from model.errors import first_few


class Advance(Protocol):
    """Moves a progress bar."""

    def __call__(self, value: float, note: str = "", text: str = "") -> None:
        """Reports the progress.

        Args:
            value: Progress so far, in the unit of the bar's total.
            note: A short remark beside the bar.
            text: Replaces the text before the bar; empty keeps it.
        """


class Listener:
    """Receives the reports of a library function; this one ignores them.

    A program that shows them overrides the methods it needs, as `cdpr.cli.output.Terminal` does.
    The library calls them one at a time, but not always from the thread that called it: during and
    after a motion they are called from others. They must return at once and not raise.
    """

    def note(self, text: str) -> None:
        """Reports an ordinary event in one line, such as a stop on the path."""

    def remark(self, text: str) -> None:
        """Reports something the operator should know that does not stop the operation."""

    def warning(self, text: str) -> None:
        """Reports what changes the operation, such as a stop for too little clearance."""

    def waiting(self, text: str) -> AbstractContextManager[None]:
        """Context of a step that takes a moment and has no measure of progress."""
        return nullcontext()

    def progress(self, text: str, total: float | None) -> AbstractContextManager[Advance]:
        """Context of a step with measured progress; yields the function that moves the bar.

        Args:
            total: Value at the end, or None where unknown.
        """
        return nullcontext(_ignored)


def _ignored(value: float, note: str = "", text: str = "") -> None:
    """Ignores the progress."""


#: Ignores all reports.
SILENT = Listener()


def skipped_files(reasons: Mapping[str, str]) -> Iterator[str]:
    """Remarks on files that are not used, one for each reason.

    Args:
        reasons: A verb with its complements, by name of the file.
    """
    for reason in dict.fromkeys(reasons.values()):
        names = [name for name, one in reasons.items() if one == reason]
        several = f"{len(names)} files ({first_few(names)}); each"
        yield f"skipped: {names[0] if len(names) == 1 else several} {reason}"
