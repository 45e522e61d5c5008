"""Platform pose from several cameras, and from cameras and encoders.

Encoders give a smooth pose every cycle, but with the errors of the cable lengths; a camera gives
the true pose now and then. Their difference is filtered: it changes slowly, as geometry errors
vary along the path. The fused pose is the encoder pose corrected by the difference.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from model.cameras import Z_95
from model.pose import Array, Pose, interpolate, moved, read_only, step_between
from tracking.measurement import MEMORY, NoPose, Observation, PoseMeasurement, extrapolate
from tracking.pose_log import LoggedImage

#: Standard deviation of a camera's pose from lens, extrinsics and tags where not stated; always
#: added when poses are compared, [m] and [rad].
UNSTATED_ERROR = np.array([0.5e-3] * 3 + [np.radians(0.05)] * 3)
#: Squared Mahalanobis distance above which two poses disagree; one correct pair in ten thousand
#: exceeds it.
GATE = 27.9
#: Part of the reason for a missing pose where two cameras contradict each other.
DISAGREE = "disagree"
#: Clocks are compared from this number of frame sets on.
LEAST_FRAME_SETS = 10


class MultiCameraFusion:
    """Fuses the poses of all cameras, frame set by frame set.

    Images of one frame set are taken at slightly different times. Each pose is extrapolated to the
    newest one's time with the velocity measured by its own camera. A pose without a recent
    predecessor is dropped, as its velocity is unknown; the newest pose always counts.
    """

    def __init__(self, within: float) -> None:
        """Starts without measurements.

        Args:
            within: Images farther than this from the median time of a frame set are not fused with
                the others, [s].
        """
        self.apart = 0
        """Number of frame sets in which a pose was dropped for that."""
        self.without_speed = 0
        """Number of frame sets in which a pose was dropped because its velocity was unknown."""
        self._within = within
        self._before: dict[str, PoseMeasurement] = {}
        self._clocks: dict[tuple[str, str], ClockComparison] = {}

    def clock_remarks(self) -> list[str]:
        """One sentence for each pair of cameras whose clocks differ."""
        return [text for clocks in self._clocks.values() if (text := clocks.remark())]

    def of(self, seen: Mapping[str, Observation]) -> Observation:
        """The fused pose of a frame set, see `fuse_poses`.

        Args:
            seen: Measurement of each camera by its name, in the order of the cameras; not empty.
        """
        poses = {name: one for name, one in seen.items() if isinstance(one, PoseMeasurement)}
        if not poses:
            return fuse_poses(seen)
        near = self._near(poses)
        newest = max(one.time for one in near.values())
        carried = {n: extrapolate(one, self._before.get(n), newest) for n, one in near.items()}
        at_newest = {name: one for name, one in carried.items() if one is not None}
        self._before |= poses
        for pair in combinations(poses, 2):
            clocks = self._clocks.setdefault(pair, ClockComparison(*pair))
            clocks.add(poses[pair[0]], poses[pair[1]])
        self.apart += len(near) < len(poses)
        self.without_speed += len(at_newest) < len(near)
        return fuse_poses(at_newest)

    def _near(self, poses: Mapping[str, PoseMeasurement]) -> Mapping[str, PoseMeasurement]:
        """Poses near the median time; the newest if there is none."""
        middle = float(np.median([one.time for one in poses.values()]))
        near = {n: one for n, one in poses.items() if abs(one.time - middle) <= self._within}
        newest = max(poses, key=lambda name: poses[name].time)
        return near or {newest: poses[newest]}


def fuse_poses(seen: Mapping[str, Observation]) -> Observation:
    """The mean of all poses, weighted by the inverse of their covariances with shared errors.

    Where they disagree by more than their stated errors explain, its covariance is wider.
    Of three or more cameras, one that disagrees with the others is dropped; of two that disagree it
    is unknown which is wrong, and there is no pose.

    Args:
        seen: Measurement of each camera by its name; all poses at the same time.
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
            return NoPose(a.time, f"cameras {' and '.join(poses)} {DISAGREE} by {gap:.1f} mm", ())
        del poses[worst]
    return _mean(list(poses.values()))


def _nothing(seen: Mapping[str, Observation]) -> NoPose:
    missed = {name: one for name, one in seen.items() if isinstance(one, NoPose)}
    reasons = "; ".join(f"{name}: {one.reason}" for name, one in missed.items())
    tags = sorted({number for one in missed.values() for number in one.seen})
    return NoPose(next(iter(missed.values())).time, reasons, tuple(tags))


