"""The three ways in which the planner's kernels are compiled; they call those here.

Where the machine code is kept: `cdpr.compiled`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from cdpr.compiled import compiled

Function = TypeVar("Function", bound=Callable[..., Any])

_HERE = Path(__file__).parent


def kernel(function: Function) -> Function:
    """Compiles a pure function when it is first called; exact IEEE arithmetic, no GIL."""
    return compiled(function, _HERE)


def leaf(function: Function) -> Function:
    """As `kernel`, for a function that makes and keeps no arrays: it counts no owners of them.

    Compiled code counts the owners of each array of each tuple that a function is given or takes
    apart. For an edge that is refused after some ten comparisons this took four fifths of the time.
    A function that makes an array fails to compile as a leaf; it may be called by one.
    """
    return compiled(function, _HERE, counts_arrays=False)


def inlined(function: Function) -> Function:
    """As `leaf`, made part of its callers: a tuple of arrays is a hundred words to hand over."""
    return compiled(function, _HERE, counts_arrays=False, is_inlined=True)
