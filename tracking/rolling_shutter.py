"""Rolling-shutter correction: edges as a global shutter at the middle row's time would show them.

An image is stamped with the time of its middle row; other rows show a moving platform's tags a
little earlier or later. With the platform's motion the edges are shifted to the middle row's time,
and the pose follows as from any image.

Source: Hedborg, Forssén, Felsberg & Ringaby, "Rolling shutter bundle adjustment", CVPR 2012.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.cameras import Z_95
from model.pose import (
    Array,
    Pose,
    matrix_from_rotation_vector,
    moved,
    read_only,
    step_between,
)
from model.rig import Camera, Rig
from tracking.camera_model import pixels_of, project_undistorted
from tracking.detection.tags import tag_corners
from tracking.measurement import MEMORY, PoseMeasurement
from tracking.pnp import BundlePose, TagView, refine_pnp

#: Poses for a velocity are at least this many readouts apart, if possible; much farther apart,
#: changes of acceleration matter more than the poses' scatter.
APART = 2.0
#: Iterations of motion and pose.
PASSES = 2
#: Step of the motion for finite differences, [m/s] and [rad/s].
_STEP = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class PlatformMotion:
    """A steady motion of the platform.

    Attributes:
        velocity: Of its origin, world frame, shape (3,), [m/s].
        turning: Angular velocity, world axes, shape (3,), [rad/s].
    """

    velocity: Array
    turning: Array

    @classmethod
    def between(cls, before: Pose, after: Pose, seconds: float) -> PlatformMotion:
        """The motion from one pose to another in a non-zero time."""
        twist = step_between(before, after) / seconds
        return cls(twist[:3], twist[3:])

    def moved(self, pose: Pose, seconds: float) -> Pose:
        """The pose at a later or earlier time."""
        turn = matrix_from_rotation_vector(self.turning * seconds)
        return Pose(pose.position + self.velocity * seconds, turn @ pose.rotation)


class RecentMotion:
    """Motion of the platform from its poses of the last half second.

    It uses uncorrected poses: their errors are nearly equal, so that their differences are those of
    the true poses. Corrected poses would carry errors of the motion from image to image.
    """

    def __init__(self, readout: float) -> None:
        """Starts without measurements.

        Args:
            readout: Of the camera, [s].
        """
        self._apart = APART * abs(readout)
        self._past: deque[PoseMeasurement] = deque()

    def add(self, measurement: PoseMeasurement) -> None:
        """Adds the next measurement in time and drops old ones."""
        self._past.append(measurement)
        while len(self._past) > 2 and self._past[1].time < measurement.time - 2.0 * MEMORY:
            self._past.popleft()

    def at(self, time: float, pose: Pose) -> PlatformMotion | None:
        """The motion at a time, None if unknown.

        Through a pose and two earlier ones, at constant acceleration.

        Args:
            time: Of the pose, [s]; not before the measurements.
            pose: ``world_from_platform`` without correction.
        """
        last, first = self._bases(time)
        if last is None:
            return None
        now = PlatformMotion.between(last.uncorrected, pose, time - last.time)
        if first is None:
            return now
        then = PlatformMotion.between(first.uncorrected, last.uncorrected, last.time - first.time)
        more = (time - last.time) / (time - first.time)
        return PlatformMotion(
            now.velocity + more * (now.velocity - then.velocity),
            now.turning + more * (now.turning - then.turning),
        )

    def covariance(self, time: float) -> Array | None:
        """Covariance of velocity and angular velocity, shape (6, 6), or None."""
        last, first = self._bases(time)
        if last is None:
            return None
        by_now, by_first, more = 1.0 / (time - last.time), 0.0, 0.0
        if first is not None:
            more = (time - last.time) / (time - first.time)
            by_first = more / (last.time - first.time)
        by_now *= 1.0 + more
        squares = by_now**2 + (by_now + by_first) ** 2 + by_first**2
        return squares * last.covariance

    def _bases(self, time: float) -> tuple[PoseMeasurement | None, PoseMeasurement | None]:
        """The measurement that a velocity is computed from, and the one before it."""
        last = self._before(time)
        return last, None if last is None else self._before(last.time)

    def _before(self, time: float) -> PoseMeasurement | None:
        """The newest measurement long enough before a time, else the oldest recent one."""
        old = [one for one in self._past if 0.0 < time - one.time <= MEMORY]
        far = [one for one in old if time - one.time >= self._apart]
        return far[-1] if far else old[0] if old else None


def correct_rolling_shutter(
    camera: Camera, views: Sequence[TagView], pose: Pose, motion: PlatformMotion
) -> list[TagView]:
    """Views as with a global shutter at the middle row's time.

    Args:
        pose: Approximate ``world_from_platform`` at the middle row's time.
        motion: Of the platform during the exposure.
    """
    corrected = []
    for view in views:
        shift = _shift(camera, pose.apply(tag_corners(view.tag)), pose, motion)
        seen = replace(
            view.seen,
            corners=read_only(view.seen.corners - shift),
            target=read_only(view.seen.target - view.seen.whitening @ shift.ravel()),
        )
        corrected.append(TagView(view.tag, seen))
    return corrected


def _shift(camera: Camera, points: Array, pose: Pose, motion: PlatformMotion) -> Array:
    """Undistorted shift of points from their position at the middle row's time, (4, 2)."""
    camera_from_world = camera.world_from_camera.inverse()
    speeds = motion.velocity + np.cross(motion.turning, points - pose.position)
    there = points
    for _ in range(3):  # row and time depend on each other
        times = camera.row_times(pixels_of(camera, camera_from_world.apply(there)))
        there = points + times[:, None] * speeds
    seen, middle = (
        project_undistorted(camera, camera_from_world.apply(p)) for p in (there, points)
    )
    return np.asarray(seen - middle)


