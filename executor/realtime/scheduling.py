"""Clocks of the control loop, and real-time scheduling of this process."""

from __future__ import annotations

import ctypes
import errno
import gc
import math
import os
import resource
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from multiprocessing import current_process, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Protocol

from model.errors import Fault, Refused


class Clock(Protocol):
    """Clock of the control loop."""

    @property
    def time(self) -> float:
        """Start of the current cycle, [s]; only differences are meaningful."""

    @property
    def now(self) -> float:
        """Present time, on the same scale as `time`, [s]; passes in a suspended computer too."""

    def next_cycle(self) -> float:
        """Waits until the next cycle begins; returns its lateness, in cycles."""

    def time_left(self) -> float:
        """Time left in this cycle to wait for replies, [s]."""

    def wait_to_decide(self) -> None:
        """Waits until just enough of this cycle is left for the next decision."""


class SimulatedClock:
    """Simulated time, which advances by one cycle per call without waiting."""

    def __init__(self, cycle: float) -> None:
        """Starts at 0 with the first call of `next_cycle`."""
        self._cycle, self._cycles = cycle, -1

    @property
    def time(self) -> float:
        """Cycles times their period, [s]."""
        return max(0, self._cycles) * self._cycle

    @property
    def now(self) -> float:
        """Same as `time`: no time passes within a cycle, [s]."""
        return self.time

    def next_cycle(self) -> float:
        """Begins the next cycle at once."""
        self._cycles += 1
        return 0.0

    def time_left(self) -> float:
        """None: replies have already arrived or will not come."""
        return 0.0

    def wait_to_decide(self) -> None:
        """Returns at once: no time passes within a cycle."""


class RealClock:
    """Absolute deadlines on the monotonic clock.

    A late cycle delays all later ones: cycles are never skipped or bunched. Only small scheduling
    delays are caught up, so that they do not accumulate.
    """

    #: Part of each cycle reserved for deciding and sending, [s].
    RESERVE = 0.0005

    #: A larger delay is not caught up, [cycles]: the drives would get two set-points closer
    #: together than their interpolation time.
    CAUGHT_UP = 0.1

    #: Operator requests and held controls count until this much of a cycle is left, [cycles].
    DECIDING = 0.2

    def __init__(self, cycle: float, on_cycle: Callable[[], None] = lambda: None) -> None:
        """The first cycle begins with the first call of `next_cycle`.

        Args:
            cycle: [s].
            on_cycle: Called at the beginning of each cycle.
        """
        self._on_cycle = on_cycle
        self._cycle_ns = round(cycle * 1e9)
        self._begin_ns: int | None = None
        self._woke_ns = 0
        mono = time.monotonic_ns()
        self._not_suspended_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - mono
        self._suspended_ns = 0

    @property
    def time(self) -> float:
        """On the system's monotonic clock, the same in all processes, [s]."""
        return (self._woke_ns or time.monotonic_ns()) / 1e9

    @property
    def now(self) -> float:
        """On the system's monotonic clock, which a suspended computer stops, and that time, [s]."""
        return (time.monotonic_ns() + self._suspended()) / 1e9

    def _suspended(self) -> int:
        """For how long the computer was suspended since this clock was made, [ns]; never more.

        Between the two readings this process may wait: the earlier one is never the later clock's.
        """
        boot = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        return max(0, boot - time.monotonic_ns() - self._not_suspended_ns)

    def next_cycle(self) -> float:
        """Sleeps until the deadline; a suspended computer is late by that time."""
        self._on_cycle()
        self._woke_ns = time.monotonic_ns()
        if self._begin_ns is None:
            self._begin_ns = self._woke_ns
            return 0.0
        deadline = self._begin_ns + self._cycle_ns
        if self._woke_ns < deadline:
            sleep_until(deadline)
            self._woke_ns = time.monotonic_ns()
        before, self._suspended_ns = self._suspended_ns, max(self._suspended_ns, self._suspended())
        late = (self._woke_ns - deadline + self._suspended_ns - before) / self._cycle_ns
        self._begin_ns = deadline if late <= self.CAUGHT_UP else self._woke_ns
        return late

    def time_left(self) -> float:
        """Time until the reserve of this cycle begins, [s]."""
        if self._begin_ns is None:
            return 0.0
        end = self._begin_ns + self._cycle_ns - round(self.RESERVE * 1e9)
        return max(0.0, (end - time.monotonic_ns()) / 1e9)

    def wait_to_decide(self) -> None:
        """Sleeps until then; returns at once if too little is left."""
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
    """Sleeps until a time of the monotonic clock; resumes after interrupts.

    Raises:
        OSError: The system call failed.
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


_ALL_USERS = ["0", "0", "4294967295"]
"""Map of the users of the machine itself. Source: user_namespaces(7)."""


def has_capability(number: int) -> bool:
    """Whether this process has a capability (linux/capability.h) on the machine.

    In a user namespace, such as that of a rootless container, it may have all of them; the kernel
    grants no priority and locks no memory for those.
    """
    users = Path("/proc/self/uid_map")
    if users.exists() and users.read_text().split() != _ALL_USERS:
        return False
    lines = Path("/proc/self/status").read_bytes().splitlines()
    granted = next(line.split()[1] for line in lines if line.startswith(b"CapEff:"))
    return bool(int(granted, 16) >> number & 1)


#: How to allow real-time scheduling that the user may have, but the system still denies.
ALLOW_GROUP = (
    "give this program's control group real-time run time, by `docker run --cpu-rt-runtime=950000`"
    " or in `cpu.rt_runtime_us`, or remove `RestrictRealtime=` from its systemd service"
)


def priority_limit() -> float:
    """Highest real-time priority that this user may have; infinite without a limit."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    unlimited = has_capability(CAP_SYS_NICE) or limit == resource.RLIM_INFINITY
    return math.inf if unlimited else limit


