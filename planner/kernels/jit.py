"""The three ways in which the planner's kernels are compiled, and arrays kept beside their code.

The kernels call each other. Where the machine code is kept: `model.jit`. The folder is named after
the content of the kernels, so a change of theirs forgets the arrays that they made. Where no folder
can be written, arrays are recomputed.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from model.files.documents import content_hash
from model.jit import KernelSet, cache_folder, compilation, compiled
from model.progress import Listener

Function = TypeVar("Function", bound=Callable[..., Any])

_PLANNER = Path(__file__).parents[1]
KERNELS = tuple(
    _PLANNER / name for name in ("kernels", "collision", "wrench", "anytime", "anytime_6d", "rrt")
)
"""Every folder of kernels of the planner: they call each other."""


def planner_compilation(
    work: Literal["optimal", "turning", "paper", "maps"], listener: Listener
) -> AbstractContextManager[bool]:
    """Around what compiles the planner for one of three searches, or a map, see `compilation`."""
    return compilation(KernelSet(work, KERNELS), "the planner", "one to three minutes", listener)


def kernel(function: Function) -> Function:
    """Compiles a pure function when it is first called; exact IEEE arithmetic, no GIL."""
    return compiled(function, *KERNELS)


def leaf(function: Function) -> Function:
    """As `kernel`, for a function that makes and keeps no arrays: it counts no owners of them.

    Compiled code counts the owners of each array of each tuple that a function is given or takes
    apart. For an edge that is refused after some ten comparisons this took four fifths of the time.
    A function that makes an array fails to compile as a leaf; it may be called by one.
    """
    return compiled(function, *KERNELS, counts_arrays=False)


def inlined(function: Function) -> Function:
    """As `leaf`, made part of its callers: a tuple of arrays is a hundred words to hand over."""
    return compiled(function, *KERNELS, counts_arrays=False, is_inlined=True)


# Arrays that depend on rig and load alone, kept between runs beside the kernels that made them.


Kind = TypeVar("Kind", bound=np.generic)

_MOST_FILES = 200
"""Kept of one name; the oldest go."""


def stored(
    name: str, key: Any, shape: tuple[int, ...], compute: Callable[[], NDArray[Kind]]
) -> NDArray[Kind]:
    """An array from the user's cache, or computed and kept there.

    Args:
        name: What it is, for its file.
        key: Everything it depends on, JSON-like.
        shape: That it must have to be believed.
        compute: Makes it.
    """
    folder = cache_folder(*KERNELS)
    if folder is None:
        return compute()
    path = folder / f"{name}-{content_hash(key).removeprefix('sha256:')[:24]}.npy"
    try:
        found = np.load(path, allow_pickle=False)
        if found.shape == shape:
            return found  # type: ignore[no-any-return]
    except (OSError, ValueError, EOFError):  # not there yet, or cut off: recomputed below
        pass
    made = compute()
    _keep(path, made)
    _forget_oldest(folder, name)
    return made


def _forget_oldest(folder: Path, name: str) -> None:
    try:
        files = sorted(folder.glob(f"{name}-*.npy"), key=lambda file: file.stat().st_mtime)
        for file in files[:-_MOST_FILES]:
            file.unlink()
    except OSError:  # another process was faster, or it is not ours to remove
        return


def _keep(path: Path, array: NDArray[Any]) -> None:
    """Writes a file whole or not at all; a cache that cannot be written is left as it is."""
    temporary = ""
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            temporary = file.name
            np.save(file, array)
        os.replace(temporary, path)
    except OSError:
        if temporary:
            Path(temporary).unlink(missing_ok=True)
