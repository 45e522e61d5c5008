"""Ctrl-C in a program that calls the library stops the motion, and is not lost."""

from __future__ import annotations

import asyncio
import signal
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from executor.supervision import LocalRequests, Supervisor, ctrl_c_interrupts
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


# Programs with an event loop, which the call keeps from running.


def handler() -> Any:
    return signal.getsignal(signal.SIGINT)


def own(*_: object) -> None:
    """Of a program."""


def of_a_server(*_: object) -> None:
    """Only notes that the server should end."""


of_a_server.__module__ = "uvicorn.server"
#: Compiled methods of objects state no module of their own.
compiled = type("Loop", (list,), {"__module__": "uvloop.loop"})().append


@pytest.fixture
def as_before() -> Iterator[None]:
    before = handler()
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_in_a_coroutine_interrupts_it() -> None:
    async def main() -> None:
        before = handler()
        with pytest.raises(KeyboardInterrupt), ctrl_c_interrupts():
            signal.raise_signal(signal.SIGINT)
        assert handler() is before is not signal.default_int_handler
        with ctrl_c_interrupts():
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(main())


def test_ctrl_c_interrupts_a_coroutine_of_a_program_that_waits_for_it(as_before: None) -> None:
    async def main() -> None:
        asyncio.get_running_loop().add_signal_handler(signal.SIGINT, own)
        with pytest.raises(KeyboardInterrupt), ctrl_c_interrupts():
            signal.raise_signal(signal.SIGINT)
        assert asyncio.get_running_loop().remove_signal_handler(signal.SIGINT)

    asyncio.run(main())


@pytest.mark.parametrize("former", [of_a_server, partial(partial(of_a_server), 1), compiled])
def test_a_handler_of_an_event_loop_gives_way(as_before: None, former: Any) -> None:
    signal.signal(signal.SIGINT, former)
    with ctrl_c_interrupts():
        assert handler() is signal.default_int_handler
        with ctrl_c_interrupts():  # such as `cdpr.home` called by a `confirm`
            assert handler() is signal.default_int_handler
        assert handler() is signal.default_int_handler
    assert handler() is former


@pytest.mark.parametrize(
    "former",
    [own, partial(own, 1), [].append, signal.SIG_IGN, signal.SIG_DFL, signal.default_int_handler],
)
def test_a_handler_of_the_program_stays(as_before: None, former: Any) -> None:
    signal.signal(signal.SIGINT, former)
    with ctrl_c_interrupts():
        assert handler() == former
    assert handler() == former


def test_a_handler_that_no_python_code_set_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """It could not be restored."""
    monkeypatch.setattr(signal, "getsignal", lambda _number: None)
    monkeypatch.setattr(signal, "signal", None)
    with ctrl_c_interrupts():
        pass


def test_a_handler_that_the_program_sets_meanwhile_stays(as_before: None) -> None:
    signal.signal(signal.SIGINT, of_a_server)
    with ctrl_c_interrupts():
        signal.signal(signal.SIGINT, own)
    assert handler() is own


@pytest.mark.parametrize("raised", [KeyboardInterrupt, ValueError])
def test_the_handler_is_restored_whatever_ends_the_call(
    as_before: None, raised: type[BaseException]
) -> None:
    signal.signal(signal.SIGINT, of_a_server)
    with pytest.raises(raised), ctrl_c_interrupts():
        raise raised
    assert handler() is of_a_server


def test_the_handler_is_restored_where_ctrl_c_interrupts_that(
    as_before: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    signal.signal(signal.SIGINT, of_a_server)
    change, pressed = signal.signal, []

    def interrupted(number: int, to: Any) -> None:
        if to is of_a_server and not pressed:
            pressed.append(number)
            raise KeyboardInterrupt
        change(number, to)

    with monkeypatch.context() as patched:
        patched.setattr(signal, "signal", interrupted)
        with pytest.raises(KeyboardInterrupt), ctrl_c_interrupts():
            pass
    assert (pressed, handler()) == ([signal.SIGINT], of_a_server)


def test_another_thread_leaves_the_handler_alone() -> None:
    def there() -> Any:
        with ctrl_c_interrupts():
            return handler()

    async def main() -> None:
        assert await asyncio.to_thread(there) is handler() is not signal.default_int_handler

    asyncio.run(main())
