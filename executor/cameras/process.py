"""A camera's own process, so that images never delay the loop, nor one camera another.

It takes (or renders) an image when it is asked, measures the pose, and says so at once. In real
time it is not asked again before it has answered, and an image that was due is counted as dropped.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from executor.cameras.live_image import ImageBoard
from executor.realtime.scheduling import interrupts_blocked
from executor.recording.run_folder import RunFolder
from model.errors import CdprError, Fault
from model.pose import Pose
from model.rig import Camera, Rig
from tracking.clearance import MeasuredClearance
from tracking.measurement import NoPose, Observation
from tracking.tracker import EncoderExtrapolator, Tracker

# What a camera's process does with a trigger: an image, and the pose in it.


@dataclass(frozen=True, slots=True, eq=False)
class FrameRequest:
    """Asks for one image.

    Attributes:
        frame: Number of the moment, the same for all cameras.
        time: Since the start of the run, [s].
        asked: When, monotonic, [s].
        true_pose: Where the simulated platform is; None with a real camera.
        by_drives: Where the drives' positions put the platform; None when they are unknown.
    """

    frame: int
    time: float
    asked: float
    true_pose: Pose | None
    by_drives: Pose | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraSample:
    """What came of one image, or of the images that several cameras took at one moment.

    Attributes:
        frame: Number of the moment.
        found: The pose, or why there is none; its time is since the start of the run, [s].
        picture: Name of the kept image in the run folder, or nothing.
        seconds: How long measuring took, [s]; NaN where nothing was measured.
        clearance: Distances at the measured pose, or None.
    """

    frame: int
    found: Observation
    picture: str = ""
    seconds: float = float("nan")
    clearance: MeasuredClearance | None = None


def unseen(frame: int, time: float, reason: str) -> CameraSample:
    """What is known of an image that was asked for and never measured."""
    return CameraSample(frame, NoPose(time, reason))


class PictureSource(Protocol):
    """A camera, real or rendered, that gives an image when asked."""

    def picture(self, trigger: FrameRequest) -> tuple[NDArray[np.uint8], float]:
        """A grey image, and how much later than asked for it was taken, [s]."""
        ...

    def close(self) -> None:
        """Lets go of the camera."""
        ...


_NOTHING: tuple[int, NDArray[np.uint8], Observation] = (
    0, np.zeros((0, 0), np.uint8), NoPose(0.0, "")
)  # fmt: skip


class CameraWorker:
    """Takes images with one camera and measures them, as a context manager."""

    def __init__(
        self,
        rig: Rig,
        camera: Camera,
        source: PictureSource,
        folder: RunFolder | None,
        keep_every: int,
        *,
        named: bool,
        live: ImageBoard | None = None,
    ) -> None:
        """Prepares to look.

        Args:
            rig: The robot with its tags.
            camera: The camera that the source is.
            source: Where images come from.
            folder: Where some of them are kept; None to keep none.
            keep_every: Every how many images one is kept.
            named: Kept images are in a folder of the camera's name: there are others.
            live: Where images are shown to who looks on; None to show none.
        """
        self._source, self._folder, self._keep_every = source, folder, keep_every
        self._name = camera.name if named else ""
        self._tracker, self._drives = Tracker(rig, camera), EncoderExtrapolator()
        self._live, self._newest = live, _NOTHING

    def __enter__(self) -> CameraWorker:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._source.close()

    def look(self, trigger: FrameRequest) -> CameraSample:
        """Takes an image and measures the platform in it."""
        image, delay = self._source.picture(trigger)
        kept = ""
        if self._folder is not None and trigger.frame % self._keep_every == 0:
            kept = self._folder.write_picture(trigger.frame, image, self._name)
        taken = trigger.time + delay
        by_drives = self._drives.at(taken, trigger.time, trigger.by_drives)
        began = time.monotonic()
        found = self._tracker.observe(image, taken, by_drives)
        self._newest = trigger.frame, image, found
        return CameraSample(trigger.frame, found, kept, time.monotonic() - began)

    def show(self) -> None:
        """Shows the newest image to who looks on; called when its answer is on its way."""
        if self._live is not None:
            self._live.show(*self._newest)


MakeObserver = Callable[[], CameraWorker]


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
