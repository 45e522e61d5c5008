"""Telling that machine code is made, which takes a while and happens once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from cdpr.machine_code import Task

Work = Literal["optimal", "turning", "paper", "maps", "edges"]
"""A plan of one of three searches, a map, or the edges of tags in a picture."""


@contextmanager
def told_when_compiling(work: Work, shown: bool) -> Iterator[bool]:
    """Around what compiles the code of some work when it is done for the first time.

    Args:
        work: Which.
        shown: Whether a spinner may turn meanwhile.

    Yields:
        Whether the code was there.
    """
    from cdpr.cli.output import err, spinner
    from cdpr.machine_code import can_be_kept, is_compiled, note_compiled

    task = _task(work)
    compiled = is_compiled(task)
    if compiled:
        yield True
    else:
        what, duration = "the planner", "one to three minutes"
        if work == "edges":
            what, duration = "the tags' edge finder", "up to a minute"
        if can_be_kept(task):
            err.print(f"compiling {what} for this machine, once; {duration} …")
        else:
            err.print(
                f"compiling {what}, {duration}, and every time anew: no folder for it can be"
                " written; name one by the variable NUMBA_CACHE_DIR",
                soft_wrap=True,
            )
        with spinner("compiling", shown):
            yield False
        note_compiled(task)


def ready_to_measure(shown: bool) -> None:
    """Loads what finds tags' edges in pictures, so that no picture waits for it."""
    from tracking.edges import load_kernels

    with told_when_compiling("edges", shown):
        load_kernels()


def ready_for_processes(shown: bool) -> None:
    """Compiles what finds tags' edges once, for processes that then only load it."""
    from cdpr.machine_code import is_compiled

    if not is_compiled(_task("edges")):
        ready_to_measure(shown)


def _task(work: Work) -> Task:
    from cdpr.machine_code import Task

    if work == "edges":
        import tracking

        return Task(work, (Path(tracking.__path__[0]) / "edge_kernels",))
    import planner

    here = Path(planner.__path__[0])
    return Task(work, tuple(here / name for name in ("exact", "optimal", "paper", "turning")))
