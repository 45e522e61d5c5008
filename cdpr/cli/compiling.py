"""Telling that machine code is made, which takes minutes and happens once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from planner.machine_code import Task


@contextmanager
def told_when_compiling(task: Task, shown: bool) -> Iterator[bool]:
    """Around what compiles a task's code when it is done for the first time.

    Args:
        task: Which.
        shown: Whether a spinner may turn meanwhile.

    Yields:
        Whether the code was there.
    """
    from cdpr.cli.output import err, spinner
    from planner.machine_code import is_compiled, note_compiled

    compiled = is_compiled(task)
    if compiled:
        yield True
    else:
        err.print("compiling the planner for this machine, once; one to three minutes …")
        with spinner("compiling", shown):
            yield False
        note_compiled(task)
