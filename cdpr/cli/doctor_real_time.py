"""Whether this user may run the cyclic loop in real time, and the command that allows it."""

from __future__ import annotations

import getpass
import os
import resource
from pathlib import Path

from cdpr.cli.doctor_answer import Answer

CAP_IPC_LOCK = 14
CAP_SYS_NICE = 23
"""Source: linux/capability.h."""

LIMITS = Path("/etc/security/limits.d/cdpr.conf")


def real_time_permission() -> list[Answer]:
    """Priority and locked memory, as `cdpr run` asks for them on a bus with real drives."""
    from executor.realtime import PRIORITY

    priority = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    capabilities = _capabilities()
    return [
        priority_answer(priority, PRIORITY, privileged=bool(capabilities >> CAP_SYS_NICE & 1)),
        memory_answer(locked, privileged=bool(capabilities >> CAP_IPC_LOCK & 1)),
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


def _capabilities() -> int:
    """The effective capabilities of this process."""
    if not Path("/proc/self/status").is_file():
        return 0 if os.geteuid() else -1
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0
