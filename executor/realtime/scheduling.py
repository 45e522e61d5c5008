"""Real-time scheduling of this process while it moves a rig, and a plain word when it is denied."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Protocol

from model.errors import Refused


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

    def wait_to_decide(self) -> None:
        """Waits until just enough of this cycle is left to decide on the next one."""


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

    def wait_to_decide(self) -> None:
        """Within a cycle no time passes."""


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

    #: What the operator and a held control say counts until so much is left, [cycles].
    DECIDING = 0.2

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

    def wait_to_decide(self) -> None:
        """Sleeps; not at all where too little is left already."""
        if self._begin_ns is None:
            return
        latest = self._begin_ns + round((1.0 - self.DECIDING) * self._cycle_ns)
        if time.monotonic_ns() < latest:
            sleep_until(latest)


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


#: Above ordinary programs, below the kernel's own threads.
PRIORITY = 50
_MCL_CURRENT, _MCL_FUTURE = 1, 2

CAP_IPC_LOCK = 14
CAP_SYS_NICE = 23
"""Source: linux/capability.h."""


def has_capability(number: int) -> bool:
    """Whether the kernel grants this process a privilege (linux/capability.h) now."""
    lines = Path("/proc/self/status").read_bytes().splitlines()
    granted = next(line.split()[1] for line in lines if line.startswith(b"CapEff:"))
    return bool(int(granted, 16) >> number & 1)


@contextmanager
def real_time() -> Iterator[str]:
    """Runs the block with SCHED_FIFO, memory locked and garbage collection off.

    Yields:
        Nothing when all of it was granted, otherwise one sentence that says what was denied.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield _enter()
    finally:
        ctypes.CDLL(None).munlockall()
        with suppress(PermissionError):
            os.sched_setscheduler(0, policy, parameter)
        gc.enable()
        gc.unfreeze()


def _enter() -> str:
    denied = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        denied.append("real-time scheduling (allow it with `ulimit -r 50` or CAP_SYS_NICE)")
    if not _lock_memory():
        denied.append("locked memory (allow it with `ulimit -l unlimited` or CAP_IPC_LOCK)")
    return f"denied: {', '.join(denied)}; cycles may be late" if denied else ""


def _lock_memory() -> bool:
    # A lock within a small limit would make later allocations fail instead of being slow.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not (unlimited or has_capability(CAP_IPC_LOCK)):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    return int(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE)) == 0


def require_real_time(denied: str, *, needed: bool) -> None:
    """Nothing on a bus is moved without real-time scheduling, unless the operator accepts that.

    Args:
        denied: What the system did not grant; nothing when it granted all.
        needed: The drives are on a bus, and the operator did not accept it.

    Raises:
        Refused: It is needed and was denied.
    """
    if denied and needed:
        raise Refused(
            f"no real-time scheduling: {denied}",
            where="arming",
            why="without it other programs delay cycles, and late cycles stop the motion",
            next_step="allow it as stated above, or pass --without-real-time to accept that;"
            " nothing was enabled",
        )


# Starting processes beside a run: they are not ended by Ctrl-C, and compute in one thread.


_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def one_thread() -> Iterator[None]:
    """Libraries of a process that is started in the block start no threads of their own."""
    before = {name: os.environ.get(name) for name in _THREAD_COUNTS}
    os.environ.update(dict.fromkeys(_THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Ctrl-C reaches every process of a terminal; when to end is the starting process's decision.

    A blocked signal stays blocked in a process that is started in the block, also while it still
    loads its libraries.
    """
    resource_tracker.ensure_running()  # on its own first start it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
