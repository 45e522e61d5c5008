"""How kernels are compiled, and where the machine code is kept.

Numba recompiles a cached function when its own file changes, not when a function it calls does. So
the cache lies in a folder named after the content of all files beside the function, and of those in
the folders of kernels that it calls: any change begins a new one. The folder is the user's
(``NUMBA_CACHE_DIR``, else ``XDG_CACHE_HOME`` or ``~/.cache``), which lets a read-only installation
work. Where no folder can be written, kernels live as long as the process.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from cdpr.kernel_folders import use_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "fastmath": False}


def compiled(
    function: Function, *called: Path, counts_arrays: bool = True, is_inlined: bool = False
) -> Function:
    """Compiles a pure function when it is first called; exact IEEE arithmetic, no GIL.

    Args:
        function: What is compiled.
        called: Folders of the kernels that it calls, beside its own.
        counts_arrays: Whether it makes or keeps arrays, whose owners are then counted.
        is_inlined: Whether it becomes part of its callers.
    """
    # All said, or they come from whichever caller was first.
    options = {**_OPTIONS, "_nrt": counts_arrays, "forceinline": is_inlined}
    folder = cache_folder(Path(function.__code__.co_filename).parent, *called)
    if folder is None:
        return cast(Function, numba.njit(**options)(function))
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(folder)  # read while the decorator runs, hence put back after it
    try:
        return cast(Function, numba.njit(cache=True, **options)(function))
    finally:
        config.CACHE_DIR = before


@cache
def cache_folder(sources: Path, *called: Path) -> Path | None:
    """The folder of the machine code of kernels in ``sources`` that call those in ``called``.

    None where none can be written.
    """
    return use_folder(_version(frozenset({sources, *called})))


@cache
def _version(folders: frozenset[Path]) -> str:
    """Name of this state of the kernels in ``folders``, on this processor."""
    digest = hashlib.sha256(f"{numba.__version__} {platform.machine()}".encode())
    digest.update(Path(__file__).read_bytes())
    for source in sorted(source for folder in folders for source in folder.glob("*.py")):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:16]
