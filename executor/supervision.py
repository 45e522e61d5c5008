"""Operator requests during a motion, and the supervisor of a motion.

The loop reads the operator's requests every cycle.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from executor.state_machine import CycleRecord, LoopEvent
from model.errors import CdprError, Fault, StoppedByOperator
from model.progress import Advance, Listener


@dataclass(frozen=True, slots=True)
class StopReason:
    """Reason for a stop other than the operator's.

    Attributes:
        code: Of its event.
        text: A clause with values.
    """

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class OperatorRequests:
    """All requests at one time; each stays until it is changed.

    Attributes:
        stop: End the run along the path.
        for_what: Reason of a stop due to the camera measurements; None for the operator's.
        hold: Come to rest on the path and wait there.
        speed: Share of the planned speed along the path, from 0.01 to 1.
        lost: Why the run has lost its supervisor; empty while it has one.
    """

    stop: bool = False
    hold: bool = False
    speed: float = 1.0
    lost: str = ""
    for_what: StopReason | None = None


#: Slowest and fastest feed that may be requested, [% of the planned speed].
SLOWEST, FASTEST = 1, 100


class RequestBoard(Protocol):
    """Board of requests. A stop cannot be withdrawn."""

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """Requests the end of the run along the path.

        Args:
            for_what: Reason found by the cameras; None for the operator's stop.
        """

    def ask_hold(self, hold: bool) -> None:
        """Requests a feed hold, or its end."""

    def ask_speed(self, percent: int) -> None:
        """Requests a percentage of the planned speed, from `SLOWEST` to `FASTEST`."""

    def read(self) -> OperatorRequests:
        """Present requests."""


@dataclass(frozen=True, slots=True, eq=False)
class SupervisorCalls:
    """Calls of a loop to its supervisor.

    Attributes:
        requests: Returns the operator's requests, read every cycle.
        on_cycle: Takes every cycle; must return quickly.
        on_event: Takes every event.
    """

    requests: Callable[[], OperatorRequests]
    on_cycle: Callable[[CycleRecord], None]
    on_event: Callable[[LoopEvent], None]


class LocalRequests:
    """Board of a loop in this process; other threads may write to it at any time."""

    def __init__(self) -> None:
        # One attribute each: a signal that interrupts one request cannot undo another.
        self._stop, self._hold, self._speed = False, False, 1.0
        self._for_what: StopReason | None = None

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """See `RequestBoard`."""
        if not self._stop:
            self._for_what = for_what
        self._stop = True

    def ask_hold(self, hold: bool) -> None:
        """See `RequestBoard`."""
        self._hold = hold

    def ask_speed(self, percent: int) -> None:
        """See `RequestBoard`."""
        self._speed = percent / 100.0

    def read(self) -> OperatorRequests:
        """See `RequestBoard`."""
        return OperatorRequests(self._stop, self._hold, self._speed, for_what=self._for_what)


# Functions of the calling program that the motion calls.


class CallbackFailed(Fault):
    """A function of the calling program raised an exception."""


def record_failure(error: Exception) -> str:
    """What failed while a cycle or an event was taken, in a clause without advice."""
    if isinstance(error, CallbackFailed):
        return error.what
    return f"recording failed: {in_one_line(error)}"


def in_one_line(error: Exception) -> str:
    """Message of an error, without cause and advice."""
    return error.what if isinstance(error, CdprError) else f"{type(error).__name__}: {error}"


class Callbacks:
    """Functions of the calling program: what they raise stops the motion and is reported.

    They are called in the thread of the motion, which an exception would end without a stop.

    Attributes:
        error: The first exception, as a clause; empty for none.
        cause: That exception.
        leaving: `KeyboardInterrupt` or `SystemExit` of a function, to raise after the record.
    """

    def __init__(self, ask_stop: Callable[..., None]) -> None:
        """``ask_stop`` is `RequestBoard.ask_stop`."""
        self.error = ""
        self.cause: Exception | None = None
        self.leaving: BaseException | None = None
        self._ask_stop = ask_stop

    def guarded(self, name: str, function: Callable[..., object]) -> Callable[..., None]:
        """The function, which then raises nothing but `CallbackFailed`."""

        def call(*values: object) -> None:
            try:
                function(*values)
            except Exception as error:
                text = error.what if isinstance(error, CdprError) else str(error)
                what = f"{name} raised {type(error).__name__}: {text}".rstrip(": ")
                self.error, self.cause = self.error or what, self.cause or error
                raise CallbackFailed(what) from error
            except BaseException as error:
                self.leaving = self.leaving or error
                self._ask_stop()

        return call

    def attempt(self, name: str, function: Callable[[], object]) -> None:
        """Calls the function, and raises nothing: a failure stops a motion."""
        try:
            self.guarded(name, function)()
        except CallbackFailed as error:
            self._ask_stop(StopReason("recorder", error.what))

    def leave(self) -> None:
        """Raises what ended the program in a function."""
        if self.leaving is not None:
            raise self.leaving


class GuardedListener(Listener):
    """The caller's listener during a run; what it raises loses no measurement and no file."""

    def __init__(self, listener: Listener, callbacks: Callbacks) -> None:
        """Reports to ``listener``; its exceptions go to ``callbacks``."""
        self._listener, self._attempt = listener, callbacks.attempt

    def note(self, text: str) -> None:
        """See `Listener`."""
        self._attempt("listener.note", lambda: self._listener.note(text))

    def remark(self, text: str) -> None:
        """See `Listener`."""
        self._attempt("listener.remark", lambda: self._listener.remark(text))

    def warning(self, text: str) -> None:
        """See `Listener`."""
        self._attempt("listener.warning", lambda: self._listener.warning(text))

    @contextmanager
    def waiting(self, text: str) -> Iterator[None]:
        """See `Listener`."""
        shown, attempt = ExitStack(), partial(self._attempt, "listener.waiting")
        attempt(lambda: shown.enter_context(self._listener.waiting(text)))
        try:
            yield
        finally:
            attempt(shown.close)

    @contextmanager
    def progress(self, text: str, total: float | None) -> Iterator[Advance]:
        """See `Listener`; its beginning raises, as nothing moves yet."""
        shown, attempt = ExitStack(), partial(self._attempt, "listener.progress")
        advance = shown.enter_context(self._listener.progress(text, total))

        def show(value: float, note: str = "", text: str = "") -> None:
            attempt(lambda: advance(value, note, text))

        try:
            yield show
        finally:
            attempt(shown.close)


