"""The platform's pose from drives and camera together.

Encoders give the pose every cycle, smoothly, but off by whatever cable lengths are off; a camera
gives it now and then, where the platform truly is. So their difference is filtered: it changes
slowly, as geometry errors change along the way. The fused pose is that of the drives, moved by it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.pose import (
    Array,
    Pose,
    interpolate,
    matrix_from_rotation_vector,
    read_only,
    rotation_vector_from_matrix,
)

#: How fast the difference wanders: 0.3 mm and 0.05° in a second.
WANDER = np.array([3e-4] * 3 + [np.radians(0.05)] * 3)
#: What drives are off by from cycle to cycle, [m] and [rad].
DRIVE_NOISE = np.array([5e-5] * 3 + [np.radians(0.01)] * 3)
#: A measurement farther off than this (squared, in covariances) is an outlier; one true measurement
#: in ten thousand is.
GATE = 27.9
#: After this many outliers in a row it is the difference that is wrong.
OUTLIERS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A pose that a camera measured.

    Attributes:
        time: [s].
        pose: ``world_from_platform``.
        covariance: Of position [m] and rotation vector [rad], world axes, shape (6, 6).
    """

    time: float
    pose: Pose
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """A pose from both.

    Attributes:
        time: Of the drives' pose, [s].
        pose: ``world_from_platform``.
        covariance: As `Measured` has it.
        age: Time since the last measurement that was used, [s].
    """

    time: float
    pose: Pose
    covariance: Array
    age: float


def fused(
    times: Sequence[float], by_drives: Sequence[Pose], measured: Sequence[Measured]
) -> Iterator[Fused]:
    """Fused poses at the times of the drives, from the first measurement on.

    Measurements are compared with the drives' pose at their own time, between two of their poses.

    Args:
        times: Of the drives' poses, rising, [s].
        by_drives: ``world_from_platform`` of forward kinematics.
        measured: In order of time; those before the drives' first pose are left out.
    """
    estimate: _Difference | None = None
    waiting = [m for m in measured if times and times[0] <= m.time]
    for number, (time, pose) in enumerate(zip(times, by_drives, strict=True)):
        while waiting and waiting[0].time <= time:
            one = waiting.pop(0)
            there = _at(times, by_drives, number, one.time)
            estimate = (
                _Difference.first(one, there) if estimate is None else estimate.after(one, there)
            )
        if estimate is not None:
            yield estimate.applied(pose, time)


def _at(times: Sequence[float], poses: Sequence[Pose], number: int, time: float) -> Pose:
    """The drives' pose at a time between that of ``number`` and the one before."""
    if number == 0 or times[number] <= times[number - 1]:
        return poses[number]
    share = (time - times[number - 1]) / (times[number] - times[number - 1])
    return interpolate(poses[number - 1], poses[number], share)


def _between(by_drives: Pose, measured: Pose) -> Array:
    """Shift [m] and turn [rad], world axes, that lead from one pose to the other, shape (6,)."""
    turn = rotation_vector_from_matrix(measured.rotation @ by_drives.rotation.T)
    return np.concatenate([measured.position - by_drives.position, turn])


@dataclass(frozen=True, slots=True, eq=False)
class _Difference:
    """What leads from the drives' pose to the true one, as far as it is known at a time."""

    time: float
    mean: Array  # (6,)
    covariance: Array  # (6, 6)
    used: float  # time of the last measurement that was no outlier
    outliers: int

    @classmethod
    def first(cls, measured: Measured, by_drives: Pose) -> _Difference:
        covariance = measured.covariance + np.diag(DRIVE_NOISE**2)
        mean = _between(by_drives, measured.pose)
        return cls(measured.time, mean, covariance, measured.time, 0)

    def after(self, measured: Measured, by_drives: Pose) -> _Difference:
        """With a further measurement, unless it is an outlier."""
        wandered = self._wandered(measured.time)
        noise = measured.covariance + np.diag(DRIVE_NOISE**2)
        new = _between(by_drives, measured.pose) - self.mean
        spread = wandered + noise
        if float(new @ np.linalg.solve(spread, new)) > GATE:
            if self.outliers + 1 >= OUTLIERS:
                return _Difference.first(measured, by_drives)
            return _Difference(measured.time, self.mean, wandered, self.used, self.outliers + 1)
        gain = np.linalg.solve(spread, wandered).T
        covariance = (np.eye(6) - gain) @ wandered
        covariance = (covariance + covariance.T) / 2.0
        return _Difference(measured.time, self.mean + gain @ new, covariance, measured.time, 0)

    def applied(self, by_drives: Pose, time: float) -> Fused:
        """The drives' pose, moved by the difference."""
        turn = matrix_from_rotation_vector(self.mean[3:])
        pose = Pose(by_drives.position + self.mean[:3], turn @ by_drives.rotation)
        covariance = self._wandered(time) + np.diag(DRIVE_NOISE**2)
        return Fused(time, pose, read_only(covariance), time - self.used)

    def _wandered(self, time: float) -> Array:
        return np.asarray(self.covariance + np.diag(WANDER**2) * max(0.0, time - self.time))