def pose_by_motion(camera: Camera, views: Sequence[TagView], camera_from_body: Pose) -> Array:
    """Derivative of the fitted pose by the motion used for correction.

    Returns:
        Of position and rotation vector along the world's axes, by velocity and angular velocity,
        shape (6, 6).
    """
    pose = camera.world_from_camera.compose(camera_from_body)
    slopes = np.zeros((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = _STEP
        corrected = correct_rolling_shutter(camera, views, pose, PlatformMotion(step[:3], step[3:]))
        fitted = refine_pnp(camera, corrected, camera_from_body)
        if fitted is None:
            return np.full((6, 6), np.inf)
        there = camera.world_from_camera.compose(fitted.camera_from_body)
        slopes[:, k] = step_between(pose, there)
    return slopes / _STEP


@dataclass(frozen=True, slots=True, eq=False)
class FitByRows:
    """A rolling-shutter corrected pose, at the middle row's time.

    Attributes:
        views: The views used, corrected.
        bundle: The pose, in the camera frame.
        covariance: From the uncertain motion, along the world's axes, shape (6, 6), [m, rad].
        at_rest: ``world_from_platform`` without correction.
    """

    views: list[TagView]
    bundle: BundlePose
    covariance: Array
    at_rest: Pose


Fit = Callable[[list[TagView], Pose], tuple[list[TagView], BundlePose] | None]
"""Finds the pose of views in the camera frame, near another, and the views used."""


class RollingShutter:
    """Rolling-shutter correction of a camera's poses."""

    def __init__(self, rig: Rig, camera: Camera, recent: RecentMotion) -> None:
        """Sets up the correction for a camera.

        Args:
            rig: Gives the platform's largest speed.
            recent: Recent motion of the platform.
        """
        self._camera, self._recent = camera, recent
        speed = rig.motion.speed / Z_95
        turning = speed / float(np.linalg.norm(rig.half_size))
        self._unknown = np.diag([speed**2] * 3 + [turning**2] * 3)

    def fitted(self, time: float, views: list[TagView], start: Pose, fit: Fit) -> FitByRows | None:
        """The pose at the middle row's time, or None if nothing fits.

        If the motion is unknown, the platform is assumed at rest, and the covariance covers its
        commanded speed.

        Args:
            time: Of the middle row, [s].
            start: A guess of ``camera_from_platform``.
            fit: Finds the pose of views.
        """
        first = refine_pnp(self._camera, views, start) if views else None
        if first is None:
            return None
        found, at_rest = None, self._in_world(first)
        pose = at_rest
        for _ in range(PASSES):
            motion = self._recent.at(time, at_rest)
            if motion is None:
                break
            corrected = correct_rolling_shutter(self._camera, views, pose, motion)
            found = fit(corrected, first.camera_from_body)
            if found is None:
                break
            pose, slopes = self._in_world(found[1]), self._slopes(*found)
            change = slopes @ np.concatenate([motion.velocity, motion.turning])
            at_rest = moved(pose, -change)
        by_motion = self._recent.covariance(time)
        if found is None or by_motion is None:
            found, by_motion = fit(views, start), self._unknown
            if found is None:
                return None
            at_rest, slopes = self._in_world(found[1]), self._slopes(*found)
        return FitByRows(*found, slopes @ by_motion @ slopes.T, at_rest)

    def _in_world(self, bundle: BundlePose) -> Pose:
        return self._camera.world_from_camera.compose(bundle.camera_from_body)

    def _slopes(self, views: list[TagView], bundle: BundlePose) -> Array:
        return pose_by_motion(self._camera, views, bundle.camera_from_body)
