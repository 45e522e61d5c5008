"""Which runs are going on, so that `cdpr stop` reaches them from any terminal of the user.

A run leaves a file named after its process in the user's run-time folders and holds a lock on it; a
file without a lock was left by a process that is gone. It is announced in every folder that another
terminal may look into, and only in folders that nobody else can write to: a folder in /tmp that
another user made could hold links to this user's files, or name processes that are no runs.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from cdpr.errors import Refused

#: A closed terminal (SIGHUP) must not leave the rig without its loop.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ENDING = ".run"


def _candidates() -> list[Path]:
    """The user's run-time folder, where the system has one, and one below the temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(base) / "cdpr"] if base else []
    return [*folders, Path(tempfile.gettempdir()) / f"cdpr-{os.getuid()}"]


def _opened(folder: Path) -> int | None:
    """The folder as a file descriptor if it is there, this user's, and closed to all others."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # not there, a link, or not ours to read
        return None
    status = os.fstat(descriptor)
    if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
        os.close(descriptor)
        return None
    return descriptor


@contextlib.contextmanager
def _folders(*, make: bool) -> Iterator[list[int]]:
    """Descriptors of all usable folders."""
    opened: list[int] = []
    try:
        for folder in _candidates():
            if make:
                with contextlib.suppress(OSError):  # there already, or its parent is read-only
                    folder.mkdir(mode=0o700)
            descriptor = _opened(folder)
            if descriptor is not None:
                opened.append(descriptor)
        yield opened
    finally:
        for descriptor in opened:
            os.close(descriptor)


@contextlib.contextmanager
def announced() -> Iterator[None]:
    """Makes this process known to `stop_all` for as long as the block runs.

    Raises:
        Refused: There is no folder for it that only this user can write to.
    """
    name = f"{os.getpid()}{_ENDING}"
    with _folders(make=True) as folders, contextlib.ExitStack() as announcements:
        if not folders:
            raise Refused(
                "`cdpr stop` could not reach this run",
                where=" or ".join(map(str, _candidates())),
                why="no such folder belongs to this user alone; another user may have made it",
                next_step="remove it or close it to others (chmod 700), or set XDG_RUNTIME_DIR",
            )
        for folder in folders:
            announcements.callback(os.close, _locked(folder, name))
            announcements.callback(_removed, folder, name)
        yield


def _locked(folder: int, name: str) -> int:
    """The file's descriptor, locked, and certainly the one that the name stands for."""
    while True:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        file = os.open(name, flags, 0o600, dir_fd=folder)
        fcntl.flock(file, fcntl.LOCK_EX)
        with contextlib.suppress(FileNotFoundError):
            named = os.stat(name, dir_fd=folder, follow_symlinks=False)
            if os.path.samestat(named, os.fstat(file)):
                return file
        os.close(file)  # `stop_all` took it for a stale one and removed it before it was locked


def _removed(folder: int, name: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)


def stop_all() -> list[int]:
    """Asks every run of this user to stop; returns their process numbers."""
    running: set[int] = set()
    with _folders(make=False) as folders:
        for folder in folders:
            names = (name for name in os.listdir(folder) if name.endswith(_ENDING))
            numbers = (name.removesuffix(_ENDING) for name in names)
            running |= {int(n) for n in numbers if n.isdecimal() and _is_held(folder, n + _ENDING)}
    return [number for number in sorted(running) if _asked_to_stop(number)]


def _is_held(folder: int, name: str) -> bool:
    """Whether a run holds the file; one that nobody holds is removed."""
    try:
        file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    except OSError:  # gone meanwhile, or no file of ours
        return False
    try:
        # Shared, so that two `cdpr stop` at once do not take each other for a run.
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    else:
        _removed(folder, name)
        return False
    finally:
        os.close(file)


def _asked_to_stop(number: int) -> bool:
    try:
        os.kill(number, signal.SIGTERM)
    except ProcessLookupError:  # it ended meanwhile
        return False
    return True


@contextlib.contextmanager
def stop_requests() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C, SIGTERM and a closed terminal into a request the loop asks for every cycle."""
    requested = False

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        nonlocal requested
        requested = True

    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    if before[signal.SIGHUP] is signal.SIG_IGN:  # started with nohup: meant to outlive its terminal
        del before[signal.SIGHUP]
    try:
        for number in before:
            signal.signal(number, on_signal)
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
