"""What a signal raises in a program that calls the library stops the motion, and is not lost."""

from __future__ import annotations

import asyncio
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

from executor.supervision import LocalRequests, Supervisor, _Work, ctrl_c_interrupts
from model.errors import StoppedByOperator

PATIENCE_S = 20.0
#: What handlers of a program raise, by signal: those of Ctrl-C, a service, pytest-timeout.
RAISED: dict[signal.Signals, BaseException] = {
    signal.SIGINT: KeyboardInterrupt(),
    signal.SIGTERM: SystemExit(3),
    signal.SIGALRM: TimeoutError("too long"),
    signal.SIGHUP: GeneratorExit(),
    signal.SIGUSR1: StoppedByOperator("by a handler"),
}


@pytest.fixture
def raising() -> Iterator[None]:
    """Handlers of a program that raise."""

    def raise_it(number: int, _frame: object) -> None:
        raise RAISED[signal.Signals(number)].with_traceback(None)

    before = {number: signal.signal(number, raise_it) for number in RAISED}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def interrupt(*numbers: signal.Signals) -> None:
    for number in numbers:
        signal.pthread_kill(threading.main_thread().ident or 0, number)


def until_stopped(board: LocalRequests, then: Callable[[], str]) -> Callable[[], str]:
    """A motion that continues until a stop is requested."""
    ended = threading.Event()

    def motion() -> str:
        for _ in range(round(1000 * PATIENCE_S)):
            if board.read().stop:
                return then()
            ended.wait(0.001)
        raise AssertionError("no stop was requested")

    return motion


def interrupted(board: LocalRequests, *numbers: signal.Signals) -> Callable[[], str]:
    """Such a motion, during which signals arrive at once."""
    stopped = until_stopped(board, lambda: "held")

    def motion() -> str:
        interrupt(*numbers)
        return stopped()

    return motion


@pytest.mark.parametrize("number", list(RAISED))
def test_an_interrupt_asks_for_a_stop_and_the_result_is_kept(
    raising: None, number: signal.Signals
) -> None:
    board, supervisor = LocalRequests(), Supervisor()
    assert supervisor.during(board, interrupted(board, number)) == "held"
    with pytest.raises(type(RAISED[number])) as caught:
        supervisor.finish()
    assert caught.value is RAISED[number]


@pytest.mark.parametrize("number", list(RAISED))
def test_an_interrupt_before_there_is_a_result_stays_an_interrupt(
    raising: None, number: signal.Signals
) -> None:
    board = LocalRequests()

    def stopped() -> str:
        interrupt(number)
        until_stopped(board, str)()
        raise StoppedByOperator("stopped before anything moved")

    with pytest.raises(type(RAISED[number])) as caught:
        Supervisor().during(board, stopped)
    assert caught.value is RAISED[number]


def test_signals_that_follow_each_other_do_not_end_the_wait(raising: None) -> None:
    """Each is at first pending, so that its handler raises where the one before is caught."""
    for first in RAISED:
        board, supervisor = LocalRequests(), Supervisor()
        others = [number for number in RAISED if number is not first]
        moves, taken = interrupted(board, first), threading.Event()

        def conclude(taken: threading.Event = taken, others: Any = others) -> None:
            for _ in range(20):
                interrupt(*others)
                taken.wait(0.0005)

        assert supervisor.during(board, moves, conclude) == "held"
        assert supervisor.interruption is RAISED[first]
        board = LocalRequests()
        assert supervisor.during(board, interrupted(board, first, *others)) == "held"
        assert supervisor.interruption in RAISED.values()


def test_an_interrupt_does_not_end_the_writing_of_the_record() -> None:
    board, supervisor, written = LocalRequests(), Supervisor(), []

    def record() -> None:
        interrupt(signal.SIGINT)
        written.append(until_stopped(board, lambda: "written")())

    assert supervisor.during(board, lambda: "held", record) == "held"
    assert written == ["written"]
    with pytest.raises(KeyboardInterrupt):
        supervisor.finish()


class Injected:
    """Raises at one step of the supervisor's code in this thread, of each instruction of it."""

    def __init__(self, at: int) -> None:
        self.at, self.steps = at, 0

    def __call__(self, frame: Any, event: str, _argument: object) -> Any:
        if frame.f_globals.get("__name__") != Supervisor.__module__:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            self.steps += 1
            if self.steps == self.at:
                raise TimeoutError("injected")
        return self


def test_an_exception_at_any_instruction_leaves_no_motion_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It requests a stop, prevents the motion, or comes after its end."""
    wait, tracer, waited = _Work.wait, sys.gettrace(), []

    def noted(work: _Work) -> None:
        waited.append(trace.steps)
        wait(work)

    monkeypatch.setattr(_Work, "wait", noted)
    at, last = 0, 10**6
    while at <= last:
        trace, board, supervisor, moving = Injected(at), LocalRequests(), Supervisor(), [False]

        def motion(board: LocalRequests = board, moving: list[bool] = moving, at: int = at) -> str:
            moving[0] = True
            if 0 < at <= waited[0]:
                until_stopped(board, str)()
            moving[0] = False
            return "held"

        try:
            sys.settrace(trace)
            supervisor.during(board, motion)
        except TimeoutError:
            pass
        finally:
            sys.settrace(tracer)
        assert not moving[0], f"at step {at} of {last}"
        last = trace.steps if at == 0 else last
        at += 1
    assert last > waited[0] > 100


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
