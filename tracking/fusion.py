"""One pose of the platform from several cameras, and from cameras and drives.

Encoders give the pose every cycle, smoothly, but off by whatever cable lengths are off; a camera
gives it now and then, where the platform truly is. So their difference is filtered: it changes
slowly, as geometry errors change along the way. The fused pose is that of the drives, moved by it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.pose import (
    Array,
    Pose,
    interpolate,
    matrix_from_rotation_vector,
    read_only,
    rotation_vector_from_matrix,
)
from tracking.measurement import NoPose, Observation, PoseMeasurement, extrapolate
from tracking.pose_log import LoggedPicture

#: What lens, place and tags may make a camera's poses err by where that is not stated, and what is
#: always allowed for, [m] and [rad].
PLACE = np.array([0.5e-3] * 3 + [np.radians(0.05)] * 3)
#: Poses that differ by more (squared, in covariances) disagree: of cameras, or of drives and a
#: camera. One pair of true ones in ten thousand does.
GATE = 27.9


class MultiCameraFusion:
    """The pose of all cameras, moment after moment.

    Images of one moment are taken a little apart in time. Each pose is carried on to the newest
    one's time, as the same camera saw the platform go. One whose camera saw nothing shortly
    before is left out, as the platform's speed is unknown: the newest pose always counts.
    """

    def __init__(self, within: float) -> None:
        """Nothing was seen yet.

        Args:
            within: An image that was taken farther than this from the median time of a moment's
                images is not taken together with the others, [s].
        """
        self.apart = 0
        """In how many moments a pose was left out for that."""
        self.without_speed = 0
        """In how many a pose was left out as its camera could not carry it on."""
        self._within = within
        self._before: dict[str, PoseMeasurement] = {}

    def of(self, seen: Mapping[str, Observation]) -> Observation:
        """The pose of a moment, as `together` finds it.

        Args:
            seen: What each camera measured, by its name, in the order of the cameras; not empty.
        """
        poses = {name: one for name, one in seen.items() if isinstance(one, PoseMeasurement)}
        if not poses:
            return together(seen)
        near = self._near(poses)
        newest = max(one.time for one in near.values())
        carried = {n: extrapolate(one, self._before.get(n), newest) for n, one in near.items()}
        at_newest = {name: one for name, one in carried.items() if one is not None}
        self._before |= poses
        self.apart += len(near) < len(poses)
        self.without_speed += len(at_newest) < len(near)
        return together(at_newest)

    def _near(self, poses: Mapping[str, PoseMeasurement]) -> Mapping[str, PoseMeasurement]:
        """Those taken about the median time; the newest where none was: no camera comes first."""
        middle = float(np.median([one.time for one in poses.values()]))
        near = {n: one for n, one in poses.items() if abs(one.time - middle) <= self._within}
        newest = max(poses, key=lambda name: poses[name].time)
        return near or {newest: poses[newest]}


def together(seen: Mapping[str, Observation]) -> Observation:
    """The mean of all poses, each by the weight of its information.

    Of three cameras and more one that disagrees with the others is left out; of two that disagree
    it is unknown which is wrong.

    Args:
        seen: What each camera measured, by its name; all poses are of one time.
    """
    poses = {name: one for name, one in seen.items() if isinstance(one, PoseMeasurement)}
    if not poses:
        return _nothing(seen)
    while len(poses) > 1:
        apart = {name: _apart(name, poses) for name in poses}
        worst = max(apart, key=lambda name: apart[name])
        if apart[worst] <= GATE:
            break
        if len(poses) == 2:
            a, b = poses.values()
            gap = a.pose.distance_to(b.pose) * 1e3
            names = " and ".join(poses)
            return NoPose(a.time, f"cameras {names} disagree by {gap:.1f} mm", ())
        del poses[worst]
    return _mean(list(poses.values()))


def _nothing(seen: Mapping[str, Observation]) -> NoPose:
    missed = {name: one for name, one in seen.items() if isinstance(one, NoPose)}
    reasons = "; ".join(f"{name}: {one.reason}" for name, one in missed.items())
    tags = sorted({number for one in missed.values() for number in one.seen})
    return NoPose(next(iter(missed.values())).time, reasons, tuple(tags))


def _apart(name: str, poses: Mapping[str, PoseMeasurement]) -> float:
    """How far a pose lies from the others, squared, in covariances: the median of them."""
    mine, distances = poses[name], []
    for other in (one for key, one in poses.items() if key != name):
        gap = _between(mine.pose, other.pose)
        spread = mine.covariance + other.covariance + mine.shared + other.shared
        spread = spread + 2.0 * np.diag(PLACE**2)
        distances.append(float(gap @ np.linalg.solve(spread, gap)))
    return float(np.median(distances)) if len(distances) > 1 else distances[0]


def _between(first: Pose, second: Pose) -> Array:
    """Shift [m] and turn [rad], world axes, that lead from one pose to the other, shape (6,)."""
    turn = rotation_vector_from_matrix(second.rotation @ first.rotation.T)
    return np.concatenate([second.position - first.position, turn])


def _mean(poses: list[PoseMeasurement]) -> PoseMeasurement:
    first = poses[0]
    if len(poses) == 1:
        return first
    weights = [np.linalg.inv(one.covariance) for one in poses]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    steps = [w @ _between(first.pose, one.pose) for w, one in zip(weights, poses, strict=True)]
    step = covariance @ np.sum(steps, axis=0)
    turned = matrix_from_rotation_vector(step[3:]) @ first.pose.rotation
    return replace(
        first,
        pose=Pose(first.pose.position + step[:3], turned),
        covariance=read_only((covariance + covariance.T) / 2.0),
        tags=tuple(sorted({number for one in poses for number in one.tags})),
        reprojection=float(np.sqrt(np.mean([one.reprojection**2 for one in poses]))),
        shared=_shared(poses, [covariance @ weight for weight in weights]),
        unstated=any(one.unstated for one in poses),
        cable_error=max(one.cable_error for one in poses),
    )


def _shared(poses: Sequence[PoseMeasurement], parts: Sequence[Array]) -> Array:
    """What the cameras' places and the tags make the mean err by, shape (6, 6).

    Places that were found by the same tags err together, by an unknown amount: the square of a
    sum of n errors is n times the sum of their squares at most.
    """
    total = np.zeros((6, 6))
    for one, part in zip(poses, parts, strict=True):
        total += part @ one.shared @ part.T
    return read_only(len(poses) * total)


# Which pictures of several cameras belong to one moment.


def moments(
    streams: Mapping[str, Iterator[LoggedPicture]], within: float
) -> Iterator[dict[str, LoggedPicture]]:
    """Puts the images of all cameras in order of time, those of one moment together.

    A moment has the oldest image that is left and, of each other camera, the one nearest to it:
    taken no later than ``within`` after it, and nearer to the images of this moment than to
    those that follow them.

    Args:
        streams: What each camera measured, by its name, each in order of time.
        within: See above, [s].

    Returns:
        By the cameras' names, in their order; each image in one moment, until all streams end.
    """
    queues: dict[str, deque[LoggedPicture]] = {name: deque() for name in streams}
    open_streams = dict(streams)
    while True:
        # Round after round, so that live cameras are read in turn: no one's two images in a row.
        for wanted in (1, 2):
            for name in [n for n in open_streams if len(queues[n]) < wanted]:
                picture = next(open_streams[name], None)
                if picture is None:
                    del open_streams[name]
                else:
                    queues[name].append(picture)
        if not any(queues.values()):
            return
        members = _of_one_moment(queues, within)
        yield {name: queues[name].popleft() for name in queues if name in members}


def _of_one_moment(queues: Mapping[str, deque[LoggedPicture]], within: float) -> list[str]:
    """The cameras whose oldest images belong together, the oldest first."""
    by_age = sorted((n for n, queue in queues.items() if queue), key=lambda n: _time(queues[n][0]))
    members = by_age[:1]
    for name in by_age[1:]:
        time = _time(queues[name][0])
        if time - _time(queues[members[0]][0]) > within:
            break
        if any(_is_nearer_to_the_next(queues[member], time) for member in members):
            break
        members.append(name)
    return members


def _is_nearer_to_the_next(queue: deque[LoggedPicture], time: float) -> bool:
    return len(queue) > 1 and _time(queue[1]) - time < time - _time(queue[0])


def _time(picture: LoggedPicture) -> float:
    return picture.observation.time


# Drives and camera together.


#: How fast the difference wanders: 0.3 mm and 0.05° in a second.
WANDER = np.array([3e-4] * 3 + [np.radians(0.05)] * 3)
#: What drives are off by from cycle to cycle, [m] and [rad].
DRIVE_NOISE = np.array([5e-5] * 3 + [np.radians(0.01)] * 3)
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
