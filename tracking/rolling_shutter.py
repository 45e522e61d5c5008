"""Rolling shutters: what rows that are exposed one after the other would show all at once.

An image is stamped with the time of its middle row. What a moving platform's tags show in another
row is where they were a little earlier or later; with the platform's motion the edges are put where
the middle row's time has them, and the pose follows as from any image.

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
    PlatformMotion,
    Pose,
    matrix_from_rotation_vector,
    read_only,
    rotation_vector_from_matrix,
)
from model.rig import Camera, Rig
from tracking.camera_model import pixels_of, project_undistorted
from tracking.detection.tags import tag_corners
from tracking.measurement import MEMORY, PoseMeasurement
from tracking.pnp import BundlePose, TagView, refine_pnp

#: Poses that a speed is taken from are this many readouts apart, where there are such: farther
#: apart, acceleration that changes meanwhile counts for more than the poses' scatter.
APART = 2.0
#: Times that the motion is taken from the pose that was found with it.
PASSES = 2
#: Of the motion that a pose's dependence on it is found with, [m/s] and [rad/s].
_STEP = 0.02


class RecentMotion:
    """How a platform moves, by its poses of the last half second.

    The poses are those that fit as if all rows had been exposed at once. They are off by nearly the
    same, so that their differences are those of the true ones; true ones would carry errors of the
    motion from image to image.
    """

    def __init__(self, readout: float) -> None:
        """Nothing was measured yet.

        Args:
            readout: Of the camera, [s].
        """
        self._apart = APART * abs(readout)
        self._past: deque[PoseMeasurement] = deque()

    def add(self, measurement: PoseMeasurement) -> None:
        """The next one in time; what is too old is forgotten."""
        self._past.append(measurement)
        while len(self._past) > 2 and self._past[1].time < measurement.time - 2.0 * MEMORY:
            self._past.popleft()

    def at(self, time: float, pose: Pose) -> PlatformMotion | None:
        """The motion at a time, None where it is not known.

        Through a pose and two before it, as if acceleration were steady.

        Args:
            time: Of the pose, [s]; not before the measurements.
            pose: ``world_from_platform`` that fits as if all rows had been exposed at once.
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
        """What the poses' scatter leaves open of velocity and turning, shape (6, 6), or None."""
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
        """The measurement that a motion is taken from, and the one before it."""
        last = self._before(time)
        return last, None if last is None else self._before(last.time)

    def _before(self, time: float) -> PoseMeasurement | None:
        """The newest measurement long enough before a time, else the oldest; none too old."""
        old = [one for one in self._past if 0.0 < time - one.time <= MEMORY]
        far = [one for one in old if time - one.time >= self._apart]
        return far[-1] if far else old[0] if old else None


def rows_at_once(
    camera: Camera, views: Sequence[TagView], pose: Pose, motion: PlatformMotion
) -> list[TagView]:
    """Views as they would be if all rows had been exposed with the middle one.

    Args:
        camera: The camera.
        views: As they were seen.
        pose: ``world_from_platform`` at the middle row's time; roughly will do.
        motion: Of the platform meanwhile.
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
    """How far points are seen from where the middle row's time has them, ideal, shape (4, 2)."""
    camera_from_world = camera.world_from_camera.inverse()
    speeds = motion.velocity + np.cross(motion.turning, points - pose.position)
    there = points
    for _ in range(3):  # the row decides on the time, and the time on the row
        times = camera.row_times(pixels_of(camera, camera_from_world.apply(there)))
        there = points + times[:, None] * speeds
    seen, middle = (
        project_undistorted(camera, camera_from_world.apply(p)) for p in (there, points)
    )
    return np.asarray(seen - middle)


def pose_by_motion(camera: Camera, views: Sequence[TagView], camera_from_body: Pose) -> Array:
    """How the pose that fits views depends on the motion that they are corrected by.

    Returns:
        Change of position and rotation vector along the world's axes by velocity and turning, shape
        (6, 6).
    """
    pose = camera.world_from_camera.compose(camera_from_body)
    slopes = np.zeros((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = _STEP
        corrected = rows_at_once(camera, views, pose, PlatformMotion(step[:3], step[3:]))
        fitted = refine_pnp(camera, corrected, camera_from_body)
        if fitted is None:
            return np.full((6, 6), np.inf)
        there = camera.world_from_camera.compose(fitted.camera_from_body)
        slopes[:3, k] = there.position - pose.position
        slopes[3:, k] = rotation_vector_from_matrix(there.rotation @ pose.rotation.T)
    return slopes / _STEP


@dataclass(frozen=True, slots=True, eq=False)
class FitByRows:
    """A pose at the middle row's time.

    Attributes:
        views: What it rests on, as if all rows had been exposed then.
        bundle: The pose, in the camera's frame.
        covariance: What the motion leaves open, along the world's axes, shape (6, 6), [m, rad].
        at_rest: ``world_from_platform`` that fits as if all rows had been exposed at once.
    """

    views: list[TagView]
    bundle: BundlePose
    covariance: Array
    at_rest: Pose


Fit = Callable[[list[TagView], Pose], tuple[list[TagView], BundlePose] | None]
"""Finds the pose of views in the camera's frame, near another, and which views it rests on."""


class RollingShutter:
    """Poses at one time by a camera whose rows are exposed one after the other."""

    def __init__(self, rig: Rig, camera: Camera, recent: RecentMotion) -> None:
        """Takes the camera.

        Args:
            rig: Says how fast the platform may go.
            camera: The camera.
            recent: How the platform moved.
        """
        self._camera, self._recent = camera, recent
        speed = rig.motion.speed / Z_95
        turning = speed / float(np.linalg.norm(rig.half_size))
        self._unknown = np.diag([speed**2] * 3 + [turning**2] * 3)

    def fitted(self, time: float, views: list[TagView], start: Pose, fit: Fit) -> FitByRows | None:
        """The pose at the middle row's time, or None when nothing fits.

        Where the motion is not known, the platform is taken to stand still, and the covariance says
        what the speed that it is commanded with would change.

        Args:
            time: Of the middle row, [s].
            views: As they were seen.
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
            corrected = rows_at_once(self._camera, views, pose, motion)
            found = fit(corrected, first.camera_from_body)
            if found is None:
                break
            pose, slopes = self._in_world(found[1]), self._slopes(*found)
            change = slopes @ np.concatenate([motion.velocity, motion.turning])
            at_rest = _without(pose, change)
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


def _without(pose: Pose, change: Array) -> Pose:
    """A pose without a small change of position and rotation vector, shape (6,)."""
    turn = matrix_from_rotation_vector(-change[3:])
    return Pose(pose.position - change[:3], turn @ pose.rotation)
