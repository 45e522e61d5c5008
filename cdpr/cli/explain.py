"""`cdpr explain`: meaning, likely cause and next step of a fault."""

from __future__ import annotations

from cdpr.cli.arguments import argument
from cdpr.cli.output import show_line
from executor.recording.verdict import fault_titles, page_of_fault


def explain(
    *,
    code: str | None = argument("code of the fault, such as drive_silent", "CODE", default=None),
) -> None:
    """Explain a fault that a run reported: meaning, likely cause, state of the machine, next step.

    Without a code, lists all of them.

    Example:
      cdpr explain drive_silent
    """
    if code is None:
        for known, title in fault_titles().items():
            show_line(f"  {known:<22} {title}")
        return
    show_line(page_of_fault(code).rstrip())
