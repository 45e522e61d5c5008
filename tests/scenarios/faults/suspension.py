"""The executor is suspended (SIGSTOP) for some milliseconds while the drives move.

The effect is observed at the drives: every set-point frame and every state.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass

from drivers.cia402.state_machine import DriveState
from tests.scenarios.faults.samples import ENABLED, WatchedRehearsal

HOLDING = DriveState.QUICK_STOP_ACTIVE
ENABLE_OPERATION = 0x0F


class Suspension:
    """One SIGSTOP, at the first SYNC from a given one on, and one SIGCONT.

    Attributes:
        done: It has happened.
    """

    def __init__(self, process: Callable[[], int], milliseconds: float, after: float = 0.0) -> None:
        """Nothing happens yet.

        Args:
            process: Returns the process to suspend.
            milliseconds: Duration.
            after: From the SYNC until it begins, [s].
        """
        self._process, self._seconds, self._after = process, milliseconds / 1000.0, after
        self._thread: threading.Thread | None = None
        self.done = threading.Event()

    def begin(self) -> None:
        """Called from the drives' thread, without delaying it; once."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._suspend)
            self._thread.start()

    def _suspend(self) -> None:
        process = self._process()
        signal.sigtimedwait([], self._after)
        os.kill(process, signal.SIGSTOP)
        signal.sigtimedwait([], self._seconds)
        os.kill(process, signal.SIGCONT)
        self.done.set()

    def join(self) -> None:
        """Waits for its end, if it began."""
        if self._thread is not None:
            self._thread.join()


@dataclass(frozen=True, slots=True)
class Seen:
    """Observations at the drives.

    Attributes:
        returned: Drives, from 1, that were enabled again after they had stopped.
        enabled_after_stop: "Enable operation" frames that reached a drive after it had stopped.
        stopped: Drives that hold at the end.
    """

    returned: tuple[int, ...]
    enabled_after_stop: int
    stopped: int


def seen_by(rehearsal: WatchedRehearsal) -> Seen:
    """Evaluates all samples and frames of a run."""
    over: list[float | None] = [None] * len(rehearsal.drives)
    returned: set[int] = set()
    was = rehearsal.samples[0]
    for sample in rehearsal.samples[1:]:
        for i, (old, new) in enumerate(zip(was.states, sample.states, strict=True)):
            if old is ENABLED and new is not ENABLED and over[i] is None:
                over[i] = sample.time
            elif over[i] is not None and new is ENABLED:
                returned.add(i + 1)
        was = sample
    first = {drive.node: over[i] for i, drive in enumerate(rehearsal.drives)}
    enabled_after_stop = sum(
        1
        for at, node, word in rehearsal.words
        if (stop := first[node]) is not None and at > stop and word & 0x0F == ENABLE_OPERATION
    )
    stopped = sum(drive.state is HOLDING for drive in rehearsal.drives)
    return Seen(tuple(sorted(returned)), enabled_after_stop, stopped)
