"""`cdpr monitor`: shows a run live and takes keys, or prints its status for a program."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

import typer
from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cdpr import console  # loads Foxglove where it is asked for
from cdpr.cli.arguments import flag, option
from cdpr.cli.operate.supervision import Keys, speed_by_key
from cdpr.cli.output import err, out, show_json, show_line
from cdpr.console.view import RobotNow, RobotView
from executor.recording.run_folder import RIG, RunFolder
from executor.remote.client import (
    Answer,
    cable_tension,
    camera_line,
    follow_run,
    next_stop_line,
    no_run,
    request_run,
    status_line,
    status_text,
    stop_runs,
)
from executor.remote.protocol import make_line
from model.errors import CdprError
from model.files.documents import write_atomic
from model.files.output import require_new_file

#: Exit codes by final state; a run without one was killed.
_EXIT_CODES = {"finished": 0, "stopped": 130, "latched": 1}
_KEYS = "space stop · h hold · r resume · + and - speed · q leave"
_BAR = 20
_STATES = {"moving": "green", "holding": "yellow", "stopping": "yellow", "latched": "bold red"}


def monitor(
    *,
    once: bool = flag("show the state once and exit"),
    as_json: bool = flag(
        "print JSON: one document with --once, otherwise one line per update", "--json"
    ),
    rate: float = option("updates per second", "--rate-hz", default=5.0, min=0.1, max=50.0),
    process: int | None = option("process number, if several runs are in progress"),
    wait: bool = flag("wait for a run to begin; in a terminal it always waits"),
    foxglove: int | None = option(
        "also serve Foxglove on this local port, such as 8765", min=0, max=65535, metavar="PORT"
    ),
    foxglove_layout: Path | None = option("write a layout for Foxglove and exit"),
) -> None:
    """Show a run live: state, pose, clearance, tensions, drives, lateness, progress and events.

    In a terminal it takes keys: space stops every run of this user, as `cdpr stop` does; h holds
    this one, r resumes it, + and - change its speed by ten per cent of the planned one. Ctrl-C or
    q ends the monitor, not the run. Exit code: 0 if the motion finished, 130 if it was stopped, 1
    otherwise.

    Examples:
      cdpr monitor
      cdpr monitor --once --json
      cdpr monitor --foxglove 8765 --rate-hz 20
    """
    if foxglove_layout is not None:
        require_new_file(foxglove_layout)
        write_atomic(foxglove_layout, console.layout_text() + "\n")
        return
    if once:
        status: dict[str, Any] | None
        if wait:
            status = next(follow_run(process, rate, waits=True), None)
        else:
            status = request_run("status", process, verb="monitor")
        if status is None:  # the run ended at once
            raise no_run("monitor")
        if as_json:
            show_json(status)
        else:
            typer.echo(status_text(status))
        return
    # Ctrl-C ends the monitor, not the run.
    serving: AbstractContextManager[console.FoxgloveStream | None]
    serving = nullcontext() if foxglove is None else console.foxglove_stream(foxglove)
    with serving as stream, suppress(KeyboardInterrupt):
        if stream is not None:
            show_line(f"Foxglove: open the connection {stream.address}", err)
        if as_json or not out.is_terminal:
            _lines(follow_run(process, rate, waits=wait), as_json, stream)
        else:
            _live(process, rate, stream)


def _lines(
    statuses: Iterator[dict[str, Any]], as_json: bool, stream: console.FoxgloveStream | None = None
) -> None:
    """For a file or a program: one line per status, and each event once."""
    seen: list[dict[str, Any]] = []
    status: dict[str, Any] = {"state": "gone"}
    robot = _Robot()
    for status in statuses:
        if stream is not None:
            stream.take(status, robot.seen(status))
        if as_json:
            typer.echo(json.dumps(status, allow_nan=False))
            continue
        for event in status["events"]:
            if event not in seen:
                typer.echo(f"{event['time_s']:9.3f} s  {event['code']}: {event['text']}")
        seen = status["events"]
        typer.echo(status_line(status))
    _show_end(status, as_json)


def _live(process: int | None, rate: float, stream: console.FoxgloveStream | None) -> None:
    status: dict[str, Any] = {"state": "gone"}
    robot = _Robot()
    with (
        Keys() if sys.stdin.isatty() else nullcontext() as keys,
        Live(console=out, auto_refresh=False, vertical_overflow="crop") as live,
    ):
        operator = _Operator(keys)
        live.update(Text("waiting for a run to begin; Ctrl-C ends the monitor"), refresh=True)
        for status in follow_run(
            process, rate, waits=True, between=operator.between, rejected=operator.rejected
        ):
            operator.status = status
            seen = robot.seen(status)
            if stream is not None:
                stream.take(status, seen)
            live.update(_view(status, seen, operator.line), refresh=True)
    _show_end(status, False)


class _Operator:
    """Requests by keys."""

    def __init__(self, keys: Keys | None) -> None:
        """Without keys where standard input is not a terminal."""
        self._keys = keys
        self.status: dict[str, Any] = {}
        """Last status of the run; empty before."""
        self.line = _KEYS if keys else "no keys: standard input is not a terminal"
        """Text below the state."""

    def between(self, seconds: float) -> Sequence[bytes]:
        """See `executor.remote.client.follow_run`."""
        if self._keys is None:
            time.sleep(seconds)
            return ()
        return [line for key in self._keys.pressed(seconds) for line in self._request(key)]

    def rejected(self, answer: Answer) -> None:
        """Shows why the run takes no such request; a session of jogs has no path."""
        self.line = answer.what

    def _request(self, key: str) -> Sequence[bytes]:
        if key == "q":
            raise KeyboardInterrupt
        if key == " ":
            self._stop()
        elif key in "hr" and self.status:
            return [make_line("hold" if key == "h" else "resume")]
        elif key in "+-" and self.status:
            speed = speed_by_key(self.status["wished"]["speed_percent"], key)
            self.status["wished"]["speed_percent"] = speed  # the next key counts from here
            return [make_line("speed", percent=speed)]
        return ()

    def _stop(self) -> None:
        """Stops every run of this user, as `cdpr stop` does."""
        result = stop_runs()
        self.line = "stop requested" if result.stopped else "no run is in progress"
        if result.silent:
            self.line = "A RUN DOES NOT ANSWER: PRESS THE EMERGENCY STOP"


class _Robot:
    """Pose and clearance of a run from its encoders; rig and plan come from its folder."""

    def __init__(self) -> None:
        self._view: RobotView | None = None

    def seen(self, status: dict[str, Any]) -> tuple[RobotView, RobotNow] | None:
        """The robot now; None before the first cycle, and for motions without a plan."""
        folder = Path(status["folder"] or "")
        if self._view is None and (folder / RIG).is_file():
            try:
                self._view = RobotView(RunFolder(folder).rig(), None)
            except CdprError:  # half written; complete at the next status
                return None
        now = None if self._view is None else self._view.take(status)
        return None if self._view is None or now is None else (self._view, now)


def _show_end(status: dict[str, Any], as_json: bool) -> None:
    """Shows how the run ended, and exits with its exit code."""
    state, cause = status["state"], status.get("cause")
    if not as_json:
        if state not in _EXIT_CODES and cause:
            typer.echo(f"the run ended before it began: {cause}")
        elif state not in _EXIT_CODES:
            typer.echo(f"the run ended without a final status; last state {state}")
        else:
            typer.echo(f"the run ended: {state}{f', {cause}' if cause else ''}")
    raise typer.Exit(_EXIT_CODES.get(state, 1))


def _view(
    status: dict[str, Any],
    robot: tuple[RobotView, RobotNow] | None = None,
    keys: str = "",
) -> Group:
    """The live view, most important first: a small window crops the rest."""
    title = Text.assemble(
        (status["state"].upper(), _STATES.get(status["state"], "bold")),
        f"  {status['rig']} on {status['bus']}  process {status['process']}  {status['folder']}",
    )
    events = Table(box=None, show_header=False, padding=(0, 2))
    for event in status["events"]:
        events.add_row(f"{event['time_s']:.2f} s", event["code"], Text(event["text"]))
    bar = Table.grid()
    bar.add_row(ProgressBar(total=status["rows"], completed=status["row"] or 0.0, width=60))
    ahead = next_stop_line(status)
    lines = [Text(ahead)] if ahead else []
    if robot is not None:
        lines.append(Text(_where(*robot)))
    if status["events"]:
        lines.append(Text("last: {time_s:.2f} s  {text}".format(**status["events"][-1])))
    lines.append(Text(keys, style="dim"))
    cameras = Text("\n".join(f"  camera {camera_line(one)}" for one in status["cameras"]))
    limits = None if robot is None else (robot[0].rig.min_tension, robot[0].rig.max_tension)
    head, drives = Text(status_line(status)), _drives(status, limits)
    return Group(title, head, bar, *lines, drives, cameras, events)


def _where(view: RobotView, now: RobotNow) -> str:
    x, y, z = now.pose.position * 1e3
    tilt = math.degrees(now.pose.tilt)
    text = f"platform {x:.1f}, {y:.1f}, {z:.1f} mm, tilt {tilt:.2f}° from the encoders"
    if now.nearest is None:
        return text
    return (
        f"{text}; clearance {now.nearest.distance * 1e3:.1f} of"
        f" {view.required_clearance * 1e3:.1f} mm, {now.nearest.first} – {now.nearest.second}"
    )


def _drives(status: dict[str, Any], limits: tuple[float, float] | None) -> Table:
    """One row per drive, with its tension between the limits [N] where these are known."""
    drives = Table("drive", box=None, padding=(0, 1), header_style="dim")
    drives.add_column("state", no_wrap=True)
    for name in ("position, counts", "off, counts", "tension, N"):
        drives.add_column(name, justify="right")
    if limits is not None:
        drives.add_column(f"{limits[0]:.0f} to {limits[1]:.0f} N", no_wrap=True)
    for drive in status["drives"]:
        tension, text, bar = cable_tension(drive), Text("–"), Text("")
        if tension is not None:
            beyond = limits is not None and not limits[0] <= tension <= limits[1]
            text = Text(f"{tension:.2f}", style="bold red" if beyond else "")
            bar = bar if limits is None else _bar(tension, *limits)
        drives.add_row(
            str(drive["node"]),
            drive["state"],
            str(drive["position_counts"]),
            f"{drive['position_counts'] - drive['set_counts']:+d}",
            text,
            *([] if limits is None else [bar]),
        )
    return drives


def _bar(tension: float, low: float, high: float) -> Text:
    """A tension as a bar from zero to 110 % of the upper limit, with both limits marked."""
    cells = [" "] * _BAR
    end, *marks = (
        min(max(int(v / (1.1 * high) * _BAR), 0), _BAR - 1) for v in (tension, low, high)
    )
    cells[:end] = "━" * end
    for mark in marks:
        cells[mark] = "│"
    return Text("".join(cells), style="" if low <= tension <= high else "bold red")
