"""The process of a camera, so that images never delay the loop or another camera.

It takes (or renders) an image on request, measures the pose, and answers at once. In real time no
further request is sent before the answer; images due meanwhile count as dropped.
"""

from __future__ import annotations

import multiprocessing
import signal
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
from executor.realtime.scheduling import ended_at_start, interrupts_blocked
from executor.recording.run_folder import RunFolder
from executor.state_machine import PlatformPoses
from model.errors import CdprError, Fault, require_child_processes
from model.pose import Pose
from model.rig import Camera, Rig
from tracking.clearance import MeasuredClearance
from tracking.measurement import NoPose, Observation

# The camera worker: takes an image on request and measures the pose in it.


@dataclass(frozen=True, slots=True, eq=False)
class FrameRequest:
    """Request for one image.

    Attributes:
        frame: Frame number, the same for all cameras.
        poses: Of the platform, when it is requested.
        true_poses: True poses since all cameras last took a request, with their times, [s].
    """

    frame: int
    poses: PlatformPoses
    true_poses: tuple[tuple[float, Pose], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CameraSample:
    """Measurement of one image, or of simultaneous images of several cameras.

    Attributes:
        frame: Frame number.
        found: The pose, or why there is none; its time is since the start of the run, [s].
        picture: Name of the image kept in the run folder, or empty.
        seconds: Processing time, [s]; NaN if nothing was measured.
        clearance: Distances at the measured pose, or None.
        late, truncated: Numbers of images that were delivered so far but not used, as they came
            late or were truncated.
    """

    frame: int
    found: Observation
    picture: str = ""
    seconds: float = float("nan")
    clearance: MeasuredClearance | None = None
    late: int = 0
    truncated: int = 0


def sample_without_pose(frame: int, time: float, reason: str) -> CameraSample:
    """A sample without a pose, for an image that was never measured."""
    return CameraSample(frame, NoPose(time, reason))


class ImageSource(Protocol):
    """A camera, real or rendered, that delivers images on request."""

    def image(self, trigger: FrameRequest) -> tuple[NDArray[np.uint8], float]:
        """A grey image, and the middle of its exposure after the request, [s]."""

    @property
    def unused(self) -> tuple[int, int]:
        """Numbers of images not used so far, as they came late, or were truncated."""

    def close(self) -> None:
        """Closes the camera."""


_NOTHING: tuple[int, NDArray[np.uint8], Observation] = (
    0, np.zeros((0, 0), np.uint8), NoPose(0.0, "")
)  # fmt: skip


#: Number of kept images after which the interval of kept images doubles.
KEPT_IMAGES = 12


class CameraWorker:
    """Takes images with one camera and measures them, as a context manager."""

    def __init__(
        self,
        rig: Rig,
        camera: Camera,
        source: ImageSource,
        folder: RunFolder | None,
        keep_every: int,
        *,
        named: bool,
        live: ImageBoard | None = None,
    ) -> None:
        """Prepares the tracker.

        Args:
            rig: The robot with its tags.
            folder: For kept images; None to keep none.
            keep_every: First interval of kept images, in frames; it doubles after every
                `KEPT_IMAGES`, so that a run on hold for hours does not fill the disk.
            named: Keep images in a folder of the camera's name, as there are several cameras.
            live: For viewers; None to show no images.
        """
        self._source, self._folder, self._keep_every = source, folder, keep_every
        self._kept = 0
        self._name = camera.name if named else ""
        # The supervisor of cameras loads no tracker, which takes as long as all else that it loads.
        from tracking.tracker import EncoderExtrapolator, Tracker

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

    def measure(self, trigger: FrameRequest) -> CameraSample:
        """Takes an image and measures the platform pose in it."""
        image, delay = self._source.image(trigger)
        name = ""
        if self._folder is not None and trigger.frame % self._keep_every == 0:
            name = self._folder.write_image(trigger.frame, image, self._name)
            self._kept += 1
            if self._kept % KEPT_IMAGES == 0:
                self._keep_every *= 2
        now = trigger.poses
        taken = now.time + delay
        encoder_pose = self._drives.at(taken, now.time, now.encoder)
        began = time.monotonic()
        found = self._tracker.observe(image, taken, encoder_pose)
        self._newest = trigger.frame, image, found
        seconds, (late, truncated) = time.monotonic() - began, self._source.unused
        return CameraSample(trigger.frame, found, name, seconds, late=late, truncated=truncated)

    def show(self) -> None:
        """Shows the newest image to viewers; called after its answer was sent."""
        if self._live is not None:
            self._live.show(*self._newest)


MakeWorker = Callable[[], CameraWorker]


#: Time-out of an answer in simulated time, [s].
PATIENCE = 20.0
#: Time for a process to end, [s].
END_TIMEOUT = 2.0


@dataclass(frozen=True, slots=True)
class _Ready:
    """The camera is open."""


@dataclass(frozen=True, slots=True)
class _Failure:
    """An error of the camera's process, sent to the parent."""

    error: CdprError | str


class CameraProcess:
    """Takes images with one camera on request, and measures the platform in them."""

    def __init__(self, name: str, make_worker: MakeWorker, *, may_wait: bool) -> None:
        """Starts the process; see `is_ready`.

        Args:
            make_worker: Called in the process; picklable.
            may_wait: Wait for answers, in simulated time, so that runs are reproducible.
        """
        self.name = name
        self._may_wait = self._waits = may_wait
        self._asked: FrameRequest | None = None
        self._is_open = self._closed = False
        require_child_processes("cameras")
        context = multiprocessing.get_context("spawn")
        self._link, far_end = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(make_worker, far_end), name=f"cdpr-camera-{name}", daemon=True
        )
        with interrupts_blocked(signal.SIGTERM):  # a stopped service sends it to all its processes
            self._process.start()
        far_end.close()

    def is_ready(self, within: float) -> bool:
        """Whether the camera is open; to be called until it is, and not again.

        Args:
            within: Time-out, [s].

        Raises:
            CdprError: It cannot be used.
        """
        if not self._link.poll(within):
            return False
        self._receive()
        self._is_open = True
        return True

    @property
    def unanswered(self) -> FrameRequest | None:
        """The last request while it is unanswered, else None."""
        return self._asked

    def ask(self, trigger: FrameRequest) -> None:
        """Requests an image; the previous request must have been answered.

        Raises:
            CdprError: The process is gone.
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
        """The answer to the request, if it has arrived; waits for it in simulated time.

        After one time-out it does not wait again, so that other cameras can continue.

        Raises:
            CdprError: The process failed.
        """
        return self.answer_within(PATIENCE if self._waits else 0.0)

    def answer_within(self, patience: float) -> CameraSample | None:
        """The answer to the request, if it arrives within ``patience`` [s].

        Raises:
            CdprError: The process failed.
        """
        if not self._link.poll(patience if self._asked is not None else 0.0):
            self._waits = self._waits and self._asked is None
            return None
        sample = self._receive()
        if not isinstance(sample, CameraSample):
            raise TypeError(f"camera {self.name} answered {sample!r}")
        self._asked, self._waits = None, self._may_wait
        return sample

    def close(self) -> None:
        """Ends the process, if necessary by SIGKILL; further calls have no effect."""
        if self._closed:
            return
        self._closed = True
        self._link.close()
        self._process.join(END_TIMEOUT)
        if self._process.is_alive():  # suspended, or waiting for its camera
            self._process.kill()
            self._process.join()
        self._process.close()

    def _receive(self) -> CameraSample | _Ready:
        try:
            answer = self._link.recv()
        except (EOFError, ConnectionResetError):
            name = f"the process of camera {self.name}"
            if self._is_open:
                raise Fault(f"{name} ended without an answer") from None
            self._process.join(END_TIMEOUT)
            raise ended_at_start(name, self._process) from None
        if isinstance(answer, _Failure):
            raise answer.error if isinstance(answer.error, CdprError) else Fault(answer.error)
        return answer  # type: ignore[no-any-return]  # sent by our own process


def _serve(make_worker: MakeWorker, link: Connection) -> None:
    """Main function of the process: answers requests; ends with its parent."""
    with suppress(_ParentGone):
        try:
            with make_worker() as worker:
                _send(link, _Ready())
                while True:
                    _send(link, worker.measure(_next_trigger(link)))
                    worker.show()
        except CdprError as error:
            _send(link, _Failure(error))
        except Exception as error:
            what = f"the camera process failed: {type(error).__name__}: {error}"
            _send(link, _Failure(what))


class _ParentGone(BaseException):
    """The parent is gone; nothing remains to be done."""


def _send(link: Connection, what: CameraSample | _Ready | _Failure) -> None:
    try:
        link.send(what)
    except OSError:
        raise _ParentGone from None


def _next_trigger(link: Connection) -> FrameRequest:
    try:
        return link.recv()  # type: ignore[no-any-return]  # sent by our own parent
    except (EOFError, OSError):
        raise _ParentGone from None
