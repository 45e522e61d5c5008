"""The only places that read a clock or let time pass."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Gives the loop its rhythm."""

    @property
    def time(self) -> float:
        """When the cycle under way began, [s]; only differences have a meaning."""

    @property
    def now(self) -> float:
        """This moment, on the same scale as `time`, [s]."""

    def next_cycle(self) -> float:
        """Waits until the next cycle begins; returns how late it is, in cycles."""

    def time_left(self) -> float:
        """What is left of this cycle to wait for replies, [s]."""


class SimulatedClock:
    """Time that advances by one cycle a call and costs nothing."""

    def __init__(self, cycle: float) -> None:
        """Begins at 0 with the first call of `next_cycle`."""
        self._cycle, self._cycles = cycle, -1

    @property
    def time(self) -> float:
        """Cycles times their length, [s]."""
        return max(0, self._cycles) * self._cycle

    @property
    def now(self) -> float:
        """Within a cycle no time passes, [s]."""
        return self.time

    def next_cycle(self) -> float:
        """The next cycle begins at once."""
        self._cycles += 1
        return 0.0

    def time_left(self) -> float:
        """Replies are there already or will not come."""
        return 0.0


class RealClock:
    """Absolute deadlines on the monotonic clock.

    A late cycle moves all later ones: the path is delayed, cycles are never skipped or bunched.
    Only the scheduler's small delays are caught up with, so that they do not add up.
    """

    #: Of each cycle, kept free for deciding and sending, [s].
    RESERVE = 0.0005

    #: A cycle that is later than this is not caught up with, [cycles]: the drives would get two
    #: set-points closer to each other than the time in which they interpolate between them.
    CAUGHT_UP = 0.1

    def __init__(self, cycle: float, on_cycle: Callable[[], None] = lambda: None) -> None:
        """The first cycle begins with the first call of `next_cycle`.

        Args:
            cycle: [s].
            on_cycle: Called whenever one begins.
        """
        self._on_cycle = on_cycle
        self._cycle_ns = round(cycle * 1e9)
        self._begin_ns: int | None = None
        self._woke_ns = 0

    @property
    def time(self) -> float:
        """On the system's monotonic clock, the same in all processes, [s]."""
        return (self._woke_ns or time.monotonic_ns()) / 1e9

    @property
    def now(self) -> float:
        """On the system's monotonic clock, [s]."""
        return time.monotonic_ns() / 1e9

    def next_cycle(self) -> float:
        """Sleeps until the deadline."""
        self._on_cycle()
        self._woke_ns = time.monotonic_ns()
        if self._begin_ns is None:
            self._begin_ns = self._woke_ns
            return 0.0
        deadline = self._begin_ns + self._cycle_ns
        if self._woke_ns < deadline:
            sleep_until(deadline)
            self._woke_ns = time.monotonic_ns()
        late = (self._woke_ns - deadline) / self._cycle_ns
        self._begin_ns = deadline if late <= self.CAUGHT_UP else self._woke_ns
        return late

    def time_left(self) -> float:
        """Until the reserve of this cycle begins."""
        if self._begin_ns is None:
            return 0.0
        end = self._begin_ns + self._cycle_ns - round(self.RESERVE * 1e9)
        return max(0.0, (end - time.monotonic_ns()) / 1e9)


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


_LIBC = ctypes.CDLL(None)
_TIMER_ABSTIME = 1


def sleep_until(deadline_ns: int) -> None:
    """Sleeps until a moment of the monotonic clock, whatever happens before the call or in it.

    Raises:
        OSError: The system refuses to.
    """
    moment = _Timespec(*divmod(deadline_ns, 1_000_000_000))
    while True:
        result = _LIBC.clock_nanosleep(
            time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(moment), None
        )
        if result == 0:
            return
        if result != errno.EINTR:
            raise OSError(result, os.strerror(result))