def is_granted_priority() -> bool:
    """Whether the system grants `PRIORITY`, tried in a thread of its own."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(_take_priority).result()


def _take_priority() -> bool:
    """Takes the priority for the calling thread; False if it was denied."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


@contextmanager
def real_time() -> Iterator[str]:
    """Runs the block with SCHED_FIFO, memory locked and garbage collection off.

    Yields:
        A sentence that names what was denied; empty if all was granted.
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
    if not _take_priority():
        by_user = f"allow it with `ulimit -r {PRIORITY}` or CAP_SYS_NICE"
        how = by_user if priority_limit() < PRIORITY else ALLOW_GROUP
        denied.append(f"real-time scheduling ({how})")
    if not _lock_memory():
        denied.append("locked memory (allow it with `ulimit -l unlimited` or CAP_IPC_LOCK)")
    return f"denied: {', '.join(denied)}; cycles may be late" if denied else ""


def _lock_memory() -> bool:
    # Locking under a small limit would make later allocations fail instead of being slow.
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if not (unlimited or has_capability(CAP_IPC_LOCK)):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    return int(libc.mlockall(_MCL_CURRENT | _MCL_FUTURE)) == 0


def require_real_time(denied: str, *, needed: bool) -> None:
    """Requires real-time scheduling for drives on a bus, unless the operator waived it.

    Args:
        denied: What the system denied; empty if nothing.
        needed: Whether the drives are on a bus and the operator did not waive it.

    Raises:
        Refused: Needed and denied.
    """
    if denied and needed:
        raise Refused(
            f"no real-time scheduling: {denied}",
            where="arming",
            why="without it other programs delay cycles, and late cycles stop the motion",
            next_step="allow it as stated above, or accept that with --without-real-time, in Python"
            " need_real_time_rights=False; nothing was enabled",
        )


# Child processes of a run: not ended by Ctrl-C, and single-threaded. Each first imports the script.


def require_imported_script() -> None:
    """Requires that this process does not yet import the script of the process that started it.

    A script without the guard makes all its calls again there.

    Raises:
        SystemExit: It does. Not a `CdprError`, which the script may handle and continue.
    """
    if getattr(current_process(), "_inheriting", False):  # where Python refuses processes too
        raise SystemExit(
            "this process imports the script, and does not run it again: put the script's calls"
            ' below `if __name__ == "__main__":`'
        )


def ended_at_start(name: str, process: BaseProcess, consequence: str = "") -> Fault:
    """The error for a process that ended before its first message; it was joined."""
    if (process.exitcode or 0) < 0:
        why, next_step = "it was killed, or the system ran out of memory", "start again"
    else:
        why = "it failed while it started; its error, if it printed one, is above"
        next_step = (
            "remove the cause: usually a script that is not saved in a file, or has calls outside"
            ' `if __name__ == "__main__":`, or an interpreter or package that this user may not'
            " read"
        )
    return Fault(
        f"{name} ended before it was ready ({exit_text(process)}){consequence}",
        why=why,
        next_step=next_step,
    )


def exit_text(process: BaseProcess) -> str:
    """How a process ended."""
    code = process.exitcode
    return f"killed by signal {-code}" if code is not None and code < 0 else f"exit code {code}"


class _Shared:
    """A context of the whole process that threads may enter side by side: the last one ends it."""

    def __init__(self, make: Callable[[], AbstractContextManager[None]]) -> None:
        self._make, self._lock, self._inside = make, threading.Lock(), 0
        self._context: AbstractContextManager[None] = nullcontext()

    def __call__(self) -> _Shared:
        return self

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._context = self._make()
                self._context.__enter__()
            self._inside += 1

    def __exit__(self, *_error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._context.__exit__(None, None, None)


_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@_Shared
@contextmanager
def one_thread() -> Iterator[None]:
    """Keeps libraries of processes started in the block to one thread."""
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


#: Within this time a waiting thread of this process gets its turn, [s]. Python's own, 5 ms, would
#: add up: a stop passes through several threads of the console and of the run.
SWITCH_INTERVAL = 0.5e-3


@_Shared
@contextmanager
def prompt_threads() -> Iterator[None]:
    """Threads of this process take turns at `SWITCH_INTERVAL` while the block runs."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


#: Shortest time slice of Linux, [ns]; a thread with a short one sooner interrupts busy programs.
_SHORT_SLICE = 100_000
_SET_ATTRIBUTES = {"x86_64": 314, "aarch64": 274}.get(os.uname().machine)
"""Number of the system call `sched_setattr`. Source: Linux, `syscall.tbl` of each machine."""


def take_short_turns() -> None:
    """Lets this thread, and those that it starts, run sooner beside busy programs.

    It takes shorter turns in exchange and needs no right. Linux before 6.12 ignores it.
    """
    if _SET_ATTRIBUTES is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    size, none = struct.calcsize("=IIQiIQQQ"), 0
    attributes = (size, os.SCHED_OTHER, none, nice, none, _SHORT_SLICE, none, none)
    _LIBC.syscall(_SET_ATTRIBUTES, 0, struct.pack("=IIQiIQQQ", *attributes), 0)


@contextmanager
def interrupts_blocked(*others: signal.Signals) -> Iterator[None]:
    """Blocks signals in processes started in the block: their parent decides when to end.

    Those of a terminal (Ctrl-C, or when it is closed) reach all its processes. A blocked signal
    stays blocked in the new process, even while it loads its libraries.

    Args:
        others: Further signals to block.
    """
    resource_tracker.ensure_running()  # its own first start would unblock the signals
    terminal = {signal.SIGINT, signal.SIGHUP, signal.SIGQUIT}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, terminal.union(others))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
