"""The three ways in which the planner's kernels are compiled; they call each other.

Where the machine code is kept: `model.jit`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal, TypeVar

from model.jit import KernelSet, compilation, compiled
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
