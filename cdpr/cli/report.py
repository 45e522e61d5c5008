"""`cdpr report` makes the page of a run again; `cdpr explain` says what its faults mean."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.output import Terminal, out, show_json
from executor.evaluation import rewrite_report
from executor.recording.run_folder import RunFolder
from executor.recording.verdict import fault_codes, page_text
from model.errors import BadInput


def report(
    run: Annotated[Path, typer.Argument(help="run folder", metavar="RUNDIR")],
    as_json: Annotated[bool, typer.Option("--json", help="print the run's summary")] = False,
) -> None:
    """Write the report of a run folder again from its files.

    Of a run whose program was killed, or whose disk was full, it writes what is missing from what
    is there.

    [dim]Example:[/dim]

      cdpr report runs/first
    """
    folder = RunFolder.open_cut_short(run)
    with Terminal(quiet=as_json).waiting("writing the report"):
        rewrite_report(folder)
    if as_json:
        show_json(folder.summary())
        return
    out.print(f"report: {folder.report}", markup=False, soft_wrap=True)


# `cdpr explain`: what a fault means, its likely cause, and the next step.


def explain(
    code: Annotated[
        str | None, typer.Argument(help="code of the fault, such as drive_silent", metavar="CODE")
    ] = None,
) -> None:
    """Explain a fault that a run reported: meaning, likely cause, state of the machine, next step.

    Without a code, list all of them.

    [dim]Example:[/dim]

      cdpr explain drive_silent
    """
    codes = fault_codes()
    if code is None:
        for known in codes:
            title = page_text(known).split("\n", 1)[0].removeprefix("# ")
            out.print(f"  {known:<22} {title}", markup=False, soft_wrap=True)
        return
    if code not in codes:
        near = difflib.get_close_matches(code, codes, n=1)
        raise BadInput(
            f"there is no fault code {code!r}",
            where="cdpr explain",
            next_step=f"run `cdpr explain {near[0]}`"
            if near
            else f"use one of: {', '.join(codes)}",
        )
    out.print(page_text(code).rstrip(), markup=False, soft_wrap=True)
