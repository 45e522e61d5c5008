"""Says something to the runs that are under way, and hears how they stand."""

from __future__ import annotations

import json
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cdpr.errors import BadInput, Fault
from executor.commands import make_line
from executor.running import Reached

#: A run answers within this, [s]: its socket has a thread of its own.
ANSWER_TIMEOUT = 2.0
_CHUNK = 65536


@dataclass(frozen=True, slots=True)
class Answer:
    """What one run said.

    Attributes:
        process: Its number.
        status: See `executor.status`; None when it did not answer.
    """

    process: int
    status: dict[str, Any] | None


def ask_all(runs: Sequence[Reached], command: str, percent: int | None = None) -> list[Answer]:
    """Says the same to all runs, to all of them before any answer is waited for."""
    line = make_line(command, percent)
    told = [_told(run, line) for run in runs]
    return [
        Answer(run.process, _status(run) if heard else None)
        for run, heard in zip(runs, told, strict=True)
    ]


def _told(run: Reached, line: bytes) -> bool:
    run.link.settimeout(ANSWER_TIMEOUT)
    try:
        run.link.sendall(line)
    except OSError:  # it ended meanwhile
        return False
    return True


def _status(run: Reached) -> dict[str, Any] | None:
    """What it answers; None when it ends or hangs."""
    try:
        answer = json.loads(_line(run.link))
    except (OSError, ValueError):
        return None
    status = answer.get("status") if isinstance(answer, dict) else None
    return status if isinstance(status, dict) else None


def _line(link: socket.socket) -> bytes:
    got = b""
    while not got.endswith(b"\n"):
        chunk = link.recv(_CHUNK)
        if not chunk:
            raise ConnectionError("the run ended")
        got += chunk
    return got


def the_one(runs: Sequence[Reached], process: int | None, verb: str) -> Reached:
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
            f"{len(runs)} runs are under way",
            where=f"cdpr {verb}",
            next_step=f"name one of them with --process: {numbers}",
        )
    for run in runs:
        if process is None or run.process == process:
            return run
    raise BadInput(
        f"process {process} is no run of yours",
        where=f"cdpr {verb}",
        next_step=f"name one of these: {numbers}",
    )


def no_run(verb: str) -> Fault:
    """Nothing was reached."""
    return Fault(
        "no run of yours is going on, so nothing was told to anybody",
        where=f"cdpr {verb}",
        why="it ended already, or another user started it",
        next_step="press the emergency stop if something moves; a run of another user is"
        " reached by that user or by root",
    )


def no_answer(verb: str, processes: Sequence[int]) -> Fault:
    """A run listens and does not answer."""
    numbers = ", ".join(map(str, processes))
    return Fault(
        f"process {numbers} did not answer within {ANSWER_TIMEOUT:g} s",
        where=f"cdpr {verb}",
        why="it is ending, was suspended, or hangs; what moves the drives stops by itself when"
        " nobody supervises it",
        next_step="press the emergency stop if something still moves",
    )
