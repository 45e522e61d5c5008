"""Runs that are under way or over: what `cdpr stop`, `hold`, `resume`, `speed` and `report` do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from executor.evaluation import rewrite_report
from executor.recording.run_folder import RunFolder
from executor.remote.client import no_answer, no_run, request_run, stop_runs


def stop() -> list[int]:
    """Stops every run of this user: all drives slow down together along the path, then hold.

    This is a software stop. It does not replace the emergency-stop button.

    Returns:
        Numbers of the processes that stop.

    Raises:
        Fault: No run is under way, or one does not answer.
    """
    result = stop_runs()
    if not (result.stopped or result.silent):
        raise no_run("stop")
    if result.silent:
        raise no_answer("stop", result.silent)
    return list(result.stopped)


def hold(process: int | None = None) -> dict[str, Any]:
    """Feed hold: the platform slows down along the path, waits there, and keeps its tension.

    Args:
        process: Number of the run; None for the only one.

    Returns:
        The status of the run.

    Raises:
        Fault: No run is under way, or it does not answer.
        BadInput: It is not clear which run is meant.
    """
    return request_run("hold", process)


def resume(process: int | None = None) -> dict[str, Any]:
    """Continues after `hold`, at the speed that was set last; arguments as for `hold`."""
    return request_run("resume", process)


def set_speed(percent: int, process: int | None = None) -> dict[str, Any]:
    """Sets the speed along the path, [% of the planned speed], from 1 to 100; else as `hold`."""
    return request_run("speed", process, percent)


def report(folder: str | Path) -> Path:
    """Writes the report of a run again, from its files alone; returns the page.

    Of a run whose program was killed, or whose disk was full, it writes what is missing too.

    Raises:
        BadInput: There is no such folder, or a file of the run was changed.
    """
    opened = RunFolder.open_cut_short(Path(folder))
    rewrite_report(opened)
    return opened.report
