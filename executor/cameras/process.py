"""A camera's own process, so that images never delay the loop, nor one camera another.

It takes (or renders) an image when it is asked, measures the pose, and says so at once. In real
time it is not asked again before it has answered, and an image that was due is counted as dropped.
"""

from __future__ import annotations

import multiprocessing
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

from executor.cameras.worker import CameraSample, FrameRequest, MakeObserver
from executor.realtime.scheduling import interrupts_blocked
from model.errors import CdprError, Fault

#: In simulated time an answer is waited for no longer than this, [s].
PATIENCE = 20.0
#: How long a process may take to end, [s].
END_TIMEOUT = 2.0


@dataclass(frozen=True, slots=True)
class _Ready:
    """The camera is open."""


@dataclass(frozen=True, slots=True)
class _Failure:
    """An error of the camera's process, as it travels to the parent."""

    error: CdprError | str


class CameraProcess:
    """Takes images with one camera on request, and measures the platform in them."""

    def __init__(self, name: str, make_observer: MakeObserver, *, may_wait: bool) -> None:
        """Starts the process; `is_ready` is true once its camera is.

        Args:
            name: Of the camera.
            make_observer: Called in the process; picklable.
            may_wait: In simulated time answers are waited for, so that the same run sees the same
                every time.
        """
        self.name = name
        self._may_wait = self._waits = may_wait
        self._asked: FrameRequest | None = None
        self._closed = False
        context = multiprocessing.get_context("spawn")
        self._link, far_end = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(make_observer, far_end), name=f"cdpr-camera-{name}", daemon=True
        )
        with interrupts_blocked():
            self._process.start()
        far_end.close()

    def is_ready(self, within: float) -> bool:
        """Whether the camera is open; asked until it is, and then no more.

        Args:
            within: How long it is waited for, [s].

        Raises:
            CdprError: It cannot be used, for the reason given.
        """
        if not self._link.poll(within):
            return False
        self._receive()
        return True

    @property
    def unanswered(self) -> FrameRequest | None:
        """What was asked for last, while there is no answer to it."""
        return self._asked

    def ask(self, trigger: FrameRequest) -> None:
        """Asks for an image; the one before must have been answered.

        Raises:
            CdprError: The process is gone, for the reason given.
        """
        if self._asked is not None:
            raise ValueError(f"camera {self.name} has not answered yet")
        try:
            self._link.send(trigger)
        except OSError:  # the process is gone; it may have reported why
            while True:
                self._receive()
        self._asked = trigger

    def answer(self) -> CameraSample | None:
        """The answer to what was asked, if it is there; waited for in simulated time.

        One that does not come is waited for only once: the others must go on.

        Raises:
            CdprError: The process failed, for the reason given.
        """
        return self.answer_within(PATIENCE if self._waits else 0.0)

    def answer_within(self, patience: float) -> CameraSample | None:
        """The answer to what was asked, if it comes within so long, [s].

        Raises:
            CdprError: The process failed, for the reason given.
        """
        if not self._link.poll(patience if self._asked is not None else 0.0):
            self._waits = self._waits and self._asked is None
            return None
        look = self._receive()
        if not isinstance(look, CameraSample):
            raise TypeError(f"camera {self.name} answered {look!r}")
        self._asked, self._waits = None, self._may_wait
        return look

    def close(self) -> None:
        """Ends the process, whatever it does; further calls change nothing."""
        if self._closed:
            return
        self._closed = True
        self._link.close()
        self._process.join(END_TIMEOUT)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join(END_TIMEOUT)
        if self._process.is_alive():  # a process that is stopped is ended by nothing else
            self._process.kill()
            self._process.join()
        self._process.close()

    def _receive(self) -> CameraSample | _Ready:
        try:
            answer = self._link.recv()
        except (EOFError, ConnectionResetError):
            raise Fault(f"the process of camera {self.name} ended without an answer") from None
        if isinstance(answer, _Failure):
            raise answer.error if isinstance(answer.error, CdprError) else Fault(answer.error)
        return answer  # type: ignore[no-any-return]  # what our own process sends


def _serve(make_observer: MakeObserver, link: Connection) -> None:
    """The process: an answer a trigger; it ends with its parent."""
    with suppress(_NobodyThere):
        try:
            with make_observer() as observer:
                _say(link, _Ready())
                while True:
                    _say(link, observer.look(_next_trigger(link)))
                    observer.show()
        except CdprError as error:
            _say(link, _Failure(error))
        except Exception as error:
            what = f"the camera process failed: {type(error).__name__}: {error}"
            _say(link, _Failure(what))


class _NobodyThere(BaseException):
    """The parent is gone; nothing is left to do or to report."""


def _say(link: Connection, what: CameraSample | _Ready | _Failure) -> None:
    try:
        link.send(what)
    except OSError:
        raise _NobodyThere from None


def _next_trigger(link: Connection) -> FrameRequest:
    try:
        return link.recv()  # type: ignore[no-any-return]  # what our own parent sends
    except (EOFError, OSError):
        raise _NobodyThere from None
