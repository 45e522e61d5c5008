"""Client of the command sockets: sends commands to active runs, reads their status."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from executor.remote.command_socket import RunConnection, find_runs, record_stop
from executor.remote.protocol import make_line
from executor.state_machine import State
from model.errors import BadInput, Fault
from tracking.measurement import rates

#: Time-out of an answer, [s]; a run answers in a separate thread.
ANSWER_TIMEOUT = 2.0
#: Interval of searches for a run, [s].
POLL_INTERVAL = 0.2
_CHUNK = 65536
_OVER = {state.value for state in (State.FINISHED, State.STOPPED, State.LATCHED)}


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of one run.

    Attributes:
        process: Its process ID.
        status: See `executor.remote.status`; None without an answer.
        what: Its message on a missing status; empty if it was silent.
        ended: The run has ended: no further answers will come.
    """

    process: int
    status: dict[str, Any] | None
    what: str = ""
    ended: bool = False


def ask_all(
    runs: Sequence[RunConnection], command: str, percent: int | None = None
) -> list[Answer]:
    """Sends a command to all runs before waiting for answers."""
    return _ask_all(runs, make_line(command, percent=percent))


def ask(run: RunConnection, line: bytes) -> Answer:
    """Sends a line of `executor.remote.protocol.make_line` to a run; returns its answer."""
    return _ask_all([run], line)[0]


def _ask_all(runs: Sequence[RunConnection], line: bytes) -> list[Answer]:
    unsent = [_send_line(run, line) for run in runs]
    return [_receive(run) if why is None else why for run, why in zip(runs, unsent, strict=True)]


class RunLink:
    """A connection for repeated requests; matches late answers to their requests.

    Attributes:
        owed: Outstanding answers.
    """

    def __init__(self, run: RunConnection) -> None:
        self._run, self._begun = run, b""
        self.owed = 0

    def ask(self, line: bytes, patience: float) -> Answer:
        """Sends a line of `make_line`; waits up to ``patience`` [s] for its answer."""
        if unsent := _send_line(self._run, line):
            return unsent
        self.owed += 1
        return self.hear(patience)

    def hear(self, patience: float) -> Answer:
        """The answer to the last request, after all earlier ones; waits up to ``patience`` [s]."""
        newest, latest = b"", time.monotonic() + patience
        while self.owed:
            try:
                self._run.link.settimeout(max(1e-3, latest - time.monotonic()))
                chunk = self._run.link.recv(_CHUNK)
            except TimeoutError:
                return Answer(self._run.process, None)
            except OSError:
                chunk = b""
            if not chunk:
                return Answer(self._run.process, None, ended=True)
            *lines, self._begun = (self._begun + chunk).split(b"\n")
            self.owed = max(0, self.owed - len(lines))
            newest = lines[-1] if lines else newest
        return _parsed(self._run.process, newest)


def _send_line(run: RunConnection, line: bytes) -> Answer | None:
    """Sends a line; returns what an answer would be if it cannot be sent, else None."""
    if not run.is_connected:
        return Answer(run.process, None)
    run.link.settimeout(ANSWER_TIMEOUT)
    try:
        run.link.sendall(line)
    except TimeoutError:
        return Answer(run.process, None)
    except OSError:
        return Answer(run.process, None, ended=True)
    return None


def _receive(run: RunConnection) -> Answer:
    """The run's answer; distinguishes a hung run from one that ended."""
    try:
        line = _line(run.link)
    except TimeoutError:
        return Answer(run.process, None)
    except OSError:
        return Answer(run.process, None, ended=True)
    return _parsed(run.process, line)


def _parsed(process: int, line: bytes) -> Answer:
    try:
        answer = json.loads(line)
    except ValueError as error:
        return Answer(process, None, f"its answer cannot be read: {error}")
    status = answer.get("status") if isinstance(answer, dict) else None
    if isinstance(status, dict):
        return Answer(process, status)
    what = answer.get("what") if isinstance(answer, dict) else None
    return Answer(process, None, str(what or "its answer is empty"))


def final_status(run: RunConnection) -> dict[str, Any] | None:
    """The status that a run sent when it ended; None without one."""
    return _receive(run).status


def _line(link: socket.socket) -> bytes:
    """The newest line: a run sends its status again when it ends."""
    got = b""
    while not got.endswith(b"\n"):
        chunk = link.recv(_CHUNK)
        if not chunk:
            raise ConnectionError("the run ended")
        got += chunk
    return got.splitlines()[-1]


