"""Platform pose in one image from the squares of its tags.

Geometry decides which squares belong to the platform: another print of a tag may be on a wall, a
table or a screen. Every square allows two poses of the body; the pose that most squares agree on is
the body's, and of a tag detected twice the square that fits it is used.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.cameras import Z_95
from model.pose import Array, Pose, read_only
from model.rig import Camera, Rig, Tag
from tracking.camera_model import Image, distort_pixels, pixels_of, project_undistorted, rms
from tracking.detection.detector import Detection
from tracking.detection.diagnostics import edge_faults
from tracking.detection.tags import (
    agrees_with_modules,
    carries_tag,
    modules_across,
    tag_corners,
    view_angle,
)
from tracking.edges.refine import refine
from tracking.measurement import (
    CAUSE,
    ROTATED,
    SEEN_TWICE,
    UNSHARP,
    NoPose,
    Observation,
    PoseMeasurement,
    TrackerSettings,
    edge_count,
    rejection_reason,
)
from tracking.pnp import (
    BundlePose,
    TagView,
    fit_inliers,
    scatter_without_one,
    solve_pnp,
    square_poses,
)
from tracking.rolling_shutter import FitByRows, RecentMotion, RollingShutter
from tracking.shared_errors import SharedErrors, displaced_tag

# Consensus: which detected squares belong to the body.


#: A square agrees with a pose if its corners in the image are this near: share of its side, [px].
AGREEMENT, LEAST_AGREEMENT = 0.15, 3.0
#: Poses closer than this are the same, [m].
SAME = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """The squares that agree on one pose.

    Attributes:
        views: At most one per tag.
        ambiguous: Numbers of the tags of two such sets, if it is unknown which is the body's; then
            there are no views.
    """

    views: list[TagView]
    ambiguous: tuple[int, ...] = ()


def find_consensus(
    camera: Camera, views: Sequence[TagView], possible: Callable[[Pose], bool]
) -> Consensus:
    """The largest set of squares that agree on one possible pose of the body.

    Args:
        views: Squares with the tags of their numbers; a tag may appear more than once.
        possible: Whether ``camera_from_body`` is a possible pose.
    """
    found: list[tuple[int, float, Pose, list[TagView]]] = []
    squares = [(view, distort_pixels(camera, view.seen.corners)) for view in views]
    for view in views:
        for pose in square_poses(camera, view):
            if possible(pose):
                fitting = _fitting(camera, squares, pose)
                misfit = sum(gap for gap, _ in fitting.values()) / max(1, len(fitting))
                found.append((len(fitting), misfit, pose, [v for _, v in fitting.values()]))
    if not found:
        return Consensus([])
    found.sort(key=lambda item: (-item[0], item[1]))
    most, _, best, members = found[0]
    chosen = {id(view) for view in members}
    for count, _, pose, others in found[1:]:
        elsewhere = not chosen & {id(view) for view in others}
        if count == most and elsewhere and pose.distance_to(best) > SAME:
            both = sorted({view.tag.id for view in (*members, *others)})
            return Consensus([], tuple(both))
    return Consensus(members)


def _fitting(
    camera: Camera, squares: Sequence[tuple[TagView, Array]], pose: Pose
) -> dict[int, tuple[float, TagView]]:
    """The best-fitting square of each tag with its misfit, where one fits a pose.

    Squares have their corners in the image, shape (4, 2), [px].
    """
    best: dict[int, tuple[float, TagView]] = {}
    for view, seen in squares:
        points = pose.apply(tag_corners(view.tag))
        if np.any(points[:, 2] < 1e-3):
            continue
        gap = float(rms(pixels_of(camera, points) - seen))
        near = gap < max(LEAST_AGREEMENT, AGREEMENT * float(rms(seen - np.roll(seen, 1, axis=0))))
        if near and (view.tag.id not in best or gap < best[view.tag.id][0]):
            best[view.tag.id] = (gap, view)
    return best


def _ambiguity(views: Sequence[TagView], ambiguous: Sequence[int]) -> str:
    """Why it is unknown which detected tags are the body's."""
    count = Counter(view.tag.id for view in views)
    twice = [number for number in ambiguous if count[number] > 1]
    several = twice or ambiguous
    tags = f"tag{'s' * (len(several) > 1)} {', '.join(map(str, several))}"
    are = "are" if len(several) > 1 else "is"
    return f"{tags} {are} {SEEN_TWICE if twice else 'detected at inconsistent positions'}"


