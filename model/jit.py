"""Compilation of kernels, and the cache of their machine code.

Numba recompiles a cached function when its own file changes, not when a function it calls does. So
the cache folder is named after the content of all files beside the function and in the folders of
kernels that it calls, and after the Python and the processor, whose code Numba keeps apart: any
change starts a new one. It is in the user's cache (``NUMBA_CACHE_DIR``, else ``XDG_CACHE_HOME`` or
``~/.cache``), so a read-only installation works. Where no folder can be written, kernels last as
long as the process.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.registry import cpu_target

from model.progress import Listener

# The folders of machine code, and the deletion of old ones.
#
# Every state of the kernels has its own folder. A process holds a shared lock in each folder it
# uses until it ends. Creating a folder deletes those that no process holds and none has started to
# use for two days. Folders named by the user (``NUMBA_CACHE_DIR``) are left alone.


UNUSED = 2 * 24 * 3600.0
"""How long a folder must be unused before it is deleted, [s]."""
_LOCK = "in-use"
_OURS = re.compile(r"[0-9a-f]{16}|removed-\w+")
"""Names of versions, and of folders whose removal was interrupted."""
_ATTEMPTS = 10


def use_folder(version: str) -> Path | None:
    """The folder of a version, locked until the process ends; None where none can be written."""
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
                delete_unused(folder.parent, time.time())
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # read-only, full, or no home: machine code is not cached
        return None


def delete_unused(parent: Path, now: float) -> None:
    """Deletes the folders of versions that no process holds and none used for `UNUSED`.

    Args:
        now: Seconds since the epoch.
    """
    for folder in parent.iterdir():
        try:
            if _OURS.fullmatch(folder.name) and now - folder.stat().st_mtime > UNUSED:
                _delete(folder)
        except OSError:  # another process was faster, or the folder is not ours
            continue


def _own_folder() -> Path:
    cache_home = os.environ.get("XDG_CACHE_HOME", "")
    parent = Path(cache_home) if os.path.isabs(cache_home) else Path.home() / ".cache"
    return parent / "cdpr" / "kernels"


def _hold(folder: Path) -> None:
    """Creates the folder, marks it as used now, and locks it as long as the process lives.

    Raises:
        OSError: It cannot be created or locked.
    """
    for _ in range(_ATTEMPTS):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        fcntl.flock(lock, fcntl.LOCK_SH)
        if _is_same(lock, folder / _LOCK):
            os.utime(folder)
            return  # the file stays open, and the lock with it
        os.close(lock)  # deleted in between
    raise OSError(f"{folder} is deleted repeatedly")


def _delete(folder: Path) -> None:
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


Function = TypeVar("Function", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "fastmath": False}


def compiled(
    function: Function, *called: Path, counts_arrays: bool = True, is_inlined: bool = False
) -> Function:
    """Compiles a pure function at its first call; exact IEEE arithmetic, no GIL.

    Args:
        called: Folders of the kernels that it calls, beside its own.
        counts_arrays: Whether it creates or keeps arrays, whose references are then counted.
        is_inlined: Whether it is inlined into its callers.
    """
    # All explicit, or they would come from the first caller.
    options = {**_OPTIONS, "_nrt": counts_arrays, "forceinline": is_inlined}
    folder = cache_folder(Path(function.__code__.co_filename).parent, *called)
    if folder is None:
        return cast(Function, numba.njit(**options)(function))
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(folder)  # read while the decorator runs, hence restored after it
    try:
        return cast(Function, numba.njit(cache=True, **options)(function))
    finally:
        config.CACHE_DIR = before


@cache
def cache_folder(sources: Path, *called: Path) -> Path | None:
    """The folder for the machine code of kernels in ``sources`` that call those in ``called``.

    None where none can be written.
    """
    return use_folder(_version(frozenset({sources, *called})))


@cache
def _version(folders: frozenset[Path]) -> str:
    """Name of this state of the kernels in ``folders``, for this Python and processor."""
    processor = cpu_target.target_context.codegen().magic_tuple()  # as Numba distinguishes them
    python = sys.implementation.cache_tag
    digest = hashlib.sha256(f"{numba.__version__} {python} {processor}".encode())
    digest.update(Path(__file__).read_bytes())
    for source in sorted(source for folder in folders for source in folder.glob("*.py")):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


# Whether the machine code of a task is in the user's cache, or must be compiled first.
#
# Numba finds machine code by the path of a kernel's file and its content, before 0.68 by its date
# and size instead, in a folder named as above. Another copy of the program compiles again; hence
# the stamp of a task is named after the path of every kernel's file, and before 0.68 date and size.


_FINDS_BY_DATE = numba.version_info.short < (0, 68)


@dataclass(frozen=True, slots=True)
class KernelSet:
    """The kernels of a task.

    Attributes:
        name: Of the task; once it has run, its code is cached.
        kernels: Folders of the kernels; the task's stamp is in their cache.
    """

    name: str
    kernels: tuple[Path, ...]


def can_be_cached(task: KernelSet) -> bool:
    """Whether there is a folder in which a task's code outlives the process."""
    return cache_folder(*task.kernels) is not None


def is_compiled(task: KernelSet) -> bool:
    """Whether a task has run before with exactly these files.

    False too where no folder can be written: then every process compiles for itself.
    """
    stamp = _stamp(task)
    return stamp is not None and stamp.exists()


def note_compiled(task: KernelSet) -> None:
    """Records that a task has run, where a folder can be written."""
    stamp = _stamp(task)
    if stamp is None:
        return
    try:
        stamp.touch()
    except OSError:  # read-only since it was created: the next process checks again
        return


@contextmanager
def compilation(task: KernelSet, what: str, duration: str, listener: Listener) -> Iterator[bool]:
    """Context for a task that compiles its code when it runs for the first time.

    Args:
        task: The task with its kernels.
        what: What is compiled, such as ``the planner``.
        duration: How long it takes, such as ``about ten seconds``.
        listener: Receives a remark when code is compiled.

    Yields:
        Whether the code was in the cache.
    """
    if is_compiled(task):
        yield True
        return
    if can_be_cached(task):
        listener.remark(f"compiling {what} for this machine (once, {duration}) …")
    else:
        listener.remark(
            f"compiling {what} ({duration}) on every start: no cache folder can be written;"
            " set NUMBA_CACHE_DIR to a writable folder"
        )
    with listener.waiting("compiling"):
        yield False
    note_compiled(task)


def _stamp(task: KernelSet) -> Path | None:
    folder = cache_folder(*task.kernels)
    if folder is None:
        return None
    digest = hashlib.sha256()
    for kernels in task.kernels:
        for source in sorted(kernels.glob("*.py")):
            state = source.stat()
            seen = (state.st_mtime_ns, state.st_size) if _FINDS_BY_DATE else ()
            digest.update(f"{source} {seen}\n".encode())
    return folder / f"compiled-{task.name}-{digest.hexdigest()[:16]}"
