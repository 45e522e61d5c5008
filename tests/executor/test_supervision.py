"""Ctrl-C in a program that calls the library stops the motion, and is not lost."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable

import pytest

from executor.supervision import LocalRequests, Supervisor
from model.errors import StoppedByOperator

PATIENCE_S = 20.0


def until_stopped(board: LocalRequests, then: Callable[[], str]) -> Callable[[], str]:
    """A motion that continues until a stop is requested."""
    ended = threading.Event()

    def motion() -> str:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        while not board.read().stop:
            ended.wait(0.01)
        return then()

    return motion


def test_an_interrupt_asks_for_a_stop_and_the_result_is_kept() -> None:
    board, supervisor = LocalRequests(), Supervisor()
    assert supervisor.during(board, until_stopped(board, lambda: "held")) == "held"
    assert supervisor.interrupted
    with pytest.raises(KeyboardInterrupt):
        supervisor.finish()


def test_an_interrupt_before_there_is_a_result_stays_an_interrupt() -> None:
    board = LocalRequests()

    def stopped() -> str:
        raise StoppedByOperator("stopped before anything moved")

    with pytest.raises(KeyboardInterrupt):
        Supervisor().during(board, until_stopped(board, stopped))


def test_an_interrupt_does_not_end_the_writing_of_the_record() -> None:
    supervisor, went_on = Supervisor(), threading.Event()

    def record() -> str:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
        assert went_on.wait(PATIENCE_S)
        return "written"

    interrupt = supervisor._interrupt

    def interrupted(*arguments: object) -> None:
        interrupt(*arguments)  # type: ignore[arg-type]
        went_on.set()

    supervisor._interrupt = interrupted  # type: ignore[method-assign]
    assert supervisor.conclude(record) == "written"
    with pytest.raises(KeyboardInterrupt):
        supervisor.finish()


def test_an_error_of_the_motion_is_the_callers() -> None:
    board = LocalRequests()

    def fails() -> str:
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        Supervisor().during(board, fails)
    assert not board.read().stop


def test_a_motion_runs_from_any_thread() -> None:
    results: list[str] = []
    board, supervisor = LocalRequests(), Supervisor()
    caller = threading.Thread(
        target=lambda: results.append(supervisor.during(board, lambda: "moved"))
    )
    caller.start()
    caller.join(PATIENCE_S)
    assert results == ["moved"]
    supervisor.finish()
