"""Measurement of the platform in one image, its acceptance tests, and its extrapolation in time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np

from model.cameras import Z_95
from model.pose import (
    Array,
    Pose,
    interpolate,
    matrix_from_rotation_vector,
    points_by_twist,
    read_only,
    rotation_vector_from_matrix,
)

if TYPE_CHECKING:
    from model.rig import Rig
    from tracking.pnp import BundlePose, TagView

MOST_TURN = math.radians(80.0)
"""Largest rotation from the home pose that is measured; wrong poses are mostly beyond it."""


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Acceptance limits of a pose, and the camera check.

    Attributes:
        reprojection_px: Largest RMS error of the corners in the image, beside that from the stated
            error of the tags.
        view_angle: Largest angle between line of sight and a tag's normal, [rad].
        position_deviation: Largest standard deviation of the position along any direction, [m].
        jump: Largest distance from the last pose beyond what `speed` allows, [m].
        jump_angle: Largest rotation from the last pose, [rad].
        speed: Largest expected speed of the platform, [m/s]; 1.5 times the rig's if that is more.
        turn: Largest rotation from the home pose, [rad].
        single_tag_margin: Required cost difference to the mirror pose, in variances, of the pose of
            a single tag, or of several in one plane.
        contradiction: Largest misfit of the edges: their mean squared error, in variances of edges
            and of the tags' error. In good images it is about 1.
        doubt: The same where more than `left_out_share` of the edges were left out.
        left_out_share: Share of edges that may be left out, [1].
        camera_moved_px: Error of frame tags in the image above which the camera counts as moved,
            beside that from the stated error of its pose.
        camera_check_period: Images between checks of the camera.
    """

    reprojection_px: float = 0.5
    view_angle: float = float(np.radians(76.0))
    position_deviation: float = 0.003
    jump: float = 0.03
    jump_angle: float = 0.25
    speed: float = 0.2
    turn: float = MOST_TURN
    single_tag_margin: float = 30.0
    contradiction: float = 7.0
    doubt: float = 2.0
    left_out_share: float = 0.25
    camera_moved_px: float = 1.0
    camera_check_period: int = 10


