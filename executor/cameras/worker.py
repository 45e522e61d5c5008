"""What a camera's process does with a trigger: an image, and the pose in it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from executor.cameras.live_image import ImageBoard
from executor.recording.run_folder import RunFolder
from model.pose import Pose
from model.rig import Camera, Rig
from tracking.clearance import MeasuredClearance
from tracking.measurement import NoPose, Observation
from tracking.tracker import DrivesAhead, Tracker


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
        self._tracker, self._drives = Tracker(rig, camera), DrivesAhead()
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
