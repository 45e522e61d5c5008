"""Tracks the platform's pose through the images of one camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.cameras import Z_95
from model.errors import BadInput, real_number, require_types
from model.pose import Array, Pose, interpolate
from model.rig import Camera, Rig
from tracking.camera_model import Image, require_image_format
from tracking.detection.detector import (
    Detection,
    detect_expected,
    make_detector,
    nearest_to_expected,
    region_around,
)
from tracking.detection.diagnostics import MIRRORED, UNMIRROR, are_mirrored
from tracking.estimator import PlatformEstimator
from tracking.measurement import (
    CAUSE,
    UNEVEN,
    NoPose,
    Observation,
    PoseMeasurement,
    TrackerSettings,
    largest_deviations,
    predict,
)
from tracking.rolling_shutter import RecentMotion
from tracking.shared_errors import PERHAPS_MOVED, CameraCheck, CameraMoved, require_unmoved_camera

# Encoder prior: where to search for the platform.
#
# Encoder poses have the errors of the cable lengths, which the last camera pose reveals; from then
# on they show the platform's motion, however fast it moves and however long no tag is detected.
# The prior only sets the search region: what is found there is assessed without it.


#: Encoder poses farther apart in time do not predict the platform's motion, [s].
MEMORY = 0.5
#: The platform may exceed the rig's own speed by this factor, as when it swings.
FASTER = 1.5


class EncoderPrior:
    """Expected pose from the encoders, corrected by the last camera measurement."""

    def __init__(self) -> None:
        self._shift: Array = np.zeros(3)
        self._turn: Array = np.eye(3)

    def expected(self, by_drives: Pose) -> Pose:
        """The expected pose, ``world_from_platform``.

        Args:
            by_drives: Pose from the encoders.
        """
        return Pose(by_drives.position + self._shift, self._turn @ by_drives.rotation)

    def learn(self, measured: Pose, by_drives: Pose) -> None:
        """Updates the correction from a camera measurement.

        Args:
            measured: Pose measured by the camera.
            by_drives: Pose from the encoders at the same time.
        """
        self._shift = measured.position - by_drives.position
        self._turn = measured.rotation @ by_drives.rotation.T


def _stated_error_px(rig: Rig, camera: Camera) -> float:
    """Error of frame tags in an image, 95 %, from the stated error of the camera's pose, [px]."""
    covariance = camera.pose_covariance
    if covariance is None or not rig.frame_tags:
        return 0.0
    places = np.array([tag.pose.position for tag in rig.frame_tags])
    nearest = np.linalg.norm(places - camera.world_from_camera.position, axis=1).min()
    position, turn = largest_deviations(covariance)
    return float(Z_95 * camera.matrix[0, 0] * math.hypot(position / nearest, turn))


class EncoderExtrapolator:
    """Extrapolates the encoder pose to the time of an image."""

    def __init__(self) -> None:
        self._last: tuple[float, Pose] | None = None

    def at(self, picture: float, heard: float, pose: Pose | None) -> Pose | None:
        """The encoder pose at the image's time, at constant velocity.

        Args:
            picture: Time of the image, [s].
            heard: Time of ``pose``, [s].
            pose: ``world_from_platform`` from the encoders; None if unknown.
        """
        before, self._last = self._last, None if pose is None else (heard, pose)
        if before is None or pose is None:
            return pose
        between, ahead = heard - before[0], picture - heard
        if not (0.0 < between <= MEMORY and 0.0 < abs(ahead) <= MEMORY):
            return pose
        return interpolate(before[1], pose, 1.0 + ahead / between)


MOVING = (
    "or begin with the platform at rest: a rolling shutter is corrected once the velocity is known"
)
"""Another likely cause, of tags that contradict each other."""