# Supervisor of a motion, for the calling program.


_T = TypeVar("_T")
#: Packages with handlers that note Ctrl-C for an event loop, which a motion in its thread blocks.
_EVENT_LOOPS = frozenset({"asyncio", "ipykernel", "uvicorn", "uvloop"})


@contextmanager
def ctrl_c_interrupts() -> Iterator[None]:
    """Replaces the handler of an event loop, so that Ctrl-C raises `KeyboardInterrupt`.

    In a coroutine, Ctrl-C would otherwise have no effect before the next ``await``, so that the
    platform would still move to the goal. One that the program set with `signal.signal` stays.
    """
    former = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()  # others may set no handler
    if former is None or not (is_main and _belongs_to_event_loop(former)):
        yield
        return

    def restore() -> None:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, former)

    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        yield
    finally:
        try:
            restore()
        finally:
            restore()  # again, as Ctrl-C may have interrupted it


def _belongs_to_event_loop(handler: object) -> bool:
    while isinstance(handler, partial):
        handler = handler.func
    owner = type(getattr(handler, "__self__", None))
    module = getattr(handler, "__module__", None) or owner.__module__  # None: compiled
    return str(module).partition(".")[0] in _EVENT_LOOPS


#: Signals of which the handlers may raise one right after the other, as where all were pending.
_AT_ONCE = 8


