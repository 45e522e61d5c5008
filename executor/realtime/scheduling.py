"""Real-time scheduling of this process while it moves a rig, and a plain word when it is denied."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path

from model.errors import Refused

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
