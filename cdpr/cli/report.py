"""`cdpr report` rewrites the report of a run; `cdpr explain` explains a fault."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.output import Terminal, show_json, show_line
from executor.evaluation import rewrite_report
from executor.recording.run_folder import RunFolder
from executor.recording.verdict import fault_titles, page_of_fault


def report(
    run: Annotated[Path, typer.Argument(help="run folder", metavar="RUNDIR")],
    as_json: Annotated[bool, typer.Option("--json", help="print the run's summary")] = False,
) -> None:
    """Write the report of a run again, from the files of its folder.

    For a run that was killed, or whose disk was full, missing results are recovered from the files
    that exist.

    [dim]Example:[/dim]

      cdpr report runs/first
    """
    folder = RunFolder.open_cut_short(run)
    with Terminal(quiet=as_json).waiting("writing the report"):
        rewrite_report(folder)
    if as_json:
        show_json(folder.summary())
        return
    show_line(f"report: {folder.report}")


def explain(
    code: Annotated[
        str | None, typer.Argument(help="code of the fault, such as drive_silent", metavar="CODE")
    ] = None,
) -> None:
    """Explain a fault that a run reported: meaning, likely cause, state of the machine, next step.

    Without a code, lists all of them.

    [dim]Example:[/dim]

      cdpr explain drive_silent
    """
    if code is None:
        for known, title in fault_titles().items():
            show_line(f"  {known:<22} {title}")
        return
    show_line(page_of_fault(code).rstrip())
