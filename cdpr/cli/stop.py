"""`cdpr stop`: stops a run that goes on in another terminal."""

from __future__ import annotations

from typing import Annotated

import typer


def stop(
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Stop every run of this user: all drives slow down together along the path, then hold.

    This is a software stop. It does not replace the emergency-stop button.

    [dim]Example:[/dim]

      cdpr stop
    """
    from cdpr.cli.output import out, show_json
    from executor.command_client import ask_all, no_answer, no_run
    from executor.running import reached_runs

    with reached_runs() as runs:
        answers = ask_all(runs, "stop")
    stopped = [answer.process for answer in answers if answer.status is not None]
    silent = [answer for answer in answers if answer.status is None]
    if as_json:
        show_json({"stopped_processes": stopped, "silent_processes": [a.process for a in silent]})
        raise typer.Exit(0 if stopped and not silent else 1)
    if not answers:
        raise no_run("stop")
    if stopped:
        out.print(f"stop sent to process {', '.join(map(str, stopped))}")
    if silent:
        raise no_answer("stop", silent)
