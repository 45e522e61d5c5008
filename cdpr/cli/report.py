"""`cdpr report`: makes the report of a run anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    run: Annotated[Path, typer.Argument(help="run folder", metavar="RUNDIR")],
    as_json: Annotated[bool, typer.Option("--json", help="print the run's summary")] = False,
) -> None:
    """Write the report of a run folder anew, from its files alone.

    [dim]Example:[/dim]

      cdpr report runs/first
    """
    from cdpr.cli.output import out, show_json, spinner
    from executor.report import build_report
    from executor.run_folder import RunFolder

    folder = RunFolder.open(run)
    with spinner("writing the report", not as_json):
        page = build_report(folder)
    if as_json:
        show_json(folder.summary())
        return
    out.print(f"report: {page}", soft_wrap=True)
