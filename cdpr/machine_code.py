"""Whether the machine code that a task needs waits in the user's cache, or must be compiled first.

Numba finds machine code by the path and the date of a kernel's file, in a folder that is named
after the content of all kernels. So another copy of the program, or a file that was only touched,
compiles anew; hence the stamp of a task is named after path, date and size of every kernel's file.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from cdpr.compiled import cache_folder


@dataclass(frozen=True, slots=True)
class Task:
    """What runs kernels.

    Attributes:
        name: Of what was done once when its code is there.
        kernels: Folders of the kernels; the code's stamp lies in the first one's cache.
    """

    name: str
    kernels: tuple[Path, ...]


def can_be_kept(task: Task) -> bool:
    """Whether there is a folder in which a task's code outlives the process."""
    return cache_folder(task.kernels[0]) is not None


def is_compiled(task: Task) -> bool:
    """Whether a task was done before with the very files that lie here.

    False too where no folder can be written: then every process compiles for itself.
    """
    stamp = _stamp(task)
    return stamp is not None and stamp.exists()


def note_compiled(task: Task) -> None:
    """Notes that a task was done, where that can be noted."""
    stamp = _stamp(task)
    if stamp is None:
        return
    try:
        stamp.touch()
    except OSError:  # read-only since it was made: the next process looks again
        return


def _stamp(task: Task) -> Path | None:
    folder = cache_folder(task.kernels[0])
    if folder is None:
        return None
    digest = hashlib.sha256()
    for kernels in task.kernels:
        for source in sorted(kernels.glob("*.py")):
            state = source.stat()
            digest.update(f"{source} {state.st_mtime_ns} {state.st_size}\n".encode())
    return folder / f"compiled-{task.name}-{digest.hexdigest()[:16]}"