def select_run(runs: Sequence[RunConnection], process: int | None, verb: str) -> RunConnection:
    """The selected run.

    Raises:
        Fault: No run is active.
        BadInput: Several runs and none selected, the selected one is not among them, or its process
            has several.
    """
    processes = list(dict.fromkeys(run.process for run in runs))
    numbers = ", ".join(map(str, processes))
    if not runs:
        raise no_run(verb)
    found = [run for run in runs if process in (None, run.process)]
    if len(found) == 1:
        return found[0]
    if process is None and len(processes) > 1:
        raise BadInput(
            f"{len(runs)} runs are in progress",
            where=f"cdpr {verb}",
            next_step=f"name one with `process=`: {numbers}",
        )
    if found:
        raise BadInput(
            f"process {found[0].process} has {len(found)} runs in progress",
            where=f"cdpr {verb}",
            why="threads of one program share its number",
            next_step="start each run in a process of its own; `cdpr stop` stops all of them",
        )
    raise BadInput(
        f"process {process} is not a run of this user",
        where=f"cdpr {verb}",
        next_step=f"name one of: {numbers}",
    )


def no_run(verb: str) -> Fault:
    """Error when no run was found."""
    whose = started = stopped = ""
    if os.geteuid() != 0:  # root reaches the runs of all users
        whose, started = " for this user", ", or another user started it"
        stopped = "; a run of another user is stopped by that user, or with `sudo cdpr stop`"
    return Fault(
        f"no active run found{whose}",
        where=f"cdpr {verb}",
        why="it has ended, or is still being prepared (`cdpr stop` cancels it, also one that was"
        f" just started){started}",
        next_step=f"press the emergency stop if the robot moves{stopped}",
    )


def no_answer(verb: str, answers: Sequence[Answer]) -> Fault:
    """Error when runs received a command and did not report their status."""
    numbers = ", ".join(str(answer.process) for answer in answers)
    words = [answer.what for answer in answers if answer.what]
    if words:
        return Fault(
            f"process {numbers} rejected the command, or cannot confirm it: {'; '.join(words)}",
            where=f"cdpr {verb}",
            next_step="press the emergency stop if the robot still moves",
        )
    if all(answer.ended for answer in answers):
        return Fault(
            f"process {numbers} ended before it received the command",
            where=f"cdpr {verb}",
            next_step="check its run folder; press the emergency stop if the robot still moves",
        )
    return Fault(
        f"process {numbers} did not answer within {ANSWER_TIMEOUT:g} s",
        where=f"cdpr {verb}",
        why="it is ending, was suspended, or hangs; motion stops on its own when"
        " the supervisor is lost",
        next_step="press the emergency stop if the robot still moves",
    )


def request_run(
    command: str, process: int | None = None, percent: int | None = None, *, verb: str = ""
) -> dict[str, Any]:
    """Sends a command to a run; returns its status.

    Args:
        command: See `executor.remote.protocol`: ``hold``, ``resume``, ``speed``, ``status``.
        process: ID of its process; None for the only run.
        percent: Of the planned speed.
        verb: Command-line verb, if it differs from the command.

    Raises:
        Fault: No run is active, or it does not answer.
        BadInput: The run is ambiguous.
    """
    with find_runs() as runs:
        (answer,) = ask_all([select_run(runs, process, verb or command)], command, percent)
    if answer.status is None:
        raise no_answer(verb or command, [answer])
    return answer.status


@dataclass(frozen=True, slots=True)
class StopResult:
    """Result of a stop request to all runs.

    Attributes:
        stopped: Process IDs of runs that answered.
        silent: Answers of the others.
    """

    stopped: tuple[int, ...]
    silent: tuple[Answer, ...]


def motions_on(bus: str) -> dict[int, str]:
    """State of the motion on a bus by its process, from the start of its preparation to its end."""
    with find_runs(ahead=True) as runs:
        found = [answer.status for answer in ask_all(runs, "status") if answer.status]
    here = {one["process"]: one["state"] for one in found if one["bus"] == bus}
    return {process: state for process, state in here.items() if state not in _OVER}


def stop_runs() -> StopResult:
    """Stops every run of this user: all drives slow down together along the path, then hold.

    A motion that is still being prepared ends before anything moves; so does one whose program was
    just started, and answers nothing yet.
    """
    record_stop()
    with find_runs(ahead=True) as runs:
        answers = ask_all(runs, "stop")
    return StopResult(
        tuple(dict.fromkeys(a.process for a in answers if a.status is not None)),
        tuple(answer for answer in answers if answer.status is None),
    )


