"""The only places that read a clock or let time pass."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Gives the loop its rhythm."""

    @property
    def simulated(self) -> bool:
        """True when time advances with the cycles only."""

    def next_cycle(self) -> float:
        """Waits until the next cycle begins; returns how late it is, in cycles."""

    def time_left(self) -> float:
        """What is left of this cycle to wait for replies, [s]."""


class SimulatedClock:
    """Time that advances by one cycle a call and costs nothing."""

    simulated = True

    def next_cycle(self) -> float:
        """The next cycle begins at once."""
        return 0.0

    def time_left(self) -> float:
        """Replies are there already or will not come."""
        return 0.0


class RealClock:
    """Absolute deadlines on the monotonic clock.

    A late cycle moves all later ones: the path is delayed, cycles are never skipped or bunched.
    Only the scheduler's small delays are caught up with, so that they do not add up.
    """

    simulated = False

    #: Of each cycle, kept free for deciding and sending, [s].
    RESERVE = 0.0005

    #: A cycle that is later than this is not caught up with, [cycles]: the drives would get two
    #: set-points closer to each other than the time in which they interpolate between them.
    CAUGHT_UP = 0.1

    def __init__(self, cycle: float) -> None:
        """The first cycle begins with the first call of `next_cycle`."""
        self._cycle_ns = round(cycle * 1e9)
        self._begin_ns: int | None = None

    def next_cycle(self) -> float:
        """Sleeps until the deadline."""
        now = time.monotonic_ns()
        if self._begin_ns is None:
            self._begin_ns = now
            return 0.0
        deadline = self._begin_ns + self._cycle_ns
        if now < deadline:
            time.sleep((deadline - now) / 1e9)
            now = time.monotonic_ns()
        late = (now - deadline) / self._cycle_ns
        self._begin_ns = deadline if late <= self.CAUGHT_UP else now
        return late

    def time_left(self) -> float:
        """Until the reserve of this cycle begins."""
        if self._begin_ns is None:
            return 0.0
        end = self._begin_ns + self._cycle_ns - round(self.RESERVE * 1e9)
        return max(0.0, (end - time.monotonic_ns()) / 1e9)
