"""From images to poses of the platform."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.errors import BadInput
from model.pose import Array, Pose, interpolate
from model.rig import Camera, Rig
from tracking.camera_model import Image, require_image_format
from tracking.detection.detector import (
    Detection,
    make_detector,
    near_places,
    nearest_to,
    region_around,
)
from tracking.estimator import PlatformEstimator, TrackerSettings
from tracking.measurement import NoPose, Observation, PoseMeasurement, predicted
from tracking.rolling_shutter import RecentMotion
from tracking.shared_errors import CameraCheck, refuse_moved_camera

# Where the platform should be seen, by the positions of its drives.
#
# Drives are off by whatever cable lengths are off, so a camera's last pose shows by how much; from
# there on they show the platform's motion, however fast and however long no tag was detected.
# This sets only where to look: what is found there is judged without it.


#: Drives' poses farther apart in time than this do not predict the platform's motion, [s].
MEMORY = 0.5


class EncoderPrior:
    """Keeps by how much the drives were off when the camera saw the platform last."""

    def __init__(self) -> None:
        """It never did: the drives are taken at their word."""
        self._shift: Array = np.zeros(3)
        self._turn: Array = np.eye(3)

    def expected(self, by_drives: Pose) -> Pose:
        """Where the platform should be, ``world_from_platform``.

        Args:
            by_drives: Where the drives' positions put it.
        """
        return Pose(by_drives.position + self._shift, self._turn @ by_drives.rotation)

    def learn(self, measured: Pose, by_drives: Pose) -> None:
        """The camera saw the platform.

        Args:
            measured: Where.
            by_drives: Where the drives' positions put it at the same time.
        """
        self._shift = measured.position - by_drives.position
        self._turn = measured.rotation @ by_drives.rotation.T


class DrivesAhead:
    """The drives' pose at the time of an image, a little after they were heard or before."""

    def __init__(self) -> None:
        """They were not heard yet."""
        self._last: tuple[float, Pose] | None = None

    def at(self, picture: float, heard: float, pose: Pose | None) -> Pose | None:
        """The pose when the image was taken, if the drives go as they went.

        Args:
            picture: When it was taken, [s].
            heard: When the drives stood at ``pose``, [s].
            pose: ``world_from_platform`` by the drives; None when it is not known.
        """
        before, self._last = self._last, None if pose is None else (heard, pose)
        if before is None or pose is None:
            return pose
        between, ahead = heard - before[0], picture - heard
        if not (0.0 < between <= MEMORY and 0.0 < abs(ahead) <= MEMORY):
            return pose
        return interpolate(before[1], pose, 1.0 + ahead / between)