def _apart(name: str, poses: Mapping[str, PoseMeasurement]) -> float:
    """Median squared Mahalanobis distance of a pose from the others."""
    mine, distances = poses[name], []
    for other in (one for key, one in poses.items() if key != name):
        gap = step_between(mine.pose, other.pose)
        spread = mine.covariance + other.covariance + mine.shared + other.shared
        spread = spread + 2.0 * np.diag(UNSTATED_ERROR**2)
        distances.append(float(gap @ np.linalg.solve(spread, gap)))
    return float(np.median(distances)) if len(distances) > 1 else distances[0]


def _mean(poses: list[PoseMeasurement]) -> PoseMeasurement:
    first = poses[0]
    if len(poses) == 1:
        return first
    unstated = _unstated_covariance(poses)
    own = [one.covariance + unstated for one in poses]
    weights = np.linalg.inv([c + one.shared for c, one in zip(own, poses, strict=True)])
    parts = np.linalg.solve(weights.sum(axis=0), weights)
    step = np.einsum("nij,nj->i", parts, [step_between(first.pose, one.pose) for one in poses])
    covariance = np.einsum("nij,njk,nlk->il", parts, own, parts)
    return replace(
        first,
        pose=moved(first.pose, step),
        covariance=read_only((covariance + covariance.T) / 2.0),
        tags=tuple(sorted({number for one in poses for number in one.tags})),
        reprojection=float(np.sqrt(np.mean([one.reprojection**2 for one in poses]))),
        shared=_shared(poses, parts),
        unstated=any(one.unstated for one in poses),
        # 0 where calibrations state it: an operator's value replaces only what is not stated.
        cable_error=min(one.cable_error for one in poses),
    )


def _unstated_covariance(poses: Sequence[PoseMeasurement]) -> Array:
    """Covariance of each pose that their disagreement shows beyond the stated errors, shape (6, 6).

    It is 0 up to a disagreement that stated errors alone exceed in 5 % of images. Beyond, it is the
    least multiple of `UNSTATED_ERROR`² with which the squared Mahalanobis distances from the mean
    add up to k − 2, k their degrees of freedom: the mean of 1/χ² is 1/(k − 2), so that the squared
    error of the fused pose, in units of its covariance, is six on average.

    Source: Paule and Mandel, Journal of Research of the NBS 87 (1982), 377–385.
    """
    gaps = np.array([step_between(poses[0].pose, one.pose) for one in poses])
    stated = np.array([one.covariance + one.shared for one in poses])
    unit, freedom = np.diag(UNSTATED_ERROR**2), 6 * (len(poses) - 1)
    scale, wanted = 0.0, _chi_squared_95(freedom)
    while True:  # Newton's steps only grow, as the sum falls with the scale and is convex
        weights = np.linalg.inv(stated + scale * unit)
        mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, gaps))
        pulls = np.einsum("nij,nj->ni", weights, gaps - mean)
        total = float(np.sum((gaps - mean) * pulls))
        if not total > (1.0 + 1e-6) * wanted:
            return np.asarray(scale * unit)
        wanted = freedom - 2
        scale += (total - wanted) / float(np.sum(pulls @ unit * pulls))


def _chi_squared_95(freedom: int) -> float:
    """95 % quantile of χ², within 0.2 % from six degrees of freedom on, without loading SciPy.

    Source: Wilson and Hilferty, PNAS 17 (1931), 684–688.
    """
    share = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - share + 1.645 * np.sqrt(share)) ** 3)


def _shared(poses: Sequence[PoseMeasurement], parts: Array) -> Array:
    """Covariance of the mean from errors of lenses, extrinsics and tags, shape (6, 6).

    Extrinsics found from the same tags have correlated errors of unknown correlation. At worst the
    covariance of their sum is the sum of covariances, each divided by a share: here the shares,
    which add up to 1, are in proportion to the errors (Cauchy and Schwarz).
    """
    each = np.array([part @ one.shared @ part.T for one, part in zip(poses, parts, strict=True)])
    sizes = np.sqrt(np.einsum("nii,i->n", each, UNSTATED_ERROR**-2.0))
    some = sizes > 0.0
    return read_only(sizes.sum() * np.einsum("nij,n->ij", each[some], 1.0 / sizes[some]))


