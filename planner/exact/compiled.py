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
    folder = cache_folder(Path(function.__code__.co_filename).parent)
    if folder is None:
        return cast(Function, numba.njit(**_OPTIONS)(function))
    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = str(folder)  # read while the decorator runs, hence put back after it
    try:
        return cast(Function, numba.njit(cache=True, **_OPTIONS)(function))
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
