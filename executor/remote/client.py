"""Says something to the runs that are under way, and hears how they stand."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from executor.remote.command_socket import Reached, find_runs
from executor.remote.protocol import make_line
from model.errors import BadInput, Fault
from tracking.measurement import rates

#: A run answers within this, [s]: its socket has a thread of its own.
ANSWER_TIMEOUT = 2.0
#: While there is no run, one is looked for this often, [s].
LOOK = 0.2
_CHUNK = 65536


@dataclass(frozen=True, slots=True)
class Answer:
    """What one run said.

    Attributes:
        process: Its number.
        status: See `executor.remote.status`; None when it did not answer.
        what: Why it has no status, in its own words; empty when it was silent.
        ended: It is gone, so that nothing more will be heard of it.
    """

    process: int
    status: dict[str, Any] | None
    what: str = ""
    ended: bool = False


def ask_all(runs: Sequence[Reached], command: str, percent: int | None = None) -> list[Answer]:
    """Says the same to all runs, to all of them before any answer is waited for."""
    return _ask_all(runs, make_line(command, percent=percent))


def ask(run: Reached, line: bytes) -> Answer:
    """Sends one run a line of `executor.remote.protocol.make_line`; what it said."""
    return _ask_all([run], line)[0]


def _ask_all(runs: Sequence[Reached], line: bytes) -> list[Answer]:
    told = [_told(run, line) for run in runs]
    return [
        _heard(run) if taken else Answer(run.process, None, ended=True)
        for run, taken in zip(runs, told, strict=True)
    ]


class RunLink:
    """A run that is asked again and again; a late answer never passes for that to a later question.

    Attributes:
        owed: Answers that were asked for and have not come.
    """

    def __init__(self, run: Reached) -> None:
        """Nothing was asked yet."""
        self._run, self._begun = run, b""
        self.owed = 0

    def ask(self, line: bytes, patience: float) -> Answer:
        """Sends a line of `make_line`; what is said to it within so long, [s]."""
        if not _told(self._run, line):
            return Answer(self._run.process, None, ended=True)
        self.owed += 1
        return self.hear(patience)

    def hear(self, patience: float) -> Answer:
        """The answer to the last question, once no earlier one is owed; waited for so long, [s]."""
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


def _told(run: Reached, line: bytes) -> bool:
    run.link.settimeout(ANSWER_TIMEOUT)
    try:
        run.link.sendall(line)
    except OSError:  # it ended meanwhile
        return False
    return True


def _heard(run: Reached) -> Answer:
    """What it answers; a run that hangs is distinguished from one that ended."""
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


def last_word(run: Reached) -> dict[str, Any] | None:
    """What a run that ended said when it did; None when it could not say anything."""
    return _heard(run).status


def _line(link: socket.socket) -> bytes:
    """The newest line: a run that ends says once more how it stands."""
    got = b""
    while not got.endswith(b"\n"):
        chunk = link.recv(_CHUNK)
        if not chunk:
            raise ConnectionError("the run ended")
        got += chunk
    return got.splitlines()[-1]


def select_run(runs: Sequence[Reached], process: int | None, verb: str) -> Reached:
    """The run that is meant.

    Raises:
        Fault: No run is under way.
        BadInput: There are several and none was named, or the named one is none of them.
    """
    numbers = ", ".join(str(run.process) for run in runs)
    if not runs:
        raise no_run(verb)
    if process is None and len(runs) > 1:
        raise BadInput(
            f"{len(runs)} runs are in progress",
            where=f"cdpr {verb}",
            next_step=f"name one with --process: {numbers}",
        )
    for run in runs:
        if process is None or run.process == process:
            return run
    raise BadInput(
        f"process {process} is not a run of this user",
        where=f"cdpr {verb}",
        next_step=f"name one of: {numbers}",
    )


def no_run(verb: str) -> Fault:
    """Nothing was reached."""
    return Fault(
        "no active run found for this user",
        where=f"cdpr {verb}",
        why="it has ended, or another user started it",
        next_step="press the emergency stop if the robot moves; a run of another user is"
        f" stopped by that user, or with `sudo cdpr {verb}`",
    )


def no_answer(verb: str, answers: Sequence[Answer]) -> Fault:
    """Runs that got a command and do not report their status."""
    numbers = ", ".join(str(answer.process) for answer in answers)
    words = [answer.what for answer in answers if answer.what]
    if words:
        return Fault(
            f"process {numbers} did not obey, or cannot confirm: {'; '.join(words)}",
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
    """Sends a command to the run that is meant; its status.

    Args:
        command: As `executor.remote.protocol` has it: ``hold``, ``resume``, ``speed``, ``status``.
        process: Number of the run; None for the only one.
        percent: Of the planned speed.
        verb: What the user typed, where that is another word than the command.

    Raises:
        Fault: No run is under way, or it does not answer.
        BadInput: It is not clear which run is meant.
    """
    with find_runs() as runs:
        (answer,) = ask_all([select_run(runs, process, verb or command)], command, percent)
    if answer.status is None:
        raise no_answer(verb or command, [answer])
    return answer.status


@dataclass(frozen=True, slots=True)
class StopResult:
    """Which runs were stopped.

    Attributes:
        stopped: Numbers of those that answered.
        silent: What the others said, if anything.
    """

    stopped: tuple[int, ...]
    silent: tuple[Answer, ...]


def stop_runs() -> StopResult:
    """Stops every run of this user: all drives slow down together along the path, then hold."""
    with find_runs() as runs:
        answers = ask_all(runs, "stop")
    return StopResult(
        tuple(answer.process for answer in answers if answer.status is not None),
        tuple(answer for answer in answers if answer.status is None),
    )


def _pause(seconds: float) -> Sequence[bytes]:
    time.sleep(seconds)
    return ()


def follow_run(
    process: int | None,
    rate: float,
    *,
    waits: bool = False,
    between: Callable[[float], Sequence[bytes]] = _pause,
) -> Iterator[dict[str, Any]]:
    """The status of a run, again and again, on one connection; until it ends.

    Args:
        process: Number of the run; None for the only one.
        rate: Reads a second, [Hz].
        waits: Where there is no run, wait until one begins.
        between: Passes the time given, [s], and says what the run is to be sent, lines of
            `executor.remote.protocol.make_line`.

    Raises:
        Fault: There is no run, or it does not answer, or does not do what it was sent.
        BadInput: It is not clear which run is meant.
    """
    while True:
        with find_runs() as runs:
            if runs or not waits:
                yield from _followed(select_run(runs, process, "monitor"), rate, between)
                return
        between(LOOK)


def _followed(
    run: Reached, rate: float, between: Callable[[float], Sequence[bytes]]
) -> Iterator[dict[str, Any]]:
    status: dict[str, Any] = {}
    lines: Sequence[bytes] = ()
    while True:
        for line in (*lines, make_line("status")):
            answer = ask(run, line)
            if answer.ended:
                last = last_word(run)
                if last is not None:
                    yield last
                return
            if answer.status is None:
                raise no_answer("monitor", [answer])
            status = answer.status
        yield status
        lines = between(1.0 / rate)


# The status of a run as text, see `executor.remote.status`.


def status_text(status: Mapping[str, Any]) -> str:
    """All of it."""
    drives = [
        f"  drive {d['node']:<3} {d['state']:<24} {d['position_counts']:>11}"
        f" ({d['position_counts'] - d['set_counts']:+d}) counts {d['tension_n']:8.2f} N"
        for d in status["drives"]
    ]
    cameras = [f"  camera {camera_line(camera)}" for camera in status["cameras"]]
    events = [f"  {e['time_s']:9.3f} s  {e['code']}: {e['text']}" for e in status["events"]]
    first = f"process {status['process']}: {status['rig']} on {status['bus']}, {status['folder']}"
    return "\n".join([first, status_line(status), *drives, *cameras, *events])


def status_line(status: Mapping[str, Any]) -> str:
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
    """The stop that comes next, how far and how soon; empty where none is known."""
    stop = status["next_stop"]
    if stop is None:
        return ""
    seconds = "" if stop["seconds"] is None else f", {stop['seconds']:.1f} s"
    return f"next: {stop['name']} in {stop['distance_mm']:.1f} mm{seconds}"


def camera_line(camera: Mapping[str, Any]) -> str:
    """One camera while images are measured.

    Args:
        camera: As the status has it.
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
