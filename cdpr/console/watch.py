"""Follows whatever moves on the rig's bus, over its command socket; reconnects to the next one."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from executor.remote.client import Answer, ask
from executor.remote.protocol import make_line
from executor.remote.registry import Reached, find_runs

#: While nothing moves, a new run is looked for this often, [s].
LOOK = 0.2


@dataclass(frozen=True, slots=True)
class Look:
    """What a run said.

    Attributes:
        status: See `executor.remote.status`; None when nothing moves.
        at: When, on the monotonic clock, [s].
    """

    status: dict[str, Any] | None
    at: float


class RunWatch:
    """Of the runs on one bus; safe to use from several threads."""

    def __init__(self, bus: str) -> None:
        """Not connected yet; the bus as a run's status names it."""
        self._bus = bus
        self._lock = threading.Lock()
        self._links = ExitStack()
        self._run: Reached | None = None
        self._looked = float("-inf")
        self.last = Look(None, time.monotonic())

    def look(self) -> Look:
        """Asks the run that moves; finds one where none did."""
        with self._lock:
            now = time.monotonic()
            if self._run is None and now - self._looked >= LOOK:
                self._looked = now
                self._connect()
            if self._run is None:
                self.last = Look(None, now)
            else:
                self._take(ask(self._run, make_line("status")))
            return self.last

    def say(self, command: str, **values: Any) -> str:
        """Sends the run a command; why it was not taken, or nothing."""
        with self._lock:
            if self._run is None:
                return "nothing moves"
            answer = ask(self._run, make_line(command, **values))
            if answer.what:
                return answer.what
            self._take(answer)
            return "" if answer.status is not None else "the run does not answer"

    def close(self) -> None:
        """Lets go of the connection."""
        with self._lock:
            self._let_go()

    def _take(self, answer: Answer) -> None:
        """An answer counts as new data; silence leaves the old, which then becomes stale."""
        if answer.status is not None:
            self.last = Look(answer.status, time.monotonic())
        elif answer.ended:
            self._let_go()
            self.last = Look(None, time.monotonic())

    def _connect(self) -> None:
        links = self._links.enter_context(ExitStack())
        for run in links.enter_context(find_runs()):
            answer = ask(run, make_line("status"))
            if answer.status is not None and answer.status["bus"] == self._bus:
                self._run = run
                return
        self._let_go()

    def _let_go(self) -> None:
        self._run = None
        self._links.close()