class ClockComparison:
    """Finds the offset between the clocks of two cameras from the platform's motion.

    Their disagreement is fitted by an offset and a matrix times the position, for errors of lens,
    extrinsics and tags (0 within what the poses and `UNSTATED_ERROR` state), plus a time times the
    velocity, and half its square times the acceleration.
    """

    def __init__(self, first: str, second: str) -> None:
        """Starts without poses of two cameras, given by name."""
        self._names = (first, second)
        self._newest: deque[tuple[PoseMeasurement, PoseMeasurement]] = deque()
        self._start, self._prior = np.zeros(3), np.zeros((14, 14))
        self._normal, self._sum, self._cost = np.zeros((14, 14)), np.zeros(14), 0.0
        self._count, self._speed_2, self._speed_4 = 0, 0.0, 0.0

    def add(self, first: PoseMeasurement, second: PoseMeasurement) -> None:
        """Adds the poses of a frame set; the motion at the middle one is that of its neighbours."""
        newest = self._newest
        if newest and not 0.0 < first.time - newest[-1][0].time <= MEMORY:
            newest.clear()
        newest.append((first, second))
        while len(newest) > 5 and first.time - newest[0][0].time > MEMORY:
            newest.popleft()
        if len(newest) < 5:
            return
        a, b = newest[len(newest) // 2]
        here = np.array([one.pose.position for one in (a, b)])
        velocity, acceleration = np.mean([_motion(one) for one in zip(*newest, strict=True)], 0)
        if self._count == 0:
            self._start = here[0]
            stated = (a.shared + b.shared)[:3, :3] + 2.0 * np.diag(UNSTATED_ERROR[:3] ** 2)
            self._prior[:3, :3] = np.linalg.inv(stated)
            self._prior[3:12, 3:12] = np.eye(9) / (2.0 * UNSTATED_ERROR[3] ** 2)
            self._prior[13, 13] = 0.02**-2.0  # half the square of an offset of 0.2 s
        gap = here[1] - here[0] - velocity * (b.time - a.time)
        by_position = np.kron(np.eye(3), here[0] - self._start)
        row = np.column_stack([np.eye(3), by_position, velocity, acceleration])
        weighted = row.T @ np.linalg.inv((a.covariance + b.covariance)[:3, :3])
        self._normal += weighted @ row
        self._sum += weighted @ gap
        self._cost += float(gap @ weighted[:3] @ gap)
        self._count += 1
        self._speed_2 += float(velocity @ velocity)
        self._speed_4 += float(velocity @ velocity) ** 2

    def remark(self) -> str:
        """The offset and its effect; empty if it is not significant (3σ), or below 0.5 mm."""
        if self._count < LEAST_FRAME_SETS or self._speed_2 == 0.0:
            return ""
        scale, unknown = 1.0, np.ones((14, 14))
        unknown[:3, :3] = 1e-4  # as if nothing were known about the cameras' poses
        for _ in range(2):  # then with the scatter that the first fit leaves
            covariance = np.linalg.inv(self._normal / scale + self._prior)
            fit = covariance @ self._sum / scale
            left = float(self._cost - 2.0 * fit @ self._sum + fit @ self._normal @ fit)
            scale = max(1.0, left / (3.0 * self._count))
        alone = np.linalg.inv(self._normal / scale + unknown * self._prior)
        late, (sigma, sigma_alone) = fit[12], np.sqrt([covariance[12, 12], alone[12, 12]])
        speed = np.sqrt(self._speed_4 / self._speed_2)
        if abs(late) < 3.0 * sigma or abs(late) * speed < UNSTATED_ERROR[0]:
            return ""
        earlier, later = self._names if late > 0.0 else self._names[::-1]
        perhaps = "perhaps " if abs(late) < 3.0 * sigma_alone else ""
        otherwise = ", and their poses at rest, as the velocity hardly changes" if perhaps else ""
        return (
            f"cameras {' and '.join(self._names)} {DISAGREE} by {abs(late) * speed * 1e3:.1f} mm"
            f" along the motion at {speed * 1e3:.0f} mm/s: {perhaps}images of {later} are taken"
            f" {abs(late) * 1e3:.0f} ± {np.ceil(Z_95 * sigma * 1e3):.0f} ms (95 %) later than those"
            f" of {earlier} with the same time; compare their clocks and latency_ms{otherwise}"
        )


def _motion(poses: Sequence[PoseMeasurement]) -> Array:
    """Velocity and acceleration at the middle pose of at least five by a quartic, shape (2, 3)."""
    times = np.array([one.time for one in poses]) - poses[len(poses) // 2].time
    fit = np.polynomial.polynomial.polyfit(times, [one.pose.position for one in poses], 4)
    return np.array([fit[1], 2.0 * fit[2]])


# Synchronization of images from several cameras.


def synchronize_frames(
    streams: Mapping[str, Iterator[LoggedImage]], within: float
) -> Iterator[dict[str, LoggedImage]]:
    """Yields frame sets of the images of all cameras, each image once, in order of time.

    A frame set has the oldest remaining image and, of each other camera, the nearest one: taken no
    later than ``within`` after it, and nearer to the images of this frame set than to the next
    ones.

    Args:
        streams: Measurements of each camera by its name, each in order of time.
        within: See above, [s].
    """
    queues: dict[str, deque[LoggedImage]] = {name: deque() for name in streams}
    open_streams = dict(streams)
    while True:
        # In rounds, so that live cameras are read in turn, never twice in a row.
        for wanted in (1, 2):
            for name in [n for n in open_streams if len(queues[n]) < wanted]:
                picture = next(open_streams[name], None)
                if picture is None:
                    del open_streams[name]
                else:
                    queues[name].append(picture)
        if not any(queues.values()):
            return
        members = _frame_set(queues, within)
        yield {name: queues[name].popleft() for name in queues if name in members}


def _frame_set(queues: Mapping[str, deque[LoggedImage]], within: float) -> list[str]:
    """The cameras whose oldest images form a frame set, the oldest first."""
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


def _is_nearer_to_the_next(queue: deque[LoggedImage], time: float) -> bool:
    return len(queue) > 1 and _time(queue[1]) - time < time - _time(queue[0])


def _time(picture: LoggedImage) -> float:
    return picture.observation.time


# Fusion of encoders and camera.

#: Drift of the difference: 0.3 mm and 0.05° in one second (random walk).
DRIFT = np.array([3e-4] * 3 + [np.radians(0.05)] * 3)
#: Noise of the encoder pose from cycle to cycle, [m] and [rad].
DRIVE_NOISE = np.array([5e-5] * 3 + [np.radians(0.01)] * 3)
#: After this many outliers in a row the filter restarts.
OUTLIERS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A pose measured by a camera.

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
    """A fused pose.

    Attributes:
        time: Of the encoder pose, [s].
        pose: ``world_from_platform``.
        covariance: As in `Measured`.
        age: Time since the last measurement that was used, [s].
    """

    time: float
    pose: Pose
    covariance: Array
    age: float


def fuse_with_encoders(
    times: Sequence[float], encoder: Sequence[Pose], measured: Sequence[Measured]
) -> Iterator[Fused]:
    """Fused poses at the times of the encoder poses, from the first measurement on.

    Measurements are compared with the encoder pose interpolated to their own time.

    Args:
        times: Of the encoder poses, increasing, [s].
        encoder: ``world_from_platform`` of forward kinematics.
        measured: In order of time; those before the first encoder pose are ignored.
    """
    estimate: _Difference | None = None
    waiting = [m for m in measured if times and times[0] <= m.time]
    for number, (time, pose) in enumerate(zip(times, encoder, strict=True)):
        while waiting and waiting[0].time <= time:
            one = waiting.pop(0)
            there = _at(times, encoder, number, one.time)
            estimate = estimate.after(one, there) if estimate else _Difference.first(one, there)
        if estimate is not None:
            yield estimate.applied(pose, time)


def _at(times: Sequence[float], poses: Sequence[Pose], number: int, time: float) -> Pose:
    """The encoder pose at a time between ``number`` and the one before."""
    if number == 0 or times[number] <= times[number - 1]:
        return poses[number]
    share = (time - times[number - 1]) / (times[number] - times[number - 1])
    return interpolate(poses[number - 1], poses[number], share)


@dataclass(frozen=True, slots=True, eq=False)
class _Difference:
    """Estimated difference from the encoder pose to the true pose at a time."""

    time: float
    mean: Array  # (6,)
    covariance: Array  # (6, 6)
    used: float  # time of the last measurement that was not an outlier
    outliers: int

    @classmethod
    def first(cls, measured: Measured, encoder: Pose) -> _Difference:
        covariance = measured.covariance + np.diag(DRIVE_NOISE**2)
        mean = step_between(encoder, measured.pose)
        return cls(measured.time, mean, covariance, measured.time, 0)

    def after(self, measured: Measured, encoder: Pose) -> _Difference:
        """Updated with a measurement, unless it is an outlier."""
        drifted = self._drifted(measured.time)
        noise = measured.covariance + np.diag(DRIVE_NOISE**2)
        new = step_between(encoder, measured.pose) - self.mean
        spread = drifted + noise
        if float(new @ np.linalg.solve(spread, new)) > GATE:
            if self.outliers + 1 >= OUTLIERS:
                return _Difference.first(measured, encoder)
            return _Difference(measured.time, self.mean, drifted, self.used, self.outliers + 1)
        gain = np.linalg.solve(spread, drifted).T
        covariance = (np.eye(6) - gain) @ drifted
        covariance = (covariance + covariance.T) / 2.0
        return _Difference(measured.time, self.mean + gain @ new, covariance, measured.time, 0)

    def applied(self, encoder: Pose, time: float) -> Fused:
        """The encoder pose corrected by the difference."""
        pose = moved(encoder, self.mean)
        covariance = self._drifted(time) + np.diag(DRIVE_NOISE**2)
        return Fused(time, pose, read_only(covariance), time - self.used)

    def _drifted(self, time: float) -> Array:
        return np.asarray(self.covariance + np.diag(DRIFT**2) * max(0.0, time - self.time))
