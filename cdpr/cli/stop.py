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
    from executor.running import stop_all

    stopped = stop_all()
    if as_json:
        show_json({"stopped_processes": stopped})
    elif stopped:
        out.print(f"stop sent to process {', '.join(map(str, stopped))}")
    else:
        out.print("no run is going on")
