"""`cdpr stop`: stops a run that goes on in another terminal."""

from __future__ import annotations

import typer

from cdpr.cli.options import JsonOption
from cdpr.cli.output import out, show_json
from executor.remote.client import no_answer, no_run, stop_runs


def stop(
    as_json: JsonOption = False,
) -> None:
    """Stop every run of this user: all drives slow down together along the path, then hold.

    This is a software stop. It does not replace the emergency-stop button.

    [dim]Example:[/dim]

      cdpr stop
    """
    result = stop_runs()
    stopped, silent = result.stopped, result.silent
    if as_json:
        silent_processes = [answer.process for answer in silent]
        show_json({"stopped_processes": list(stopped), "silent_processes": silent_processes})
        raise typer.Exit(0 if stopped and not silent else 1)
    if not (stopped or silent):
        raise no_run("stop")
    if stopped:
        out.print(f"stop sent to process {', '.join(map(str, stopped))}")
    if silent:
        raise no_answer("stop", silent)