class Supervisor:
    """Turns an interrupt of the calling program into a coordinated stop.

    This one sets no handler, so that the library works from any thread: the motion runs in its
    own thread, and what a signal handler raises in the calling thread, such as
    `KeyboardInterrupt`, requests the stop. The first is raised again once the drives hold and the
    record is written. A program that handles signals itself, as the command line does, overrides
    the methods.
    """

    def __init__(self) -> None:
        """Not interrupted."""
        self.interruption: BaseException | None = None
        """The first exception of a signal handler since the motion began."""
        self.began: float | None = None
        """Start of the program whose only task is the motion, [s] of `CLOCK_BOOTTIME`, if it is
        one: a stop requested since then applies."""

    def on_early_stop(self) -> None:
        """Called by another thread when a stop is requested while the motion is prepared.

        Without an interruption the preparation ends at its next step.
        """

    def during(
        self,
        board: RequestBoard,
        motion: Callable[[], _T],
        conclude: Callable[[], object] = lambda: None,
    ) -> _T:
        """Runs a motion, from the opening of its devices to the last image, and concludes it.

        Args:
            board: Takes requests to stop.
            motion: Called once.
            conclude: Called after the motion: computes its verdict, and writes its record.

        Raises:
            BaseException: What a signal handler raised; stopped before there was a result.
        """

        def whole() -> _T:
            result = motion()
            conclude()
            return result

        self.interruption = None
        work = _Work("cdpr-motion", whole)
        self._outlast(work, board.ask_stop, _AT_ONCE)
        if not work.was_called and self.interruption is not None:
            raise self.interruption
        work.join()
        try:
            result: _T = work.result()
        except StoppedByOperator as error:
            if self.interruption is not None:
                raise self.interruption from error
            raise
        return result

    def _outlast(self, work: _Work, ask_stop: Callable[[], None], layers: int) -> None:
        """Starts the work and waits for its end, whatever signal handlers raise meanwhile.

        Python may call handlers at every call and jump, also of this loop; an outer layer takes
        what one raises there.
        """
        while not work.is_over:
            try:
                if layers:
                    self._outlast(work, ask_stop, layers - 1)
                    continue
                if self.interruption is None:
                    work.start()
                else:
                    ask_stop()
                    work.cancel()
                work.wait()
            except BaseException as error:  # no call and no jump here
                if self.interruption is None:
                    self.interruption = error

    def on_motion(self) -> None:
        """Called when armed: the platform is about to move."""

    def on_verdict(self, result: Any) -> None:
        """Called with the verdict of a run, before its result files are written.

        Args:
            result: `executor.runner.RunResult`.
        """

    def leaves_files_out(self) -> bool:
        """Whether the operator chose not to wait for the result files."""
        return False

    def finish(self) -> None:
        """Called at the end.

        Raises:
            BaseException: The first that a signal handler raised since the motion began.
        """
        if self.interruption is not None:
            raise self.interruption


class _Work(threading.Thread):
    """A function in a thread, with its result or error.

    Attributes:
        was_called: The function was called.
        is_over: It has ended, or will never be called.
    """

    def __init__(self, name: str, function: Callable[[], Any]) -> None:
        super().__init__(name=name)
        self._function = function
        self._result: Any = None
        self._error: BaseException | None = None
        self._has_begun = self._is_cancelled = False
        self.was_called = self.is_over = False
        # Compiled, unlike `Event`, in which a second exception may replace the first.
        # An interrupted `join` may regard the thread as ended (Python 3.11).
        self._end = threading.Lock()
        self._end.acquire()

    def run(self) -> None:
        self._has_begun = True
        try:
            if not self._is_cancelled:
                self.was_called = True
                self._result = self._function()
        except BaseException as error:
            self._error = error
        finally:
            self.is_over = True
            self._end.release()

    def cancel(self) -> None:
        """Prevents the call of the function, unless the thread has begun."""
        self._is_cancelled = True  # before it looks; the thread does both in reverse
        if not self._has_begun:
            self.is_over = True

    def wait(self) -> None:
        """Waits until it is over."""
        if not self.is_over:
            self._end.acquire()

    def result(self) -> Any:
        if self._error is not None:
            raise self._error
        return self._result
