"""What links a motion to its operator: a question before, and requests while it moves.

The loop asks every cycle what the operator wants.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from model.errors import StoppedByOperator


@dataclass(frozen=True, slots=True)
class StopReason:
    """Why a run is to end without an operator's stop.

    Attributes:
        code: Of the event that reports it.
        text: A clause, with numbers.
    """

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class OperatorRequests:
    """All of it at one moment; each stays until it is changed.

    Attributes:
        stop: End the run along the path.
        for_what: The stop is wished for this, which the cameras saw, and with which code; None when
            the operator wishes it.
        hold: Come to rest on the path and wait there.
        speed: Share of the planned speed along the path, from 0.01 to 1.
        lost: Why the run has lost its supervisor; empty while it has one.
    """

    stop: bool = False
    hold: bool = False
    speed: float = 1.0
    lost: str = ""
    for_what: StopReason | None = None


#: Slowest and fastest feed that may be asked for, [% of the planned speed].
SLOWEST, FASTEST = 1, 100


class RequestBoard(Protocol):
    """Where wishes are put up. A stop cannot be taken back."""

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """The run is to end along the path.

        Args:
            for_what: What the cameras saw; None when the operator wishes it.
        """

    def ask_hold(self, hold: bool) -> None:
        """The run is to wait on the path, or to go on."""

    def ask_speed(self, percent: int) -> None:
        """The run is to go at a share of the planned speed, from `SLOWEST` to `FASTEST`."""

    def read(self) -> OperatorRequests:
        """What is wished now."""


class LocalRequests:
    """The board of a loop that runs in this process; others may write to it at any time."""

    def __init__(self) -> None:
        """Nothing is wished yet."""
        # One attribute each: a signal that interrupts one wish cannot undo another.
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


# What links a motion to the program that asks for it: a question before, stops while it moves.


_T = TypeVar("_T")


class Supervisor:
    """Turns an interrupt of the calling program into a coordinated stop.

    This one takes no signals, so that the library works from any thread: the motion runs in a
    thread of its own, and a `KeyboardInterrupt` in the calling thread asks for the stop. It is
    raised again once the drives hold and the record is written. A program that handles signals
    itself, as the command line does, overrides the methods.
    """

    def __init__(self) -> None:
        """Nothing was interrupted."""
        self.interrupted = False

    def during(self, board: RequestBoard, motion: Callable[[], _T]) -> _T:
        """Runs a motion, from the opening of its devices to the last image.

        Args:
            board: Takes requests to stop.
            motion: Called once.

        Raises:
            KeyboardInterrupt: It was interrupted, and stopped before there was a result.
        """
        thread = _Motion(motion)
        try:
            thread.start()
        except KeyboardInterrupt:
            if thread.cancel():
                raise
            self._interrupt(board)
        # An interrupted `join` may take the thread for ended (Python 3.11); the event does not.
        while not thread.is_done.is_set():
            try:
                thread.is_done.wait()
            except KeyboardInterrupt:
                self._interrupt(board)
        thread.join()
        try:
            result: _T = thread.result()
        except StoppedByOperator as error:
            if self.interrupted:
                raise KeyboardInterrupt from error
            raise
        return result

    def _interrupt(self, board: RequestBoard) -> None:
        self.interrupted = True
        board.ask_stop()

    def on_motion(self) -> None:
        """All is armed: the platform is about to move."""

    def on_verdict(self, result: Any) -> None:
        """The verdict of a run is known; no file of its end is written yet.

        Args:
            result: `executor.runner.RunResult`.
        """

    def leaves_files_out(self) -> bool:
        """Whether the operator does not want to wait for the files of the end of a run."""
        return False

    def finish(self) -> None:
        """Everything is done.

        Raises:
            KeyboardInterrupt: The motion was stopped by one.
        """
        if self.interrupted:
            raise KeyboardInterrupt


class _Motion(threading.Thread):
    """A function in a thread, with its result or error."""

    def __init__(self, function: Callable[[], Any]) -> None:
        super().__init__(name="cdpr-motion")
        self._function = function
        self._result: Any = None
        self._error: BaseException | None = None
        self._lock = threading.Lock()
        self.is_done = threading.Event()
        self._begun = self._cancelled = False

    def run(self) -> None:
        with self._lock:
            self._begun = not self._cancelled
        if not self._begun:
            return
        try:
            self._result = self._function()
        except BaseException as error:
            self._error = error
        finally:
            self.is_done.set()

    def cancel(self) -> bool:
        """Prevents the function from being called; False where it is being called."""
        with self._lock:
            self._cancelled = True
            return not self._begun

    def result(self) -> Any:
        if self._error is not None:
            raise self._error
        return self._result