class Tracker:
    """Measures the platform's pose in consecutive images of one camera.

    The search starts at the pose predicted from the last ones, then at the encoder pose if given;
    without these, or if that fails, it covers the whole image. Frame tags show whether the camera
    is still at its pose in the rig file.

    Args:
        rig: Its tags and platform.
        camera: The camera that takes the images.
        settings: Acceptance limits.

    Raises:
        BadInput: The rig has no tags, or an argument is of another type.
    """

    def __init__(self, rig: Rig, camera: Camera, settings: TrackerSettings | None = None) -> None:
        require_types((rig, Rig), (camera, Camera))
        if not rig.platform_tags:
            raise BadInput(
                "the rig has no platform tags, so no camera can measure it",
                where=f"rig {rig.name}",
                next_step="add a `tags` section to the rig file",
            )
        self.rig, self.camera = rig, camera
        self.settings = settings or TrackerSettings()
        self._detector = make_detector(rig.tag_detector, rig.tag_family)
        self._frame = {tag.id: tag for tag in rig.frame_tags}
        self._recent = RecentMotion(camera.readout)
        self._estimator = PlatformEstimator(rig, camera, self.settings, self._recent)
        self._last: PoseMeasurement | None = None
        self._before: PoseMeasurement | None = None
        self._prior = EncoderPrior()
        limit, stated = self.settings.camera_moved_px, _stated_error_px(rig, camera)
        self._moved_px = math.hypot(limit, stated)
        self._pictures = 0
        self._failed: tuple[int, CameraCheck] | None = None
        """Number of the image, and check, until one passes."""
        self._passed: tuple[int, float] | None = None
        """Number and time of the last image whose check passed."""

    @property
    def expected_tags(self) -> tuple[int, ...]:
        """Numbers of the platform's tags."""
        return tuple(tag.id for tag in self.rig.platform_tags)

    def forget(self) -> None:
        """Forgets the last pose: the next image is searched completely."""
        self._last = None

    def observe(self, image: Image, time: float, by_drives: Pose | None = None) -> Observation:
        """Measures the platform in an image.

        Args:
            image: Grey image of the camera's size.
            time: Capture time, [s].
            by_drives: Encoder pose of the platform at that time; it guides the search, but does not
                enter the measured pose.

        Raises:
            BadInput: The image is not grey, or not of the camera's size; another type; the time is
                not finite.
            CameraMoved: In two images, the frame tags are at the same wrong positions. The first of
                them, and all until a check passes, give no pose.
        """
        require_image_format(image, self.camera, self.rig.name)
        require_types(optional=[(by_drives, Pose)])
        time = real_number("time", time, "s")
        if not math.isfinite(time):
            raise BadInput(f"time must be a finite number [s], it is {time}")
        self._pictures += 1
        result: Observation | None = None
        if self._last is not None:
            result = self._follow(image, time, self._last)
        if result is None and by_drives is not None:
            result = self._guided(image, time, self._prior.expected(by_drives))
        if result is None and self._last is not None:
            result = self._search_around(image, time, self._last)
        if result is None:
            result = self._search(image, time)
        elif self._failed or self._pictures % self.settings.camera_check_period == 0:
            detections = detect_expected(self.camera, self._frame, self._detector, image)
            self._check_camera(image, time, detections)
        if self._failed is not None:
            result = NoPose(time, self._suspicion(self._failed[1]))
        if isinstance(result, NoPose) and self._is_uncorrected(time):
            for cause in (CAUSE, UNEVEN):
                reason = result.reason.replace(cause, f"{cause}, {MOVING}")
                result = replace(result, reason=reason)
        self._before, self._last = self._last, None
        if isinstance(result, PoseMeasurement):
            self._last = result
            self._recent.add(result)
            if by_drives is not None:
                self._prior.learn(result.pose, by_drives)
        return result

    def _is_uncorrected(self, time: float) -> bool:
        """Whether a rolling shutter is not corrected, since the platform's motion is unknown."""
        return self.camera.readout != 0.0 and self._recent.covariance(time) is None

    def _follow(self, image: Image, time: float, last: PoseMeasurement) -> Observation | None:
        """The pose near the predicted one, or None if it is not there.

        Searches the edges of all tags at their predicted positions, which needs no detector and
        finds partly hidden tags.
        """
        expected = predict(last, self._before, time)
        found = self._estimator.measured(image, time, [], expected, "tracked")
        return found if self._is_plausible(found, last) else None

    def _guided(self, image: Image, time: float, expected: Pose) -> Observation | None:
        """As `_follow`, at a pose from the encoders.

        It cannot exclude the mirror pose, and a single tag is not enough: if the encoders are
        wrong, it may be another print.
        """
        found = self._estimator.measured_at(image, time, expected, "guided")
        return found if isinstance(found, PoseMeasurement) and len(found.tags) > 1 else None

    def _search_around(
        self, image: Image, time: float, last: PoseMeasurement
    ) -> Observation | None:
        """The pose from tags detected around the platform, or None if it is not plausible."""
        expected = predict(last, self._before, time)
        region = region_around(self.camera, expected.apply(self.rig.platform_corners), slack=0.2)
        if region is None:
            return None
        detections = self._detector.detect_all(image, region)
        found = self._estimator.measured(image, time, detections, expected, "tracked")
        return found if self._is_plausible(found, last) else None

    def _search(self, image: Image, time: float) -> Observation:
        """The pose by detection in the whole image, exhaustive if standard detection fails."""
        standard = self._detector.detect_all(image)
        found = self._checked(image, time, standard)
        if isinstance(found, NoPose):
            exhaustive = self._detector.detect_exhaustively(image, standard)
            if len(exhaustive) > len(standard):
                return self._checked(image, time, exhaustive)
        return found

    def _checked(self, image: Image, time: float, detections: Sequence[Detection]) -> Observation:
        self._check_camera(image, time, detections)
        return self._estimator.measured(image, time, detections, None, "found")

    def _is_plausible(self, found: Observation, last: PoseMeasurement) -> bool:
        """Whether a pose was found that the platform can have reached since the last one."""
        if isinstance(found, NoPose):
            return False
        speed = max(self.settings.speed, FASTER * self.rig.motion.speed)
        limit = self.settings.jump + speed * abs(found.time - last.time)
        if found.pose.distance_to(last.pose) > limit:
            return False
        return found.pose.angle_to(last.pose) <= self.settings.jump_angle

    def _check_camera(self, image: Image, time: float, detections: Sequence[Detection]) -> None:
        views = self._estimator.views(
            image, nearest_to_expected(self.camera, self._frame, detections), self._frame
        )
        number, before = self._failed or (0, None)
        in_other_image = before if number != self._pictures else None
        try:
            check = require_unmoved_camera(
                self.camera, views, self._moved_px, in_other_image, self.rig
            )
        except CameraMoved as moved:
            if not are_mirrored(image, self._detector, (*self._frame, *self.expected_tags)):
                raise CameraMoved(
                    moved.what,
                    where=moved.where,
                    why=f"{moved.why}; {self._doubtful()}",
                    next_step=moved.next_step,
                    values=moved.values,
                ) from None
            raise CameraMoved(
                f"{MIRRORED}: they show more tags of the rig if mirrored again",
                where=f"camera {self.camera.name!r}",
                next_step=UNMIRROR,
                values=moved.values,
            ) from None
        if check is not None:
            self._failed = (self._pictures, check) if check.error > self._moved_px else None
            if self._failed is None:
                self._passed = (self._pictures, time)

    def _doubtful(self) -> str:
        """Which poses may be wrong once the camera is found to have moved."""
        if self._passed is None:
            return "no image has passed this check, so all poses are doubtful"
        number, time = self._passed
        return (
            f"image {number}, at {time:.3f} s, was the last to pass this check, so poses measured"
            " after it are doubtful"
        )

    def _suspicion(self, failed: CameraCheck) -> str:
        return (
            f"frame tags {', '.join(map(str, failed.tags))} are {failed.error:.2f} px from their"
            f" positions, limit {self._moved_px:.2f} px: {PERHAPS_MOVED}, or they are covered by"
            " others; the next image that shows them decides"
        )
