"""`cdpr report`: rewrites the report of a run from its folder."""

from __future__ import annotations

from pathlib import Path

from cdpr.cli.arguments import argument, option
from cdpr.cli.output import Terminal, show_json, show_line
from executor.evaluation import rewrite_report
from executor.recording.run_folder import RunFolder


def report(
    *,
    run: Path = argument("run folder", "RUNDIR"),
    as_json: bool = option(False, "print the run's summary", "--json"),
) -> None:
    """Write the report of a run again, from the files of its folder.

    For a run that was killed, or whose disk was full, missing results are recovered from the files
    that exist.

    Example:
      cdpr report runs/first
    """
    folder = RunFolder.open_cut_short(run)
    with Terminal(quiet=as_json).waiting("writing the report"):
        rewrite_report(folder)
    if as_json:
        show_json(folder.summary())
        return
    show_line(f"report: {folder.report}")
