"""What links a motion to the program that asks for it: a question before, stops while it moves."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, ClassVar, Protocol, TypeVar

from executor.operator_requests import RequestBoard
from model.errors import StoppedByOperator

_T = TypeVar("_T")


class Proposal(Protocol):
    """What is about to happen; a `confirm` callback shows it and answers its question.

    Attributes:
        question: Asked of the operator.
        otherwise: What a no leaves, such as ``nothing was moved``.
    """

    question: ClassVar[str]
    otherwise: ClassVar[str]


def require_confirmed(confirm: Callable[[Any], bool] | None, proposal: Proposal) -> None:
    """Asks before anything moves or changes; without a callback the caller has decided.

    Raises:
        StoppedByOperator: The answer was no.
    """
    if confirm is not None and not confirm(proposal):
        raise StoppedByOperator(proposal.otherwise, next_step="run it again and confirm")


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
