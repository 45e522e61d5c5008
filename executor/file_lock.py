"""Locks on files, which the system gives back when a program ends, however it ends."""

from __future__ import annotations

import fcntl
import time

#: Looked at again this often, [s].
_AGAIN = 0.01


def locked_within(handle: int, seconds: float) -> bool:
    """Locks an open file for this program alone; waits so long for those who have it, [s]."""
    until = time.monotonic() + seconds
    while True:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                return False
            time.sleep(_AGAIN)
        else:
            return True
