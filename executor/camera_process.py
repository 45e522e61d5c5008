"""The camera's own process, so that pictures never delay the loop.

The loop triggers; the process takes (or renders) a picture, measures the pose, says so, and gives
all its answers at the end. In real time a trigger that comes too early is dropped and counted.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

from cdpr.errors import CdprError, Fault
from cdpr.poses import Pose
from executor.camera_sight import CameraSight
from executor.observer import Look, MakeObserver, Trigger
from executor.spawning import interrupts_blocked

#: How long the process may take to import its libraries and open its camera, [s].
START_TIMEOUT = 60.0


@dataclass(frozen=True, slots=True)
class _Progress:
    """So many pictures were measured; so many in a row, up to the last, gave no pose.

    ``near`` says with which obstacle the measured clearance fell below the limit, if it did.
    """

    measured: int
    blind: int
    near: str = ""


@dataclass(frozen=True, slots=True)
class _Failure:
    """An error of the camera's process, as it travels to the parent."""

    error: CdprError | str


class CameraProcess:
    """Takes pictures when told to and measures the platform in them."""

    def __init__(self, make_observer: MakeObserver, *, may_wait: bool) -> None:
        """Starts the process and waits until its camera is ready.

        Args:
            make_observer: Called in the process; picklable.
            may_wait: In simulated time a trigger waits until the picture before is measured. In
                real time it is dropped instead, so that no picture is older than it says.

        Raises:
            CdprError: The camera cannot be used, for the reason told.
        """
        self.dropped = 0
        self.triggered = 0
        self._measured = 0
        self._sight = CameraSight()
        self.trouble = ""
        """Why no pose was measured any more when a picture was last due; nothing if it was."""
        self.near = ""
        """Between what the measured clearance fell below the limit, with numbers; else nothing."""
        self._may_wait = may_wait
        self._closed = False
        context = multiprocessing.get_context("spawn")
        self._link, far_end = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(make_observer, far_end), name="cdpr-camera", daemon=True
        )
        with interrupts_blocked():
            self._process.start()
        far_end.close()
        try:
            if not self._link.poll(START_TIMEOUT):
                raise Fault(f"the camera's process was not ready within {START_TIMEOUT:.0f} s")
            self._receive()
        except BaseException:
            self.close()
            raise

    def trigger(self, time: float, asked: float, true_pose: Pose | None) -> None:
        """Asks for a picture now.

        Args:
            time: Since the start of the run, [s].
            asked: The same moment on the monotonic clock, [s].
            true_pose: Where the simulated platform is; None with a real camera.

        Raises:
            CdprError: The process is gone, for the reason told.
        """
        # Simulated time waits for the picture before: a stop comes at the same place every time.
        while self._link.poll() or (self._may_wait and self._measured < self.triggered):
            answer = self._receive()
            if isinstance(answer, _Progress):
                self._measured = answer.measured
                self._sight.answer(answer.blind)
                self.near = self.near or answer.near
        self.trouble = self._sight.trouble(asked)
        if not self._may_wait and self._measured < self.triggered:
            self.dropped += 1
            return
        self._send(Trigger(self.triggered, time, asked, true_pose))
        self._sight.ask(asked)
        self.triggered += 1

    def finish(self, progress: Callable[[float], None]) -> list[Look]:
        """Waits until the last picture is measured; returns all of them and ends the process.

        Raises:
            CdprError: The process failed, for the reason told.
        """
        try:
            self._send(None)
            while True:
                answer = self._receive()
                if isinstance(answer, list):
                    return answer
                progress(float(answer.measured))
        finally:
            self.close()

    def close(self) -> None:
        """Ends the process, whatever it does; further calls change nothing."""
        if self._closed:
            return
        self._closed = True
        self._link.close()
        self._process.join(timeout=2.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
        self._process.close()

    def _send(self, item: Trigger | None) -> None:
        try:
            self._link.send(item)
        except OSError:  # the process is gone; why, it may have told before
            while True:
                self._receive()

    def _receive(self) -> list[Look] | _Progress:
        try:
            answer = self._link.recv()
        except (EOFError, ConnectionResetError):
            raise Fault("the camera's process ended without an answer") from None
        if isinstance(answer, _Failure):
            raise answer.error if isinstance(answer.error, CdprError) else Fault(answer.error)
        return answer  # type: ignore[no-any-return]  # what our own process sends


def _serve(make_observer: MakeObserver, link: Connection) -> None:
    """The process: a picture a trigger, then all answers at once; it ends with its parent."""
    with suppress(_NobodyThere):
        try:
            with make_observer() as observer:
                _say(link, _Progress(0, 0))
                looks: list[Look] = []
                blind = 0
                while (trigger := _next_trigger(link)) is not None:
                    looks.append(observer.look(trigger))
                    blind = 0 if looks[-1].pose is not None else blind + 1
                    _say(link, _Progress(len(looks), blind, observer.too_near))
                _say(link, looks)
        except CdprError as error:
            _say(link, _Failure(error))
        except Exception as error:
            what = f"the camera's process failed: {type(error).__name__}: {error}"
            _say(link, _Failure(what))


class _NobodyThere(BaseException):
    """The parent is gone; there is nothing left to do, and nobody to tell."""


def _say(link: Connection, what: list[Look] | _Progress | _Failure) -> None:
    try:
        link.send(what)
    except OSError:
        raise _NobodyThere from None


def _next_trigger(link: Connection) -> Trigger | None:
    try:
        return link.recv()  # type: ignore[no-any-return]  # what our own parent sends
    except (EOFError, OSError):
        raise _NobodyThere from None
