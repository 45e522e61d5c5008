"""How kernels are compiled, and where the machine code is kept.

Numba recompiles a cached function when its own file changes, not when a function it calls does. So
the cache lies in a folder named after the content of all kernels here and beside the function: any
change begins a new one. The folder is the user's (``NUMBA_CACHE_DIR``, else ``XDG_CACHE_HOME`` or
``~/.cache``), which lets a read-only installation work. Where no folder can be written, kernels
live as long as the process.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

from planner.exact.cache import use_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "fastmath": False}


def kernel(function: Function) -> Function:
    """Compiles a pure function when it is first called; exact IEEE arithmetic, no GIL."""
    return _compiled(function, _nrt=True, forceinline=False)


def leaf(function: Function) -> Function:
    """As `kernel`, for a function that makes and keeps no arrays: it counts no owners of them.

    Compiled code counts the owners of each array of each tuple that a function is given or takes
    apart. For an edge that is refused after some ten comparisons this took four fifths of the time.
    A function that makes an array fails to compile as a leaf; it may be called by one.
    """
    return _compiled(function, _nrt=False, forceinline=False)


def inlined(function: Function) -> Function:
    """As `leaf`, made part of its callers: a tuple of arrays is a hundred words to hand over."""
    return _compiled(function, _nrt=False, forceinline=True)


def _compiled(function: Function, **special: bool) -> Function:
    options = {**_OPTIONS, **special}  # all said, or they come from whichever caller was first
    folder = cache_folder(Path(function.__code__.co_filename).parent)
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
def cache_folder(sources: Path) -> Path | None:
    """The folder of the machine code of kernels in ``sources``; None where none can be written."""
    return use_folder(_version(sources))


@cache
def _version(sources: Path) -> str:
    """Name of this state of the kernels in ``sources``, and of those here, on this processor."""
    digest = hashlib.sha256(f"{numba.__version__} {platform.machine()}".encode())
    here = Path(__file__).parent
    for source in sorted({*here.glob("*.py"), *sources.glob("*.py")}):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:16]
