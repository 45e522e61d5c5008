"""From pictures to poses of the platform."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpr.errors import BadInput
from cdpr.poses import Pose, read_only
from cdpr.rig import Camera, Rig, Tag
from tracking.bits import carries_tag
from tracking.bundle import BundlePose, TagView, polish_bundle, solve_bundle
from tracking.camera_check import CameraCheck, refuse_moved_camera
from tracking.consensus import Consensus, agreeing
from tracking.detector import Detection
from tracking.detectors import make_detector
from tracking.doubt import doubt
from tracking.edges import refine
from tracking.frame_tags import near_places, nearest_to, region_around
from tracking.guidance import Guidance
from tracking.marks import modules_across, tag_corners
from tracking.measurement import NoPose, Observation, PoseMeasurement
from tracking.outliers import without_outliers
from tracking.picture import Image, refuse_wrong_picture
from tracking.prediction import predicted
from tracking.projection import pixels_from_ideal, pixels_of
from tracking.settings import TrackerSettings


class Tracker:
    """Measures the platform's pose in one camera's pictures, one after the other.

    The last pose says where to look next, then the drives' positions where they are known; without
    these, or when that fails, the whole picture is searched. Tags on the frame show whether the
    camera still stands where the rig file says.

    Args:
        rig: Its tags and platform.
        camera: The camera that took the pictures.
        settings: When a pose is believed.

    Raises:
        BadInput: The rig has no tags.
    """

    def __init__(self, rig: Rig, camera: Camera, settings: TrackerSettings | None = None) -> None:
        if not rig.platform_tags:
            raise BadInput(
                "the rig has no tags on its platform, so no camera can measure it",
                where=f"rig {rig.name}",
                next_step="add a `tags` section to the rig file",
            )
        self.rig, self.camera = rig, camera
        self.settings = settings or TrackerSettings()
        self.camera_check: CameraCheck | None = None
        self._detector = make_detector(rig.tag_detector, rig.tag_family)
        self._modules = modules_across(rig.tag_family)
        self._platform = {tag.id: tag for tag in rig.platform_tags}
        self._frame = {tag.id: tag for tag in rig.frame_tags}
        # Cables pull: no platform leaves the box around the outlets by more than its own size.
        size = float(np.linalg.norm(rig.half_size))
        self._lower, self._upper = rig.outlets.min(axis=0) - size, rig.outlets.max(axis=0) + size
        self._camera_from_world = camera.world_from_camera.inverse()
        self._last: PoseMeasurement | None = None
        self._before: PoseMeasurement | None = None
        self._guidance = Guidance()
        self._pictures = 0

    @property
    def expected_tags(self) -> tuple[int, ...]:
        """Numbers of the platform's tags."""
        return tuple(self._platform)

    def forget(self) -> None:
        """Searches the whole of the next picture."""
        self._last = None

    def observe(self, image: Image, time: float, by_drives: Pose | None = None) -> Observation:
        """Measures the platform in a picture.

        Args:
            image: Grey picture of the camera's size.
            time: When it was taken, [s].
            by_drives: Where the drives' positions put the platform then; it says where to look, and
                has no part in the pose.

        Raises:
            BadInput: The picture is not a grey one of the camera's size.
            CameraMoved: The frame tags are not where they should be.
        """
        refuse_wrong_picture(image, self.camera, self.rig.name)
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
            if by_drives is not None:
                self._guidance.learn(result.pose, by_drives)
        return result

    def _follow(self, image: Image, time: float, last: PoseMeasurement) -> Observation | None:
        """The pose where it is expected, or None when it is not there.

        The edges of all tags that should be seen are looked for where they should be, which needs
        no detector and finds tags that are hidden in part.
        """
        found = self._measure(image, time, [], predicted(last, self._before, time), "tracked")
        return found if self._goes_on(found, last) else None

    def _guided(self, image: Image, time: float, expected: Pose) -> Observation | None:
        """As `_follow`, at a pose that nobody has seen.

        So it tells no pose from its mirror pose, and a tag alone is not enough: where drives are
        wrong, that may be another print of it.
        """
        views = self._looked_for(image, self._camera_from_world.compose(expected), set())
        seen = tuple(view.tag.id for view in views)
        found = self._measure_views(image, time, views, seen, None, "guided")
        return found if isinstance(found, PoseMeasurement) and len(found.tags) > 1 else None

    def _seek_around(self, image: Image, time: float, last: PoseMeasurement) -> Observation | None:
        """The pose by the tags around the platform, or None when there is none to go on with."""
        expected = predicted(last, self._before, time)
        region = region_around(self.camera, expected.apply(self.rig.platform_corners), slack=0.2)
        if region is None:
            return None
        detections = self._detector.detect_all(image, region)
        found = self._measure(image, time, detections, expected, "tracked")
        return found if self._goes_on(found, last) else None

    def _search(self, image: Image, time: float) -> Observation:
        """The pose by a search of the whole picture, once more thoroughly when it finds none."""
        found = self._searched(image, time, thorough=False)
        return self._searched(image, time, thorough=True) if isinstance(found, NoPose) else found

    def _searched(self, image: Image, time: float, thorough: bool) -> Observation:
        detections = self._detector.detect_all(image, thorough=thorough)
        self._check_camera(image, detections)
        return self._measure(image, time, detections, None, "found")

    def _goes_on(self, found: Observation, last: PoseMeasurement) -> bool:
        """Whether a pose was found that the platform can have reached."""
        if isinstance(found, NoPose):
            return False
        limit = self.settings.jump + self.settings.speed * abs(found.time - last.time)
        if found.pose.distance_to(last.pose) > limit:
            return False
        return found.pose.angle_to(last.pose) <= self.settings.jump_angle

    def _check_camera(self, image: Image, detections: Sequence[Detection]) -> None:
        views = self._views(image, nearest_to(self.camera, self._frame, detections), self._frame)
        limit = self.settings.camera_moved_px
        check = refuse_moved_camera(self.camera, views, limit)
        self.camera_check = check or self.camera_check

    def _views(
        self, image: Image, detections: Sequence[Detection], tags: dict[int, Tag]
    ) -> list[TagView]:
        """The refined squares of those detections that are among ``tags``."""
        mine = [d for d in detections if d.id in tags]
        corners = np.array([d.corners for d in mine]).reshape(-1, 4, 2)
        squares = refine(image, self.camera, corners, self._modules)
        pairs = zip(mine, squares, strict=True)
        return [TagView(tags[d.id], square) for d, square in pairs if square is not None]

    def _measure(
        self,
        image: Image,
        time: float,
        detections: Sequence[Detection],
        expected: Pose | None,
        status: str,
    ) -> Observation:
        views = self._views(image, detections, self._platform)
        seen = tuple(d.id for d in detections)
        return self._measure_views(image, time, views, seen, expected, status)

    def _measure_views(
        self,
        image: Image,
        time: float,
        views: Sequence[TagView],
        seen: tuple[int, ...],
        expected: Pose | None,
        status: str,
    ) -> Observation:
        agreed = self._agreed(views)
        if agreed.ambiguous:
            twice = ", ".join(map(str, agreed.ambiguous))
            return NoPose(time, f"tags {twice} are seen in places that do not agree", seen)
        views = list(agreed.views)
        prior = None if expected is None else self._camera_from_world.compose(expected)
        first = solve_bundle(self.camera, views, prior) if views else None
        start = prior if first is None else first.camera_from_body
        if start is None:
            return NoPose(time, self._why_nothing(seen), seen)
        views = views + self._looked_for(image, start, {v.tag.id for v in views})
        fitted = self._fitted(views, start)
        if fitted is None:
            return NoPose(time, "no tag of the platform fits a pose", seen)
        views, bundle = fitted
        reason = doubt(self.settings, views, bundle, prior)
        if reason:
            return NoPose(time, reason, seen)
        return self._measurement(time, views, bundle, status)

    def _agreed(self, views: Sequence[TagView]) -> Consensus:
        """The views that agree on a pose of the platform within its frame."""
        world_from_camera = self.camera.world_from_camera

        def possible(camera_from_platform: Pose) -> bool:
            pose = world_from_camera.compose(camera_from_platform)
            inside = np.all((pose.position >= self._lower) & (pose.position <= self._upper))
            return bool(inside) and pose.angle_to(self.rig.home) < self.settings.turn

        return agreeing(self.camera, views, possible)

    def _why_nothing(self, seen: tuple[int, ...]) -> str:
        wanted = ", ".join(map(str, self._platform))
        others = [number for number in seen if number not in self._frame]
        also = f"; seen instead: {', '.join(map(str, others))}" if others else ""
        return f"no tag of the platform ({self.rig.tag_family} {wanted}) is to be seen{also}"

    def _looked_for(self, image: Image, pose: Pose, known: set[int]) -> list[TagView]:
        """Tags that the detector missed, looked for where a pose puts them.

        A cable across the white border breaks the detector's outline, not the square's edges.
        """
        missed = [t for t in self.rig.platform_tags if t.id not in known and self._faces(t, pose)]
        rough = [pixels_of(self.camera, pose.apply(tag_corners(tag))) for tag in missed]
        squares = refine(image, self.camera, np.array(rough).reshape(-1, 4, 2), self._modules)
        views = []
        for tag, square in zip(missed, squares, strict=True):
            if square is None:
                continue
            corners = pixels_from_ideal(self.camera, square.corners)
            if carries_tag(image, corners, self.rig.tag_family, tag.id):
                views.append(TagView(tag, square))
        return views

    def _faces(self, tag: Tag, camera_from_platform: Pose) -> bool:
        """Whether the camera sees a tag's front, not too much aslant."""
        camera_from_tag = camera_from_platform.compose(tag.pose)
        away = camera_from_tag.position / np.linalg.norm(camera_from_tag.position)
        return bool(-camera_from_tag.rotation[:, 2] @ away > np.cos(self.settings.view_angle))

    def _fitted(self, views: list[TagView], start: Pose) -> tuple[list[TagView], BundlePose] | None:
        """The pose of all views, without tags seen aslant and edges that do not belong."""
        views = [view for view in views if self._faces(view.tag, start)]
        for _ in range(4):
            solve = solve_bundle if len(views) == 1 else polish_bundle  # one tag alone has a rival
            bundle = solve(self.camera, views, start) if views else None
            if bundle is None:
                return None
            kept = without_outliers(views, bundle)
            if kept is None:
                return views, bundle
            views, start = kept, bundle.camera_from_body
        return None

    def _measurement(
        self, time: float, views: list[TagView], bundle: BundlePose, status: str
    ) -> PoseMeasurement:
        turn = np.kron(np.eye(2), self.camera.world_from_camera.rotation)
        return PoseMeasurement(
            time,
            self.camera.world_from_camera.compose(bundle.camera_from_body),
            read_only(turn @ bundle.covariance @ turn.T),
            tuple(sorted(view.tag.id for view in views)),
            bundle.reprojection,
            status,
        )
