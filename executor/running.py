"""Which runs are going on, so that `cdpr stop` reaches them from any terminal of the user.

A run leaves a file named after its process in the user's run-time folder and holds a lock on it; a
file without a lock was left by a process that is gone.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def _folder() -> Path:
    """The user's run-time folder; below the temporary folder where the system has none."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.access(base, os.W_OK):
        return Path(base) / "cdpr"
    return Path(tempfile.gettempdir()) / f"cdpr-{os.getuid()}"


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Makes this process known to `stop_all` for as long as the block runs."""
    folder = _folder()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = folder / f"{os.getpid()}.run"
    with path.open("w", encoding="ascii") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def stop_all() -> list[int]:
    """Asks every run of this user to stop; returns their process numbers."""
    stopped = []
    for path in sorted(_folder().glob("*.run")):
        with path.open("r", encoding="ascii") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                number = int(path.stem)
                os.kill(number, signal.SIGTERM)
                stopped.append(number)
            else:
                path.unlink(missing_ok=True)
    return stopped


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C and SIGTERM into a request that the loop asks for every cycle."""
    requested = False

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        nonlocal requested
        requested = True

    before = {number: signal.signal(number, on_signal) for number in STOP_SIGNALS}
    try:
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