class Tracker:
    """Measures the platform's pose in one camera's images, one after the other.

    The last pose says where to look next, then the drives' positions where they are known; without
    these, or when that fails, the whole image is searched. Tags on the frame show whether the
    camera still stands where the rig file says.

    Args:
        rig: Its tags and platform.
        camera: The camera that took the images.
        settings: When a pose is believed.

    Raises:
        BadInput: The rig has no tags.
    """

    def __init__(self, rig: Rig, camera: Camera, settings: TrackerSettings | None = None) -> None:
        if not rig.platform_tags:
            raise BadInput(
                "the rig has no platform tags, so no camera can measure it",
                where=f"rig {rig.name}",
                next_step="add a `tags` section to the rig file",
            )
        self.rig, self.camera = rig, camera
        self.settings = settings or TrackerSettings()
        self.camera_check: CameraCheck | None = None
        self._detector = make_detector(rig.tag_detector, rig.tag_family)
        self._frame = {tag.id: tag for tag in rig.frame_tags}
        self._recent = RecentMotion(camera.readout)
        self._sight = PlatformEstimator(rig, camera, self.settings, self._recent)
        self._last: PoseMeasurement | None = None
        self._before: PoseMeasurement | None = None
        self._guidance = EncoderPrior()
        self._pictures = 0

    @property
    def expected_tags(self) -> tuple[int, ...]:
        """Numbers of the platform's tags."""
        return tuple(tag.id for tag in self.rig.platform_tags)

    def forget(self) -> None:
        """Searches the whole of the next image."""
        self._last = None

    def observe(self, image: Image, time: float, by_drives: Pose | None = None) -> Observation:
        """Measures the platform in an image.

        Args:
            image: Grey image of the camera's size.
            time: When it was taken, [s].
            by_drives: Where the drives' positions put the platform then; it says where to look, and
                has no part in the pose.

        Raises:
            BadInput: The image is not a grey one of the camera's size.
            CameraMoved: The frame tags are not where they should be.
        """
        require_image_format(image, self.camera, self.rig.name)
        self._pictures += 1
        result: Observation | None = None
        if self._last is not None:
            result = self._follow(image, time, self._last)
        if result is None and by_drives is not None:
            result = self._guided(image, time, self._guidance.expected(by_drives))
        if result is None and self._last is not None:
            result = self._seek_around(image, time, self._last)
        if result is None:
            result = self._search(image, time)
        elif self._pictures % self.settings.camera_check_period == 0:
            self._check_camera(image, near_places(self.camera, self._frame, self._detector, image))
        self._before, self._last = self._last, None
        if isinstance(result, PoseMeasurement):
            self._last = result
            self._recent.add(result)
            if by_drives is not None:
                self._guidance.learn(result.pose, by_drives)
        return result

    def _follow(self, image: Image, time: float, last: PoseMeasurement) -> Observation | None:
        """The pose where it is expected, or None when it is not there.

        The edges of all tags that should be seen are looked for where they should be, which needs
        no detector and finds tags that are hidden in part.
        """
        expected = predicted(last, self._before, time)
        found = self._sight.measured(image, time, [], expected, "tracked")
        return found if self._goes_on(found, last) else None

    def _guided(self, image: Image, time: float, expected: Pose) -> Observation | None:
        """As `_follow`, at a pose without a camera measurement.

        So it cannot exclude the mirror pose, and a tag alone is not enough: where drives are
        wrong, that may be another print of it.
        """
        found = self._sight.measured_at(image, time, expected, "guided")
        return found if isinstance(found, PoseMeasurement) and len(found.tags) > 1 else None

    def _seek_around(self, image: Image, time: float, last: PoseMeasurement) -> Observation | None:
        """The pose by the tags around the platform, or None when there is none to go on with."""
        expected = predicted(last, self._before, time)
        region = region_around(self.camera, expected.apply(self.rig.platform_corners), slack=0.2)
        if region is None:
            return None
        detections = self._detector.detect_all(image, region)
        found = self._sight.measured(image, time, detections, expected, "tracked")
        return found if self._goes_on(found, last) else None

    def _search(self, image: Image, time: float) -> Observation:
        """The pose by a search of the whole image, more thorough when that finds none."""
        plain = self._detector.detect_all(image)
        found = self._judged(image, time, plain)
        if isinstance(found, NoPose):
            thorough = self._detector.look_again(image, plain)
            if len(thorough) > len(plain):
                return self._judged(image, time, thorough)
        return found

    def _judged(self, image: Image, time: float, detections: Sequence[Detection]) -> Observation:
        self._check_camera(image, detections)
        return self._sight.measured(image, time, detections, None, "found")

    def _goes_on(self, found: Observation, last: PoseMeasurement) -> bool:
        """Whether a pose was found that the platform can have reached."""
        if isinstance(found, NoPose):
            return False
        limit = self.settings.jump + self.settings.speed * abs(found.time - last.time)
        if found.pose.distance_to(last.pose) > limit:
            return False
        return found.pose.angle_to(last.pose) <= self.settings.jump_angle

    def _check_camera(self, image: Image, detections: Sequence[Detection]) -> None:
        views = self._sight.views(
            image, nearest_to(self.camera, self._frame, detections), self._frame
        )
        limit = self.settings.camera_moved_px
        check = refuse_moved_camera(self.camera, views, limit)
        self.camera_check = check or self.camera_check