def largest_deviations(covariance: Array) -> tuple[float, float]:
    """Standard deviations of position [m] and rotation [rad] along their worst directions.

    Args:
        covariance: Of position and rotation vector, shape (6, 6), [m, rad].
    """
    position, turn = (np.linalg.norm(covariance[k : k + 3, k : k + 3], 2) for k in (0, 3))
    return math.sqrt(position), math.sqrt(turn)


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """A measured pose of the platform.

    Attributes:
        time: Of the image, [s].
        pose: ``world_from_platform``.
        covariance: Of position [m] and rotation vector [rad] along the world's axes, shape (6, 6).
            From the scatter of the corners, without errors of extrinsics and tags.
        tags: Numbers of the tags used.
        reprojection: RMS error of their corners, [px].
        status: ``found`` (in the whole image), ``tracked`` (near the last pose) or ``guided`` (at
            the encoder pose).
        shared: As `covariance`, of the errors common to all images, from lens, extrinsics and tags,
            as far as calibrations or the rig file state them.
        unstated: Whether a part of these is not stated.
        at_rest: ``world_from_platform`` as for a global shutter; None if the camera has one.
        cable_error: Error of cables, 95 %, if the operator's value replaces stated errors, [m].
    """

    time: float
    pose: Pose
    covariance: Array
    tags: tuple[int, ...]
    reprojection: float
    status: str
    shared: Array = field(default_factory=lambda: np.zeros((6, 6)))
    unstated: bool = True
    at_rest: Pose | None = None
    cable_error: float = 0.0

    @property
    def uncorrected(self) -> Pose:
        """The pose without rolling-shutter correction."""
        return self.at_rest or self.pose

    @property
    def position_deviation(self) -> Array:
        """Standard deviations of the position, world axes, shape (3,), [m]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def rotation_deviation(self) -> Array:
        """Standard deviations of the rotation vector, world axes, shape (3,), [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


@dataclass(frozen=True, slots=True)
class NoPose:
    """An image without a pose.

    Attributes:
        time: Of the image, [s].
        reason: Why there is none.
        seen: Numbers of the detected tags of the rig's family.
    """

    time: float
    reason: str
    seen: tuple[int, ...] = ()


Observation = PoseMeasurement | NoPose


# Extrapolation at constant velocity.


#: Longest time over which motion is extrapolated, [s].
MEMORY = 0.5


def predict(last: PoseMeasurement, before: PoseMeasurement | None, time: float) -> Pose:
    """The pose at a time, extrapolated with the velocity between two measurements.

    Args:
        before: The one before it, if there is one.
        time: Of the prediction, [s].
    """
    if before is None:
        return last.pose
    between, ahead = last.time - before.time, time - last.time
    if not (0.0 < between <= MEMORY and 0.0 < ahead <= MEMORY):
        return last.pose
    share = ahead / between
    turn = rotation_vector_from_matrix(last.pose.rotation @ before.pose.rotation.T)
    position = last.pose.position + share * (last.pose.position - before.pose.position)
    return Pose(position, matrix_from_rotation_vector(share * turn) @ last.pose.rotation)


def extrapolate(
    last: PoseMeasurement, before: PoseMeasurement | None, time: float
) -> PoseMeasurement | None:
    """A measurement extrapolated to a later time, with its covariance.

    Args:
        before: The one before it by the same camera, if there is one.
        time: Of the result, [s]; not before the measurement's own.

    Returns:
        None if the velocity is unknown.
    """
    if time == last.time:
        return last
    pose = predict(last, before, time)
    if before is None or pose is last.pose:
        return None
    share = (time - last.time) / (last.time - before.time)
    covariance = (1.0 + share) ** 2 * last.covariance + share**2 * before.covariance
    return replace(last, time=time, pose=pose, covariance=read_only(covariance))


def rates(pictures_per_second: float | None, measuring_ms: float | None, tags: int) -> str:
    """Live figures: frame rate, measuring time, number of detected tags."""
    fast = "–" if pictures_per_second is None else f"{pictures_per_second:.1f}"
    long = "–" if measuring_ms is None else f"{measuring_ms:.1f}"
    return f"{fast} images/s, {long} ms, {tags} tag{'' if tags == 1 else 's'}"


# Frame rate and measuring time.


#: Number of the newest images for live figures.
NEWEST = 10


class FrameRate:
    """Frame rate and measuring time of the newest images."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=NEWEST)
        self._seconds: deque[float] = deque(maxlen=NEWEST)

    def take(self, time: float, seconds: float) -> None:
        """Adds an image.

        Args:
            time: On a monotonic clock, [s].
            seconds: Measuring time, [s]; NaN if nothing was measured.
        """
        self._times.append(time)
        self._seconds.append(seconds)

    @property
    def pictures_per_second(self) -> float | None:
        """Frame rate, [Hz]; None before there are two images."""
        took = self._times[-1] - self._times[0] if self._times else 0.0
        return round((len(self._times) - 1) / took, 1) if took > 0.0 else None

    @property
    def measuring_ms(self) -> float | None:
        """Median measuring time, [ms]; None if nothing was measured."""
        known = [one for one in self._seconds if np.isfinite(one)]
        return round(float(np.median(known)) * 1e3, 2) if known else None

    def text(self, tags: int) -> str:
        """As in `rates`."""
        return rates(self.pictures_per_second, self.measuring_ms, tags)


# Acceptance tests of a pose.


UNCERTAIN = "the position's uncertainty is"
"""Message about a pose from edges that are too soft, too few or too far away."""
UNSHARP = "cannot be measured: they are too blurred, or something lies along them"
"""Message about tags that are decoded, but whose edges are not found."""
SEEN_TWICE = "seen more than once"
"""Message about tags with a second print in view, if it is unknown which is the platform's."""
ROTATED = "from the home pose, the limit is"
"""Message about a platform that is rotated too far to be measured."""
CONTRADICT = "its tags contradict each other"
"""Message about tags that are not where the rig file has them."""
CAUSE = (
    "compare size_mm (prints are often scaled to the page), id and pose of its tags with the rig"
    " file"
)
"""Likely cause of it."""
UNEVEN = (
    "look for something along an edge, a margin cut off, a bent or smudged print, or a wrong lens"
    " calibration"
)
"""Likely cause of edges of one tag that do not fit each other: its size, id and pose are not."""


def rejection_reason(
    limits: TrackerSettings,
    views: Sequence[TagView],
    bundle: BundlePose,
    prior: Pose | None,
    measured: int,
    expected: float,
    elsewhere: Sequence[int],
) -> str:
    """Why a pose is rejected; empty when it is accepted.

    Args:
        bundle: The pose, in the camera frame.
        prior: Pose expected from camera measurements, in the same frame; it resolves mirror poses.
        measured: Number of edges found on these tags and on those that were left out.
        expected: Squared error of an edge with that of the tags on the platform, in variances.
        elsewhere: Numbers of tags on the platform that are not where the pose puts them.
    """
    used, edges = ", ".join(str(view.tag.id) for view in views), edge_count(views)
    if len(elsewhere) >= len(views):
        others = ", ".join(map(str, elsewhere))
        return f"{CONTRADICT}: {others} against {used}; {CAUSE}"
    if bundle.freedom == 0:
        return f"only {edges} edges of tags {used} are measured: any three fit a pose exactly"
    left_out = measured - edges
    misfit = bundle.cost / max(1, bundle.freedom) / expected
    some_left_out = left_out > limits.left_out_share * measured
    if misfit > (limits.doubt if some_left_out else limits.contradiction):
        out = f", with {left_out} of {measured} left out" if left_out else ""
        what, cause = (f"{CONTRADICT}: the misfit of their edges", CAUSE)
        if len(views) == 1 and not elsewhere:
            what, cause = f"the edges of tag {used} form no square: their misfit", UNEVEN
        return f"{what} is {misfit:.0f} times the expected one{out}; {cause}"
    if bundle.reprojection > limits.reprojection_px:
        limit = f"the limit is {limits.reprojection_px:g} px"
        return f"the reprojection error is {bundle.reprojection:.2f} px, {limit}"
    is_ambiguous = bundle.second_best_cost - bundle.cost < limits.single_tag_margin
    if is_ambiguous and not bundle.is_expected(prior):
        alone = f"tag {used} is" if len(views) == 1 else f"tags {used} in one plane are"
        return f"only {alone} detected, which allows two poses"
    largest, _ = largest_deviations(bundle.covariance)
    if not largest <= limits.position_deviation:
        doubt = ""
        if bundle.without_one.any():
            doubt = f"one of the four edges of tags {used} is wrong, and any may be it: "
        return (
            f"{doubt}{UNCERTAIN} {largest * 1e3:.1f} mm,"
            f" the limit is {limits.position_deviation * 1e3:g} mm"
        )
    return ""


def edge_count(views: Sequence[TagView]) -> int:
    """Number of measured edges."""
    return sum(int(view.seen.edges.sum()) for view in views)


# Comparison of cameras, of which the sources may be exchanged.


def pose_gap(a: Pose, b: Pose) -> float:
    """Distance of two poses, 1 at 50 mm or 2°: errors of a rig file explain no more."""
    return max(a.distance_to(b) / 0.05, float(np.degrees(a.angle_to(b))) / 2.0)


def exchanged_cameras(rig: Rig, found: Mapping[str, Observation]) -> tuple[str, str] | None:
    """Two cameras whose poses of the platform agree only if their images are exchanged."""
    poses = {name: one.pose for name, one in found.items() if isinstance(one, PoseMeasurement)}
    for one, other in combinations((c for c in rig.cameras if c.name in poses), 2):
        a, b = poses[one.name], poses[other.name]
        other_from_one = other.world_from_camera.compose(one.world_from_camera.inverse())
        by_other, by_one = other_from_one.compose(a), other_from_one.inverse().compose(b)
        if pose_gap(a, b) > 1.0 >= pose_gap(by_other, by_one):
            return one.name, other.name
    return None


# Comparison with the plan and the encoders along a run.


#: Consecutive images off both poses that are reported.
OFF_IMAGES = 10
_CHI_95 = 2.7955  # of three dimensions: 95 % of errors are within that many deviations


class PoseHistory:
    """The newest planned and encoder poses of the platform, between which images are taken."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Pose | None, Pose | None]] = deque(maxlen=100)

    def add(self, time: float, planned: Pose | None, encoder: Pose | None) -> None:
        """Takes the next poses; None where they are unknown."""
        self._poses.append((time, planned, encoder))

    def at(self, time: float) -> tuple[Pose | None, Pose | None]:
        """Both poses at a time [s]; None if they are unknown there."""
        for (start, *first), (end, *second) in pairwise(self._poses):
            if start <= time <= end:
                share = (time - start) / (end - start) if end > start else 0.0
                planned, encoder = (
                    interpolate(a, b, share) if a is not None and b is not None else None
                    for a, b in zip(first, second, strict=True)
                )
                return planned, encoder
        return None, None


class PoseMonitor:
    """Detects that the platform is neither at its planned nor at its encoder pose.

    Drives may lag behind the plan at high speed, and tensions of an uncalibrated rig may shift the
    encoder pose, so one of them must be as measured, within what errors explain. The platform's
    origin and its anchors are compared, so rotations count as well.
    """

    def __init__(self, anchors: Array, tolerance: float, platform_error: float) -> None:
        """Starts without an image.

        Args:
            anchors: Platform frame, shape (m, 3), [m].
            tolerance: Difference that the drives are allowed, [m].
            platform_error: Of the position by cable lengths along any axis, 95 %, [m].
        """
        self._points = np.vstack([np.zeros(3), anchors])
        self._tolerance, self._platform = tolerance, (platform_error / Z_95) ** 2 * np.eye(3)
        self._images = 0

    def take(self, measured: PoseMeasurement, planned: Pose | None, encoder: Pose | None) -> str:
        """How far the last `OFF_IMAGES` images are off, once; else empty.

        Args:
            planned: At the time of the image; None beside the path.
            encoder: Then; None where it is unknown.
        """
        if self._images >= OFF_IMAGES or measured.unstated or planned is None:
            return ""
        arms = self._points @ measured.pose.rotation.T
        points = measured.pose.position + arms
        by_pose = points_by_twist(arms)
        covariance = by_pose @ (measured.covariance + measured.shared) @ by_pose.swapaxes(1, 2)
        largest = np.linalg.norm(covariance + self._platform, 2, axis=(1, 2))
        explained = self._tolerance + _CHI_95 * np.sqrt(largest)
        off = [
            np.linalg.norm(points - pose.apply(self._points), axis=1)
            for pose in (planned, encoder)
            if pose is not None
        ]
        is_off = all((one > explained).any() for one in off)
        self._images = self._images + 1 if is_off else 0
        if self._images < OFF_IMAGES:
            return ""
        worst = int(np.argmax(off[0] - explained))
        angle = math.degrees(measured.pose.angle_to(planned))
        return (
            f"{measured.pose.distance_to(planned) * 1e3:.1f} mm and {angle:.1f} deg from its"
            f" planned pose, in {OFF_IMAGES} images in a row: up to {off[0][worst] * 1e3:.1f} mm,"
            f" where tolerances and stated errors (95 %) explain {explained[worst] * 1e3:.1f} mm;"
            " nor is it where the drives have it"
        )
