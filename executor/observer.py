"""What the camera's process does with a trigger: a picture, a pose, a clearance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cdpr.clearance import ClearanceModel
from cdpr.poses import Array, Pose
from cdpr.rig import Camera, Rig
from cdpr.scene import Scene
from executor.near_watch import NearWatch
from executor.pose_table import OK
from executor.run_folder import RunFolder
from tracking.measured_clearance import MeasuredClearance, clearance_of
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker


@dataclass(frozen=True, slots=True, eq=False)
class Trigger:
    """Asks for one picture.

    Attributes:
        frame: Its number.
        time: Since the start of the run, [s].
        asked: When, monotonic, [s].
        true_pose: Where the simulated platform is; None with a real camera.
    """

    frame: int
    time: float
    asked: float
    true_pose: Pose | None


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What came of one picture; the arrays are NaN where there is no pose.

    Attributes:
        frame: Its number.
        time: Of the picture, since the start of the run, [s].
        status: ``ok``, or why there is no pose.
        pose: ``world_from_platform`` as measured, or None.
        covariance: Of position and rotation vector, world axes, shape (6, 6), [m, rad].
        tags: Numbers of the tags used.
        reprojection: RMS of the corners, [px].
        picture: Name of the kept picture in the run folder, or nothing.
        clearance: Distances at the measured pose, or None.
    """

    frame: int
    time: float
    status: str
    pose: Pose | None
    covariance: Array
    tags: tuple[int, ...]
    reprojection: float
    picture: str
    clearance: MeasuredClearance | None


def unseen(frame: int, time: float, reason: str) -> Look:
    """What is known of a picture that gave no pose, or was asked for and never taken."""
    unknown = np.full((6, 6), np.nan)
    return Look(frame, time, reason, None, unknown, (), float("nan"), "", None)


class PictureSource(Protocol):
    """A camera, real or rendered, that gives a picture when asked."""

    def picture(self, trigger: Trigger) -> tuple[NDArray[np.uint8], float]:
        """A grey picture, and how much later than asked for it was taken, [s]."""
        ...

    def close(self) -> None:
        """Lets go of the camera."""
        ...


class Observer:
    """Takes pictures and measures them, as a context manager."""

    def __init__(
        self,
        rig: Rig,
        scene: Scene,
        camera: Camera,
        source: PictureSource,
        folder: RunFolder,
        keep_every: int,
    ) -> None:
        """Prepares to look.

        Args:
            rig: The robot with its tags.
            scene: Its obstacles.
            camera: The camera that the source is.
            source: Where pictures come from.
            folder: Where some of them are kept.
            keep_every: Every how many pictures one is kept.
        """
        self._source, self._folder, self._keep_every = source, folder, keep_every
        self._tracker = Tracker(rig, camera)
        self._clearance = ClearanceModel(rig, scene)
        self._watch = NearWatch(scene.obstacle_clearance)
        self.too_near = ""
        """Between what clearance was below the scene's limit in the last pictures, or nothing."""

    def __enter__(self) -> Observer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._source.close()

    def look(self, trigger: Trigger) -> Look:
        """Takes a picture and measures the platform in it."""
        image, delay = self._source.picture(trigger)
        time = trigger.time + delay
        kept = ""
        if trigger.frame % self._keep_every == 0:
            kept = self._folder.write_picture(trigger.frame, image)
        found = self._tracker.observe(image, time)
        if not isinstance(found, PoseMeasurement):
            return replace(unseen(trigger.frame, time, found.reason), picture=kept)
        clearance = clearance_of(self._clearance, found)
        self.too_near = self._watch.take(clearance)
        return Look(
            trigger.frame,
            time,
            OK,
            found.pose,
            found.covariance,
            found.tags,
            found.reprojection,
            kept,
            clearance,
        )


MakeObserver = Callable[[], Observer]