LIKELY_TAG_ERROR = 5e-5
"""Standard deviation of a tag's corners on the platform, where none is stated, [m]."""
ONE_PRINT = 4.0
"""Variance of a single tag's shape in that of a careful print: printers scale axes unequally."""


class PlatformEstimator:
    """Measures the platform in a single image, independent of earlier images.

    Args:
        rig: Its tags and platform.
        camera: The camera that takes the images.
        settings: Acceptance limits.
        recent: The platform's motion, for cameras with a rolling shutter.
    """

    def __init__(
        self, rig: Rig, camera: Camera, settings: TrackerSettings, recent: RecentMotion
    ) -> None:
        self._rig, self._camera, self._settings = rig, camera, settings
        self._by_rows = RollingShutter(rig, camera, recent)
        self._modules = modules_across(rig.tag_family)
        self._platform = {tag.id: tag for tag in rig.platform_tags}
        self._frame = frozenset(tag.id for tag in rig.frame_tags)
        # The platform hangs between or below the outlets, after a fault and on supports outside its
        # workspace: it is in the box around outlets, workspace and home, plus its own size.
        size = float(np.linalg.norm(rig.half_size))
        reached = np.vstack(
            [rig.outlets, rig.workspace_lower, rig.workspace_upper, rig.home.position]
        )
        self._lower, self._upper = reached.min(axis=0) - size, reached.max(axis=0) + size
        self._camera_from_world = camera.world_from_camera.inverse()
        self._shared = SharedErrors(rig, camera)

    def views(
        self, image: Image, detections: Sequence[Detection], tags: dict[int, Tag]
    ) -> list[TagView]:
        """The refined squares of those detections that are among ``tags``."""
        mine = [d for d in detections if d.id in tags]
        corners = np.array([d.corners for d in mine]).reshape(-1, 4, 2)
        squares = refine(image, self._camera, corners, self._modules)
        pairs = zip(mine, squares, strict=True)
        return [TagView(tags[d.id], square) for d, square in pairs if square is not None]

    def measured(
        self,
        image: Image,
        time: float,
        detections: Sequence[Detection],
        expected: Pose | None,
        status: str,
    ) -> Observation:
        """The pose from detected tags, and from tags that the detector missed.

        Args:
            time: Capture time, [s].
            detections: Of the detector; empty if it was not run.
            expected: Expected pose, ``world_from_platform``, to resolve mirror poses, and to start
                from without detections.
            status: Status of the measurement.
        """
        views = self.views(image, detections, self._platform)
        seen = tuple(d.id for d in detections)
        return self._measured(image, time, views, seen, expected, status)

    def measured_at(self, image: Image, time: float, pose: Pose, status: str) -> Observation:
        """The pose from tags found where ``pose`` predicts them; otherwise independent of it."""
        views = self._find_predicted(image, self._camera_from_world.compose(pose), set())
        seen = tuple(view.tag.id for view in views)
        return self._measured(image, time, views, seen, None, status)

    def _measured(
        self,
        image: Image,
        time: float,
        views: Sequence[TagView],
        seen: tuple[int, ...],
        expected: Pose | None,
        status: str,
    ) -> Observation:
        detected = views
        agreed = find_consensus(self._camera, views, lambda pose: not self._impossible(views, pose))
        if agreed.ambiguous:
            return NoPose(time, _ambiguity(views, agreed.ambiguous), seen)
        views = list(agreed.views)
        prior = None if expected is None else self._camera_from_world.compose(expected)
        first = solve_pnp(self._camera, views, prior) if views else None
        start = prior if first is None else first.camera_from_body
        if start is None:
            return NoPose(time, self._no_pose_reason(seen, detected), seen)
        views = views + self._find_predicted(image, start, {v.tag.id for v in views})
        by_rows: FitByRows | None = None
        if self._camera.readout == 0.0:
            fitted = self._fitted(views, start)
        else:
            by_rows = self._by_rows.fitted(time, views, start, self._fitted)
            fitted = None if by_rows is None else (by_rows.views, by_rows.bundle)
        if fitted is None:
            return NoPose(time, self._no_fit_reason(views, start), seen)
        faced = [v for v in views if self._faces(v.tag, fitted[1].camera_from_body)]
        edges = edge_count(faced)
        views, bundle = fitted
        bundle = self._certified(image, views, bundle)
        stated = (self._rig.tag_error or 0.0) * self._scale(bundle)
        reprojection = math.hypot(self._settings.reprojection_px, stated)
        limits = replace(self._settings, reprojection_px=reprojection)
        elsewhere = self._elsewhere(detected, views, bundle)
        likely = self._expected_error(bundle)
        reason = rejection_reason(limits, views, bundle, prior, edges, likely, elsewhere)
        # A fit can end at the mirror pose of the one it began at.
        reason = reason or self._impossible(views, bundle.camera_from_body)
        faults = edge_faults(image, self._camera, [view.seen for view in views], self._modules)
        if reason or faults.unusable:
            return NoPose(time, "; ".join(filter(None, (reason, str(faults)))), seen)
        found = self._measurement(time, views, bundle, status)
        if by_rows is None:
            return found
        covariance = read_only(found.covariance + by_rows.covariance)
        return replace(found, covariance=covariance, at_rest=by_rows.at_rest)

    def _impossible(self, views: Sequence[TagView], camera_from_platform: Pose) -> str:
        """Why the platform cannot have the pose that fits tags; empty if it can."""
        pose = self._camera.world_from_camera.compose(camera_from_platform)
        fits = f"the pose that fits tags {', '.join(str(view.tag.id) for view in views)} is"
        turn, limit = np.degrees([pose.angle_to(self._rig.home), self._settings.turn])
        if not turn < limit:
            return f"{fits} {turn:.0f}° {ROTATED} {limit:g}°"
        if self._is_reached(camera_from_platform):
            return ""
        x, y, z = pose.position * 1e3
        return f"{fits} at ({x:.0f}, {y:.0f}, {z:.0f}) mm, where the platform cannot be"

    def _is_reached(self, camera_from_platform: Pose) -> bool:
        """Whether the platform can be at the position of a pose."""
        position = self._camera.world_from_camera.apply(camera_from_platform.position)
        return bool(np.all((position >= self._lower) & (position <= self._upper)))

    def _no_fit_reason(self, views: Sequence[TagView], start: Pose) -> str:
        """Why no view gives a pose near ``start``, in the camera frame."""
        limit, angles = self._settings.view_angle, [view_angle(v.tag, start) for v in views]
        if not views or min(angles) < limit:
            return f"no tag of the platform fits a pose; {CAUSE}"
        # The mirror pose of a tag seen at 80° can show it from behind, at 100°.
        seen = max(limit, min(min(angle, math.pi - angle) for angle in angles))
        return (
            f"tags {', '.join(str(view.tag.id) for view in views)} are seen"
            f" {np.degrees(seen):.0f}° from their normal, the limit is {np.degrees(limit):.0f}°"
        )

    def _no_pose_reason(self, seen: tuple[int, ...], views: Sequence[TagView]) -> str:
        if mine := [str(number) for number in seen if number in self._platform]:
            tags = ", ".join(mine)
            if not views:
                return f"the edges of tags {tags} {UNSHARP}"
            rotated = find_consensus(self._camera, views, self._is_reached).views
            fitted = solve_pnp(self._camera, rotated) if rotated else None
            why = "" if fitted is None else self._impossible(rotated, fitted.camera_from_body)
            return why or f"no pose within the workspace fits tags {tags}"
        wanted = ", ".join(map(str, self._platform))
        others = [number for number in seen if number not in self._frame]
        also = f"; detected instead: {', '.join(map(str, others))}" if others else ""
        return f"no platform tag ({self._rig.tag_family} {wanted}) detected{also}"

    def _scale(self, bundle: BundlePose) -> float:
        """Pixels of the image per metre at the platform's distance, as on the axis."""
        distance = float(np.linalg.norm(bundle.camera_from_body.position))
        return float(self._camera.matrix[0, 0]) / distance

    def _expected_error(self, bundle: BundlePose) -> float:
        """Mean squared error of an edge, in its variances, with the stated error of the tags.

        Where none is stated, that of a careful print.
        """
        likely = max((self._rig.tag_error or 0.0) / Z_95, LIKELY_TAG_ERROR) * self._scale(bundle)
        return 1.0 + likely**2 * float(np.mean(bundle.certainties))

    def _elsewhere(
        self, detected: Sequence[TagView], used: Sequence[TagView], bundle: BundlePose
    ) -> list[int]:
        """Numbers of tags that are on the platform, but not where its pose puts them.

        A detected one is on the platform if it is near one of its tags as projected: a second print
        is farther away than a tag's side.
        """
        pose = bundle.camera_from_body
        facing = [t.pose.position for t in self._rig.platform_tags if self._faces(t, pose)]
        centres = project_undistorted(self._camera, pose.apply(np.array(facing).reshape(-1, 3)))
        found = set(bundle.displaced)
        for view in detected:
            seen = view.seen.corners
            gaps = np.linalg.norm(centres - np.mean(seen, axis=0), axis=1)
            if np.any(gaps < np.linalg.norm(seen[1] - seen[0])):
                found.add(view.tag.id)
        return sorted(found - {view.tag.id for view in used})

    def _find_predicted(self, image: Image, pose: Pose, known: set[int]) -> list[TagView]:
        """Tags that the detector missed, searched at their positions predicted by a pose.

        A cable across the white border breaks the outline for the detector, but not the edges.
        """
        missed = [t for t in self._rig.platform_tags if t.id not in known and self._faces(t, pose)]
        rough = [pixels_of(self._camera, pose.apply(tag_corners(tag))) for tag in missed]
        squares = refine(image, self._camera, np.array(rough).reshape(-1, 4, 2), self._modules)
        views = []
        for tag, square in zip(missed, squares, strict=True):
            if square is None:
                continue
            corners = distort_pixels(self._camera, square.corners)
            if carries_tag(image, corners, self._rig.tag_family, tag.id):
                views.append(TagView(tag, square))
        return views

    def _faces(self, tag: Tag, camera_from_platform: Pose) -> bool:
        """Whether the camera sees a tag's front within the view angle."""
        return view_angle(tag, camera_from_platform) < self._settings.view_angle

    def _fitted(self, views: list[TagView], start: Pose) -> tuple[list[TagView], BundlePose] | None:
        """The pose from all views, without oblique and displaced tags and outlier edges."""
        views = [view for view in views if self._faces(view.tag, start)]
        displaced: tuple[int, ...] = ()
        while views and (fitted := fit_inliers(self._camera, views, start)) is not None:
            pose, limit = fitted[1].camera_from_body, self._expected_error(fitted[1])
            worst = displaced_tag(self._camera, views, pose, limit, self._settings.contradiction)
            if worst is None or len(views) == 1:
                views, bundle = fitted
                if bundle.freedom == 2:  # four edges in all
                    expected = self._shared.expected_cost(bundle, views)
                    bundle = replace(bundle, without_one=scatter_without_one(bundle, expected))
                return views, replace(bundle, displaced=displaced)
            views = [view for view in views if view is not worst]
            displaced += (worst.tag.id,)
        return None

    def _certified(self, image: Image, views: Sequence[TagView], bundle: BundlePose) -> BundlePose:
        """A pose without doubt about its four edges if they agree with the tag's inner modules.

        Then the print or the lens calibration is inaccurate, and the covariance at least that of
        the stated error of the tags, or of a careful print.
        """
        if len(views) != 1 or not bundle.without_one.any():
            return bundle
        (view,) = views
        corners, family = view.seen.corners, self._rig.tag_family
        if not agrees_with_modules(image, self._camera, corners, family, view.tag.id):
            return bundle
        least = ONE_PRINT * self._expected_error(bundle) / bundle.misfit(bundle.freedom)
        stated = read_only(bundle.stated * max(1.0, least))
        return replace(bundle, stated=stated, without_one=np.zeros((6, 6)))

    def _measurement(
        self, time: float, views: list[TagView], bundle: BundlePose, status: str
    ) -> PoseMeasurement:
        pose = self._camera.world_from_camera.compose(bundle.camera_from_body)
        turn = np.kron(np.eye(2), self._camera.world_from_camera.rotation)
        return PoseMeasurement(
            time,
            pose,
            read_only(turn @ self._shared.scatter(bundle, views) @ turn.T),
            tuple(sorted(view.tag.id for view in views)),
            bundle.reprojection,
            status,
            self._shared.of(pose, views),
            self._shared.unstated,
            cable_error=self._shared.operator_error or 0.0,
        )
