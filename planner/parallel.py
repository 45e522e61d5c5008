"""Work spread over all cores or a Dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import current_process, parent_process
from typing import TYPE_CHECKING, Any

from model.errors import Fault, require_child_processes

if TYPE_CHECKING:
    from concurrent.futures import Executor


class Count:
    """Sums finished work for a progress bar."""

    def __init__(self, advance: Callable[[float], None]) -> None:
        """Reports sums to ``advance``."""
        self._advance = advance
        self._done = 0

    def more(self, done: int) -> None:
        """Adds newly finished work."""
        self._done += done
        self._advance(self._done)


def default_workers() -> int:
    """Processes of a calculation: one per core, but one in a child, whose siblings use the rest."""
    return os.cpu_count() or 1 if parent_process() is None or _is_importing() else 1


@contextmanager
def worker_pool(workers: int, dask: str | None) -> Iterator[Executor | None]:
    """Executor of a Dask cluster or of local processes; None for this process alone.

    Args:
        workers: Number of processes; with 1 there is no pool.
        dask: Address of a scheduler, instead of processes.

    Raises:
        BadInput: Dask is not installed, no scheduler answers, or this process cannot start others.
        Fault: The processes ended, as in a script without the guard of `multiprocessing`.
    """
    if dask is not None:
        with _dask_client(dask) as client:
            yield client.get_executor()
        return
    if workers == 1:
        yield None
        return
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    if _is_importing():
        raise _without_guard()
    require_child_processes("`workers`", ", or pass workers=1")
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin_worker)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise _without_guard() from error
    finally:
        pool.shutdown(cancel_futures=True)


def _is_importing() -> bool:
    """Whether this process still imports the script of the one that started it."""
    return bool(getattr(current_process(), "_inheriting", False))


def _without_guard() -> Fault:
    return Fault(
        "the processes that share the work ended at once",
        why="they import the script that started them, and it starts them again; or the computer"
        " has too little memory",
        next_step='put the script\'s calls below `if __name__ == "__main__":`, or pass workers=1',
    )


def _begin_worker() -> None:
    """Ignores Ctrl-C, which the parent handles, and ends the worker however its parent ends."""
    import signal
    from threading import Thread

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    from multiprocessing.connection import wait

    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _dask_client(address: str) -> Any:
    from importlib import import_module

    from model.errors import BadInput

    try:
        client = import_module("distributed").Client
    except ImportError as error:
        raise BadInput(
            "Dask is not installed",
            next_step="pip install 'cdpr[dask]' (in a source checkout as docs/workspace.md says),"
            " or leave out --dask",
        ) from error
    try:
        return client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise BadInput(
            "no Dask scheduler answers at this address",
            where=address,
            why=str(error) or type(error).__name__,
            next_step="start one (dask scheduler), or leave out --dask",
        ) from error
