"""Whether this computer was busy with something else while a test ran in real time.

Such a test depends on programs that are woken on time. Where they were not, a run rightly stops,
and its failure says nothing about the code: it is done again. Also repeated are those in which a
process of a run, which no thread of the test can watch, began a cycle late, and those of a page
whose data were stale for a moment, as it then refuses what is pressed. On a computer that kept time
a failure counts at once.
"""

from __future__ import annotations

import re
import threading
import time

import pytest

PERIOD_S = 0.01
LIMIT_S = 0.02
"""A quiet computer wakes a thread within a few milliseconds, also beside one that computes."""
REPEATS = 9
"""Two suites beside four busy loops on two cores spoil two of three attempts at the longest."""

LATE = pytest.StashKey[bool]()
"""Whether a failed test says that something else than its own thread was held up."""


def reports_late_cycles(failure: str) -> bool:
    """Whether the text of a failure holds the message of a run that ended for late cycles.

    So does a drive that stops since SYNC is late, before the next cycle begins.
    """
    late = r"a cycle began \d+\.\d cycles late|SYNC missed or out of time \(error 8700h\)"
    return re.search(late, failure) is not None


class HoldUp:
    """Asks to be woken every 10 ms, in a thread, and keeps by how much it was late at worst."""

    def __init__(self) -> None:
        self.worst_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="hold-up", daemon=True)
        self._thread.start()

    def end(self) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        asked = time.monotonic()
        while not self._over.wait(PERIOD_S):
            woken = time.monotonic()
            self.worst_s = max(self.worst_s, woken - asked - PERIOD_S)
            asked = woken