def _pause(seconds: float) -> Sequence[bytes]:
    time.sleep(seconds)
    return ()


def _raise_rejected(answer: Answer) -> None:
    raise no_answer("monitor", [answer])


def follow_run(
    process: int | None,
    rate: float,
    *,
    waits: bool = False,
    between: Callable[[float], Sequence[bytes]] = _pause,
    rejected: Callable[[Answer], None] = _raise_rejected,
) -> Iterator[dict[str, Any]]:
    """Yields the status of a run repeatedly over one connection, until it ends.

    Args:
        process: ID of its process; None for the only run.
        rate: Reading rate, [Hz].
        waits: Without a run, wait until one begins.
        between: Waits for a time, [s], and returns lines to send, made by
            `executor.remote.protocol.make_line`.
        rejected: Called with the answer to a line that the run rejected (default: a `Fault`).

    Raises:
        Fault: There is no run, or it does not answer.
        BadInput: The run is ambiguous.
    """
    while True:
        with find_runs() as runs:
            if runs or not waits:
                run = select_run(runs, process, "monitor")
                yield from _followed(run, rate, between, rejected)
                return
        between(POLL_INTERVAL)


def _followed(
    run: RunConnection,
    rate: float,
    between: Callable[[float], Sequence[bytes]],
    rejected: Callable[[Answer], None],
) -> Iterator[dict[str, Any]]:
    status: dict[str, Any] = {}
    lines: Sequence[bytes] = ()
    ask_status = make_line("status")
    while True:
        for line in (*lines, ask_status):
            answer = ask(run, line)
            if answer.ended:
                last = final_status(run)
                if last is not None:
                    yield last
                return
            if answer.status is not None:
                status = answer.status
            elif answer.what and line != ask_status:
                rejected(answer)
            else:
                raise no_answer("monitor", [answer])
        yield status
        lines = between(1.0 / rate)


# Status of a run as text; see `executor.remote.status`.


def status_text(status: Mapping[str, Any]) -> str:
    """The complete status."""
    drives = [
        f"  drive {d['node']:<3} {d['state']:<24} {d['position_counts']:>11}"
        f" ({d['position_counts'] - d['set_counts']:+d}) counts"
        f" {_number(cable_tension(d), '.2f'):>8} N"
        for d in status["drives"]
    ]
    cameras = [f"  camera {camera_line(camera)}" for camera in status["cameras"]]
    events = [f"  {e['time_s']:9.3f} s  {e['code']}: {e['text']}" for e in status["events"]]
    first = f"process {status['process']}: {status['rig']} on {status['bus']}, {status['folder']}"
    return "\n".join([first, status_line(status), *drives, *cameras, *events])


def cable_tension(drive: Mapping[str, Any]) -> float | None:
    """Tension of a drive's cable, [N]; None without torque, as a brake may hold the cable.

    Args:
        drive: Its entry in the status.
    """
    return None if drive["torque"] == "none" else float(drive["tension_n"])


def status_line(status: Mapping[str, Any]) -> str:
    """One line with the progress of the run."""
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


def _progress(status: Mapping[str, Any]) -> str:
    if status["path_mm"] is None:
        return "no path" if status["row"] is None else f"{status['row']:.0f} % done"
    return f"{status['path_mm']:.1f} of {status['path_length_mm']:.1f} mm"


def _lateness(status: Mapping[str, Any]) -> str:
    if status["simulated_time"]:
        return "simulated time"
    return f"late {status['lateness_ms']:.2f} ms, at most {status['worst_lateness_ms']:.2f} ms"


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def next_stop_line(status: Mapping[str, Any]) -> str:
    """Next stop with distance and time; empty if unknown."""
    stop = status["next_stop"]
    if stop is None:
        return ""
    seconds = "" if stop["seconds"] is None else f", {stop['seconds']:.1f} s"
    return f"next: {stop['name']} in {stop['distance_mm']:.1f} mm{seconds}"


def camera_line(camera: Mapping[str, Any]) -> str:
    """One line on a camera.

    Args:
        camera: Its entry in the status.
    """
    parts = [
        f"{camera['name']} ({camera['source']})",
        rates(camera["pictures_per_second"], camera["measuring_ms"], len(camera["tags"])),
        f"{camera['poses']} of {camera['pictures']} with a pose",
    ]
    if camera["dropped"]:
        parts.append(f"{camera['dropped']} dropped")
    if camera["trouble"]:
        parts.append(camera["trouble"])
    return ", ".join(parts)
