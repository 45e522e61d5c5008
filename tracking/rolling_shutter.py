"""When images are taken: rolling-shutter correction, and the offset between two cameras' clocks.

Edges are corrected to those that a global shutter would show at the middle row's time. An image is
stamped with that time; other rows show a moving platform's tags a little earlier or later. With the
platform's motion the edges are shifted to the middle row's time, and the pose follows as from any
image.

Source: Hedborg, Forssén, Felsberg & Ringaby, "Rolling shutter bundle adjustment", CVPR 2012.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.cameras import Z_95
from model.pose import (
    Array,
    PlatformMotion,
    Pose,
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
        camera: The camera.
        views: As detected.
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
            camera: The camera.
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
            views: As detected.
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


# Offset between the clocks of two cameras.


#: Poses within this time are averaged to a sample, [s]; longest time between samples, [s].
CLOCK_SAMPLE, CLOCK_GAP = 0.0999, 1.1 * MEMORY
#: Clocks are compared from this number of samples on.
LEAST_SAMPLES = 12
#: Iterations of their offset; in the first ones, without a step.
CLOCK_PASSES, BEFORE_STEP = 12, 3


@dataclass(frozen=True, slots=True, eq=False)
class ClockOffset:
    """By how much later the images of the second of two cameras are taken, at both ends.

    Attributes:
        late: At the beginning and the end, shape (2,), [s].
        covariance: Of `late`, shape (2, 2), [s²].
        alone: The same if nothing were known about the cameras' poses.
        speed: Typical speed of the platform, [m/s].
    """

    late: Array
    covariance: Array
    alone: Array
    speed: float

    def shows(self, parts: tuple[float, float], covariance: Array, least: float) -> bool:
        """Whether a sum of parts of both ends exceeds 3σ, and at this speed a distance [m]."""
        value, sigma = abs(float(self.late @ parts)), np.sqrt(parts @ covariance @ parts)
        return bool(value >= 3.0 * sigma and value * self.speed >= least)

    def text(self, end: int) -> str:
        """The size at an end, 0 or 1, with its interval, which covers the rounding."""
        exact, sigma = abs(self.late[end]) * 1e3, np.sqrt(self.covariance[end, end]) * 1e3
        return f"{exact:.0f} ± {np.ceil(Z_95 * sigma + abs(exact - round(exact))):.0f} ms"


def clock_sample(pairs: Sequence[tuple[PoseMeasurement, PoseMeasurement]]) -> Array:
    """Mean times and positions of two cameras, and the covariance of their gap, shape (17,)."""
    rows = [
        np.hstack([a.time, a.pose.position, b.time, b.pose.position, covariance.ravel()])
        for a, b in pairs
        for covariance in [(a.covariance + b.covariance)[:3, :3] / len(pairs)]
    ]
    return np.asarray(np.mean(rows, axis=0))


def clock_offset(
    samples: Array, known: Array, ends: tuple[float, float], *, drifts: bool
) -> ClockOffset | None:
    """The offset between the clocks of two cameras that fits best, from the motion.

    Positions of the second camera are compared with those of the first, interpolated at the times
    where they fit best. What remains is fitted by an offset and a matrix times the position, and a
    step at some time, for a camera that is knocked.

    Args:
        samples: Of `clock_sample`, in order of time, shape (n, 17).
        known: Inverse variances of offset (3) and matrix (9), shape (12, 12).
        ends: First and last time of the second camera, [s].
        drifts: Whether the offset grows linearly with time.

    Returns:
        None with too few samples.
    """
    if len(samples) < LEAST_SAMPLES:
        return None
    times, positions, within = samples[:, 4], samples[:, 5:8], samples[1:-1]
    spans = times[2:] - times[:-2]
    # Without its own position, whose noise would otherwise look like an offset.
    velocity = (positions[2:] - positions[:-2]) / spans[:, None]
    now = np.column_stack([np.ones(len(spans)), within[:, 4] - times.mean()])
    stated, unstated = within[:, 8:].reshape(-1, 3, 3), 0.0
    fit: Array = np.zeros(17)
    prior, scale, step = np.zeros((17, 17)), 1.0, np.inf
    prior[:12, :12] = known
    prior[12:, 12:] = np.diag([1.0, 1.0 if drifts else 1e12, 1.0, 1.0, 1.0])
    for number in range(CLOCK_PASSES):
        shift = now @ fit[12:14]
        there, near = _interpolated(samples, within[:, 4] + shift)
        used = near & (spans <= 2.0 * CLOCK_GAP)
        if np.count_nonzero(used) < LEAST_SAMPLES - 2:
            return None
        after = np.where(within[:, 4] >= step, 1.0, 0.0)
        row = _clock_rows(there - there[used][0], velocity, now, after)
        gap = within[:, 5:8] - there + velocity * shift[:, None]
        spread = stated[used] + unstated * np.eye(3)
        whiten = np.linalg.cholesky(np.linalg.inv(spread))
        row, gap = (np.einsum("nji,nj...->ni...", whiten, x[used]) for x in (row, gap))
        normal = np.tensordot(row, row, ((0, 1), (0, 1)))
        pull = np.tensordot(row, gap, ((0, 1), (0, 1)))
        fit = np.asarray(np.linalg.solve(normal / scale + prior, pull / scale), dtype=float)
        left = gap - row @ fit
        scale = _scatter(left)
        # Errors beyond those stated are added, as single images may state too small ones.
        pulls = np.einsum("nij,nj->ni", whiten, left)
        beyond = (float(np.sum(left**2)) - left.size + 17) / max(float(np.sum(pulls**2)), 1e-30)
        unstated = max(0.0, unstated + beyond)
        if number >= BEFORE_STEP:
            step = within[used, 4][_likely_step(left + row[:, :, 14:] @ fit[14:])]
    then = np.column_stack([np.ones(2), np.array(ends) - times.mean()])
    unknown = np.ones((17, 17))
    unknown[:3, :3] = 1e-4
    covariance, alone = (
        then @ np.linalg.inv(normal / scale + share * prior)[12:14, 12:14] @ then.T
        for share in (1.0, unknown)
    )
    squares = np.sum(velocity[used] ** 2, axis=1)
    speed = float(np.sqrt(np.sum(squares**2) / max(np.sum(squares), 1e-30)))
    return ClockOffset(then @ fit[12:14], covariance, alone, speed)


def _clock_rows(position: Array, velocity: Array, now: Array, after: Array) -> Array:
    """Derivatives of the gap by all parameters of `clock_offset`, shape (n, 3, 17)."""
    eye, n = np.eye(3), len(position)
    return np.concatenate(
        [
            np.broadcast_to(eye, (n, 3, 3)),
            np.einsum("ij,nk->nijk", eye, position).reshape(n, 3, 9),
            velocity[:, :, None] * now[:, None, :],
            eye * after[:, None, None],
        ],
        axis=2,
    )


def _interpolated(samples: Array, wanted: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Positions of the first camera, by cubics through four samples, and whether they are near."""
    times, order = samples[:, 0], [samples[:, 1:4]]
    for k in range(1, 4):  # Newton's divided differences
        order.append(np.diff(order[-1], axis=0) / (times[k:] - times[:-k])[:, None])
    first = np.clip(np.searchsorted(times, wanted) - 2, 0, len(times) - 4)
    value = order[3][first]
    for k in (2, 1, 0):
        value = order[k][first] + (wanted - times[first + k])[:, None] * value
    longest = np.max([times[first + k + 1] - times[first + k] for k in range(3)], axis=0)
    return value, (longest <= CLOCK_GAP) & (times[0] <= wanted) & (wanted <= times[-1])


def _likely_step(left: Array) -> int:
    """The row from which on a step explains most of the gaps, shape (n, 3), in their sigmas."""
    count = np.arange(1, len(left))
    sums = np.cumsum(left - left.mean(axis=0), axis=0)[:-1]
    return 1 + int(np.argmax(np.sum(sums**2, axis=1) / (count * count[::-1])))


def _scatter(left: Array) -> float:
    """Variance of the gaps, shape (n, 3), in their own, as many times as neighbours are alike."""
    total, alike = max(float(np.sum(left**2)), 1e-30), 1.0
    for lag in range(1, min(len(left) // 2, 500)):
        share = float(np.sum(left[lag:] * left[:-lag])) / total
        if share < 1.5 / np.sqrt(left.size):
            break
        alike += 2.0 * share
    return alike * max(1.0, total / (left.size - 17))
