"""Where is kept, from one program to the next, what is known of a bus: its latch, its reference.

One folder for all users where an administrator made it, else the user's own: a fault that one user
saw is then unknown to another one. A file is named after the bus, however its name is spelled.
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.can_bus import IN_PROCESS, BusSettings
from model.errors import Refused

#: Used by everybody once it exists: ``sudo install -d -m 2775 -g GROUP /var/lib/cdpr``.
SHARED = Path("/var/lib/cdpr")
#: A latch or a reference of many cables has a few kilobytes.
LARGEST_FILE = 65_536

_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def state_folder() -> Path:
    """The folder, which may not exist yet."""
    if SHARED.is_dir():
        return SHARED
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "cdpr"


def state_file(kind: str, settings: BusSettings) -> Path:
    """The file of a kind, such as ``latched``, for a bus."""
    name = re.sub(r"[^A-Za-z0-9.]+", "-", settings.canonical)
    return state_folder() / f"{kind}-{name}.json"


def open_state_file(path: Path, *, create: bool = False) -> int:
    """Opens a file of the state folder for reading; the caller closes it.

    The folder may be shared: any user with write access could put a link to another file there, or
    a FIFO, which would keep a program waiting for ever. Neither is followed or waited for.

    Args:
        path: The file.
        create: Make an empty one where there is none.

    Raises:
        Refused: It is no regular file.
        OSError: It cannot be opened.
    """
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        handle = os.open(path, flags | (os.O_CREAT if create else 0), 0o644)
    except FileNotFoundError:
        raise
    except OSError:
        _require_regular(path, path.lstat().st_mode)
        raise
    try:
        _require_regular(path, os.fstat(handle).st_mode)
    except BaseException:
        os.close(handle)
        raise
    return handle


def read_state_file(path: Path) -> str:
    """The text of a file of the state folder.

    Raises:
        Refused: It is no regular file, or too large for what is kept there.
        OSError: It cannot be read.
        UnicodeDecodeError: It is not UTF-8.
    """
    with os.fdopen(open_state_file(path), "rb") as stream:
        data = stream.read(LARGEST_FILE + 1)
    if len(data) > LARGEST_FILE:
        raise _refusal(path, f"it is larger than {LARGEST_FILE} bytes")
    return data.decode("utf-8")


def _require_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "a special file")
        raise _refusal(path, f"it is {kind}, not a regular file")


def _refusal(path: Path, what: str) -> Refused:
    return Refused(
        f"{what}, and is not used",
        where=str(path),
        why="this program did not create it; another user of the folder did",
        next_step=f"find its owner (`ls -l {path}`), then remove it; nothing was moved",
    )


# Locks on files, which the system gives back when a program ends, however it ends.


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


# Who sets the drives of a bus up, or asks them for objects, does so alone.
#
# A drive answers one such request at a time and does not say to whom: the answer to somebody else's
# would be taken for one's own. A bus of this process alone (``virtual``) has no other user.


#: Who only asks how the drives stand is done within this, unless one does not answer, [s].
ASKED_WITHIN = 5.0


class SetUpLock:
    """Of one bus."""

    def __init__(self, settings: BusSettings) -> None:
        """Looks at nothing yet."""
        self._bus, self._is_shared = str(settings), settings.interface != IN_PROCESS
        self._path = state_file("set-up", settings).with_suffix(".lock")

    @contextmanager
    def held(self) -> Iterator[None]:
        """For who sets the drives up, until they are done with; waits for those who only ask.

        Raises:
            Refused: Somebody else has it, or the lock cannot be made.
        """
        if not self._is_shared:
            yield
            return
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = open_state_file(self._path, create=True)
        except OSError as error:
            raise Refused(
                "exclusive access to the drives cannot be ensured",
                where=str(self._path),
                why=error.strerror or str(error),
                next_step="make the folder writable for the operators of the rig",
            ) from None
        try:
            if not locked_within(lock, ASKED_WITHIN):
                raise Refused(
                    "another program is configuring or reading these drives",
                    where=f"bus {self._bus}",
                    next_step="wait until it is done (`cdpr monitor` shows motions)."
                    " Nothing was moved",
                )
            yield
        finally:
            os.close(lock)

    @contextmanager
    def tried(self) -> Iterator[bool]:
        """For readers: takes it if it is free, and returns whether it was. Makes no file.

        Raises:
            Refused: The lock is no regular file.
        """
        try:
            lock = open_state_file(self._path)
        except OSError:  # no program on this computer has used these drives
            yield True
            return
        try:
            yield locked_within(lock, 0.0)
        finally:
            os.close(lock)
