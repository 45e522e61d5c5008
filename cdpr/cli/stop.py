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
    from cdpr.errors import Fault
    from executor.running import stop_all

    stopped = stop_all()
    if as_json:
        show_json({"stopped_processes": stopped})
        raise typer.Exit(0 if stopped else 1)
    if not stopped:
        raise Fault(
            "no run of yours is going on, so nothing was stopped",
            where="cdpr stop",
            why="it ended already, or another user started it",
            next_step="press the emergency stop if something moves; a run of another user is"
            " stopped by that user or by root",
        )
    out.print(f"stop sent to process {', '.join(map(str, stopped))}")
