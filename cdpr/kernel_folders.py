"""Where machine code is kept between runs, and when old code is thrown away.

Every state of the kernels has a folder of its own (`cdpr.compiled`). A process holds a
shared lock in each folder it uses until it ends; beginning a new one throws away those that nobody
holds and nobody began to use for two days. Folders that the user named (``NUMBA_CACHE_DIR``) are
left alone.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
import time
from pathlib import Path

UNUSED = 2 * 24 * 3600.0
"""How long nobody must have begun to use a folder before it is thrown away, [s]."""
_LOCK = "in-use"
_OURS = re.compile(r"[0-9a-f]{16}|removed-\w+")
"""Names of versions, and of what a process that was ended did not get to remove."""
_ATTEMPTS = 10


def use_folder(version: str) -> Path | None:
    """The folder of a version, held until the process ends; None where none can be written."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    try:
        if given:
            folder = Path(given) / version
            folder.mkdir(parents=True, exist_ok=True)
        else:
            folder = _own_folder() / version
            is_new = not folder.exists()
            _hold(folder)
            if is_new:
                throw_away_unused(folder.parent, time.time())
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:  # read-only or full: compiled code is then not kept
        return None


def throw_away_unused(parent: Path, now: float) -> None:
    """Removes the folders of versions that no process holds and none used for `UNUSED`.

    Args:
        parent: Of the folders.
        now: Seconds since the epoch.
    """
    for folder in parent.iterdir():
        try:
            if _OURS.fullmatch(folder.name) and now - folder.stat().st_mtime > UNUSED:
                _throw_away(folder)
        except OSError:  # another process was faster, or it is not ours to remove
            continue


def _own_folder() -> Path:
    cache_home = os.environ.get("XDG_CACHE_HOME")
    parent = Path(cache_home) if cache_home else Path.home() / ".cache"
    return parent / "cdpr" / "kernels"


def _hold(folder: Path) -> None:
    """Makes the folder, marks it as used now, and holds it as long as the process lives.

    Raises:
        OSError: It cannot be made or locked.
    """
    for _ in range(_ATTEMPTS):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(lock, fcntl.LOCK_SH)
        if _is_same(lock, folder / _LOCK):
            os.utime(folder)
            return  # the file stays open, and the lock with it
        os.close(lock)  # thrown away in between
    raise OSError(f"{folder} is thrown away again and again")


def _throw_away(folder: Path) -> None:
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        away = Path(tempfile.mkdtemp(prefix="removed-", dir=folder.parent))
        folder.rename(away / folder.name)
        shutil.rmtree(away)
    finally:
        os.close(lock)


def _is_same(lock: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(lock), path.stat())
    except FileNotFoundError:
        return False
