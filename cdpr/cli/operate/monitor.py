"""`cdpr monitor`: looks at a run that is under way, live in a terminal or once for a program."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cdpr.cli.facts import camera_line
from cdpr.cli.output import out, show_json
from executor.remote.client import follow_run, request_run

#: Of a run that ended so; what ends without a word was killed.
_EXIT_CODES = {"finished": 0, "stopped": 130, "latched": 1}
_STATES = {"moving": "green", "holding": "yellow", "stopping": "yellow", "latched": "bold red"}


def monitor(
    once: Annotated[bool, typer.Option("--once", help="show the state once and exit")] = False,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="print JSON: one document with --once, otherwise one line per update"
        ),
    ] = False,
    rate: Annotated[
        float, typer.Option("--rate-hz", min=0.1, max=50.0, help="updates per second")
    ] = 5.0,
    process: Annotated[
        int | None,
        typer.Option("--process", help="process number, if several runs are in progress"),
    ] = None,
) -> None:
    """Show a run live: state, drives, tensions, lateness, progress and events.

    It only looks; `cdpr stop`, `hold`, `resume` and `speed` act. Ctrl-C ends the monitor, not the
    run. Exit code: 0 when the motion finished, 130 when it was stopped, 1 otherwise.

    [dim]Examples:[/dim]

      cdpr monitor

      cdpr monitor --once --json
    """
    if once:
        status = request_run("status", process, verb="monitor")
        if as_json:
            show_json(status)
        else:
            typer.echo(_plain(status))
        return
    looks = follow_run(process, rate)
    if as_json or not out.is_terminal:
        _lines(looks, as_json)
    else:
        _live(looks)


def _lines(looks: Iterator[dict[str, Any]], as_json: bool) -> None:
    """For a file or a program: a line a look, and each event once."""
    seen: list[dict[str, Any]] = []
    status: dict[str, Any] = {"state": "gone"}
    try:
        for status in looks:
            if as_json:
                typer.echo(json.dumps(status, allow_nan=False))
                continue
            for event in status["events"]:
                if event not in seen:
                    typer.echo(f"{event['time_s']:9.3f} s  {event['code']}: {event['text']}")
            seen = status["events"]
            typer.echo(_head(status))
    except KeyboardInterrupt:
        return
    _tell_end(status, as_json)


def _live(looks: Iterator[dict[str, Any]]) -> None:

    status: dict[str, Any] = {"state": "gone"}
    try:
        with Live(console=out, auto_refresh=False, transient=False) as live:
            for status in looks:
                live.update(_view(status), refresh=True)
    except KeyboardInterrupt:
        return
    _tell_end(status, False)


def _tell_end(status: dict[str, Any], as_json: bool) -> None:
    """The last word, and an exit code as that of the run."""
    state, cause = status["state"], status.get("cause")
    if not as_json:
        if state not in _EXIT_CODES:
            typer.echo(f"the run ended without a final status; last state {state}")
        else:
            typer.echo(f"the run ended: {state}{f', {cause}' if cause else ''}")
    raise typer.Exit(_EXIT_CODES.get(state, 1))


def _head(status: dict[str, Any]) -> str:
    """One line: where the run is."""
    if status["cycle"] is None:
        return f"{status['state']}  {status['rig']} on {status['bus']}"
    parts = [
        f"{status['elapsed_s']:9.3f} s",
        status["state"],
        _progress(status),
        f"{status['feed_percent']:.0f} % of {status['wished']['speed_percent']} %",
        _lateness(status),
        f"following error {_number(status['following_error_mm'], '.3f')} mm",
        f"{status['lost_replies']} lost replies",
        f"{status['rejected_frames']} rejected, {status['error_frames']} error frames",
    ]
    return "  ".join(parts)


def _progress(status: dict[str, Any]) -> str:
    if status["path_mm"] is None:
        return f"{status['row']:.0f} % done"
    return f"{status['path_mm']:.1f} of {status['path_length_mm']:.1f} mm"


def _lateness(status: dict[str, Any]) -> str:
    if status["simulated_time"]:
        return "simulated time"
    return f"late {status['lateness_ms']:.2f} ms, at most {status['worst_lateness_ms']:.2f} ms"


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _plain(status: dict[str, Any]) -> str:
    """Everything as text without a terminal."""
    drives = [
        f"  drive {d['node']:<3} {d['state']:<24} {d['position_counts']:>11}"
        f" ({d['position_counts'] - d['set_counts']:+d}) counts {d['tension_n']:8.2f} N"
        for d in status["drives"]
    ]
    cameras = [f"  camera {camera_line(camera)}" for camera in status["cameras"]]
    events = [f"  {e['time_s']:9.3f} s  {e['code']}: {e['text']}" for e in status["events"]]
    first = f"process {status['process']}: {status['rig']} on {status['bus']}, {status['folder']}"
    return "\n".join([first, _head(status), *drives, *cameras, *events])


def _view(status: dict[str, Any]) -> Group:
    """The live image."""
    title = Text.assemble(
        (status["state"].upper(), _STATES.get(status["state"], "bold")),
        f"  {status['rig']} on {status['bus']}  process {status['process']}  {status['folder']}",
    )
    drives = Table("drive", "state", box=None, padding=(0, 2), header_style="dim")
    for name in ("position, counts", "off, counts", "tension, N"):
        drives.add_column(name, justify="right")
    for drive in status["drives"]:
        drives.add_row(
            str(drive["node"]),
            drive["state"],
            str(drive["position_counts"]),
            f"{drive['position_counts'] - drive['set_counts']:+d}",
            f"{drive['tension_n']:.2f}",
        )
    cameras = Text("\n".join(f"  camera {camera_line(one)}" for one in status["cameras"]))
    events = Table(box=None, show_header=False, padding=(0, 2))
    for event in status["events"]:
        events.add_row(f"{event['time_s']:.2f} s", event["code"], Text(event["text"]))
    bar = Table.grid()
    bar.add_row(ProgressBar(total=status["rows"], completed=status["row"] or 0.0, width=60))
    return Group(title, Text(_head(status)), bar, drives, cameras, events)
