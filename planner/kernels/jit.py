"""The planner's three decorators for compiled functions, and arrays cached beside the machine code.

The kernels call each other; `model.jit` stores their machine code. Its folder is named after the
content of the kernels, so changing a kernel also invalidates the cached arrays. Where no folder can
be written, arrays are recomputed.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.files.documents import content_hash, write_bytes_atomic
from model.jit import KernelSet, cache_folder, compilation, compiled
from model.progress import Listener

Function = TypeVar("Function", bound=Callable[..., Any])

_PLANNER = Path(__file__).parents[1]
KERNELS = tuple(
    _PLANNER / name for name in ("kernels", "collision", "wrench", "anytime", "anytime_6d", "rrt")
)
"""All kernel folders of the planner, whose kernels call each other."""


def planner_compilation(
    work: Literal["optimal", "turning", "paper", "maps"], listener: Listener
) -> AbstractContextManager[bool]:
    """Context for compiling one of the three searches, or the maps; see `compilation`."""
    return compilation(KernelSet(work, KERNELS), "the planner", "one to three minutes", listener)


def kernel(function: Function) -> Function:
    """Compiles a pure function at its first call; exact IEEE arithmetic, no GIL."""
    return compiled(function, *KERNELS)


def leaf(function: Function) -> Function:
    """As `kernel`, without reference counts; for functions that neither create nor keep arrays.

    Compiled code counts references to every array in every tuple that a function receives or
    unpacks. For an edge refused after some ten comparisons this took four fifths of the time. A
    function that creates an array does not compile as a leaf, but a leaf may call one.
    """
    return compiled(function, *KERNELS, counts_arrays=False)


def inlined(function: Function) -> Function:
    """As `leaf`, inlined into its callers: passing a tuple of arrays copies a hundred words."""
    return compiled(function, *KERNELS, counts_arrays=False, is_inlined=True)


# Arrays that depend only on rig and load, cached beside the kernels that compute them.


Kind = TypeVar("Kind", bound=np.generic)

_MOST_FILES = 200
"""Most files of one name; the oldest are deleted."""


def stored(
    name: str, key: Sequence[Any], shape: tuple[int, ...], compute: Callable[[], NDArray[Kind]]
) -> NDArray[Kind]:
    """An array from the user's cache, or computed and stored there.

    Args:
        name: Beginning of the file's name.
        key: Every value that `compute` uses: arrays, or JSON-like.
        shape: Required shape; another one is recomputed.
    """
    folder = cache_folder(*KERNELS)
    if folder is None:
        return compute()
    parts = [part.tolist() if isinstance(part, np.ndarray) else part for part in key]
    path = folder / f"{name}-{content_hash(parts).removeprefix('sha256:')[:24]}.npy"
    try:
        found = np.load(path, allow_pickle=False)
        if found.shape == shape:
            return found  # type: ignore[no-any-return]
    except (OSError, ValueError, EOFError):  # missing or truncated: recomputed below
        pass
    made = compute()
    content = io.BytesIO()
    np.save(content, made)
    with suppress(BadInput):  # the folder cannot be written
        write_bytes_atomic(path, content.getvalue())
    _forget_oldest(folder, name)
    return made


def _forget_oldest(folder: Path, name: str) -> None:
    try:
        files = sorted(folder.glob(f"{name}-*.npy"), key=lambda file: file.stat().st_mtime)
        for file in files[:-_MOST_FILES]:
            file.unlink()
    except OSError:  # another process was faster, or the file is not ours
        return
