"""Whether this user may run the cyclic loop in real time, and the command that allows it."""

from __future__ import annotations

import getpass
import resource
from pathlib import Path

from cdpr.cli.doctor_answer import Answer

LIMITS = Path("/etc/security/limits.d/cdpr.conf")


def real_time_permission() -> list[Answer]:
    """Priority and locked memory, as `cdpr run` asks for them on a bus with real drives."""
    from executor.realtime import CAP_IPC_LOCK, CAP_SYS_NICE, PRIORITY, has_capability

    priority = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return [
        priority_answer(priority, PRIORITY, privileged=has_capability(CAP_SYS_NICE)),
        memory_answer(locked, privileged=has_capability(CAP_IPC_LOCK)),
    ]


def priority_answer(limit: int, wanted: int, *, privileged: bool) -> Answer:
    """Whether the loop may take its real-time priority (RLIMIT_RTPRIO)."""
    unlimited = limit == resource.RLIM_INFINITY
    text = "allowed" if privileged else f"up to {'any' if unlimited else limit}"
    good = privileged or unlimited or limit >= wanted
    return Answer("real-time priority", good, f"{text}; {wanted} is used", _allow("rtprio", wanted))


def memory_answer(limit: int, *, privileged: bool) -> Answer:
    """Whether the loop's memory may be locked, so that it never waits for a disk."""
    unlimited = limit == resource.RLIM_INFINITY
    text = "allowed" if privileged or unlimited else f"{limit // 1024} KiB; all of it is needed"
    return Answer("locked memory", privileged or unlimited, text, _allow("memlock", "unlimited"))


def _allow(item: str, value: int | str) -> str:
    line = f"{getpass.getuser()} - {item} {value}"
    return f"echo '{line}' | sudo tee -a {LIMITS}, then log out and in again"
