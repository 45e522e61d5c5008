"""`cdpr stop`, `hold`, `resume`, `speed`: an operator's requests to a run in progress."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import typer

from cdpr.cli.arguments import argument, flag, option
from cdpr.cli.options import JSON
from cdpr.cli.output import out, show_json, show_line
from executor.remote.client import no_answer, no_run, request_run, stop_runs
from executor.state_machine import State
from executor.supervision import FASTEST, SLOWEST


def stop(
    *,
    as_json: bool = JSON,
) -> None:
    """Stop every run of this user: all drives slow down together along the path, then hold.

    This is a software stop. It does not replace the emergency-stop button.

    Example:
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


#: States in which requests come too late.
_ENDING = (State.STOPPING, State.SECURING, State.FINISHED, State.STOPPED, State.LATCHED)
OVER = frozenset(state.value for state in _ENDING)

PROCESS = option("process number, if several runs are in progress", "--process")
STATUS_JSON = flag("print the run's status as JSON", "--json")


def hold(*, process: int | None = PROCESS, as_json: bool = STATUS_JSON) -> None:
    """Feed hold: the platform slows down along the path and waits there under tension.

    Example:
      cdpr hold
    """
    _request("hold", process, as_json)


def resume(*, process: int | None = PROCESS, as_json: bool = STATUS_JSON) -> None:
    """Continue after `cdpr hold`, at the last requested speed.

    Example:
      cdpr resume
    """
    _request("resume", process, as_json)


def speed(
    *,
    percent: int = argument("percentage of the planned speed", "PERCENT", min=SLOWEST, max=FASTEST),
    process: int | None = PROCESS,
    as_json: bool = STATUS_JSON,
) -> None:
    """Scale the speed along the path to a percentage of the planned one.

    Example:
      cdpr speed 25
    """
    _request("speed", process, as_json, percent)


def _request(verb: str, process: int | None, as_json: bool, percent: int | None = None) -> None:
    status = request_run(verb, process, percent)
    is_over = status["state"] in OVER
    if as_json:
        show_json(status)
    elif is_over:
        show_line(f"too late: process {status['process']} is {status['state']}")
    else:
        _confirm(verb, status, percent)
    if is_over:
        raise typer.Exit(1)


def _confirm(verb: str, status: Mapping[str, Any], percent: int | None) -> None:
    request = {"hold": "hold", "resume": "resume", "speed": f"run at {percent} %"}[verb]
    show_line(
        f"process {status['process']} received the request to {request}; state {status['state']}"
    )
    if verb == "speed" and status["wished"]["hold"]:
        out.print("it is on hold: the speed applies after `cdpr resume`")
