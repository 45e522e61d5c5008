"""The platform in one image, by the squares of its tags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.pose import Array, Pose, read_only
from model.rig import Camera, Rig, Tag
from tracking.camera_model import Image, pixels_from_ideal, pixels_of
from tracking.consensus import Consensus, agreeing
from tracking.detection.decoder import carries_tag
from tracking.detection.detector import Detection
from tracking.detection.diagnostics import edge_faults
from tracking.detection.tags import modules_across, tag_corners
from tracking.edges.refine import refine
from tracking.measurement import NoPose, Observation, PoseMeasurement
from tracking.pnp import BundlePose, TagView, refine_pnp, solve_pnp
from tracking.rolling_shutter import FitByRows, RecentMotion, RollingShutter
from tracking.settings import TrackerSettings
from tracking.shared_errors import SharedErrors

# Why a pose that was found is not believed.


UNCERTAIN = "the position's uncertainty is"
"""What is said of a pose by edges that are too soft, too few or too far away."""
UNSHARP = "are too blurred to be measured"
"""What is said of tags that are read, but whose edges are not found."""


def doubt(
    limits: TrackerSettings, views: Sequence[TagView], bundle: BundlePose, prior: Pose | None
) -> str:
    """Why a pose is not believed, empty when it is.

    Args:
        limits: When poses are.
        views: The tags that it rests on.
        bundle: The pose, in the camera's frame.
        prior: Where a camera has led to expect it, in the same frame; of the two poses that a
            single tag allows the one near it is believed.
    """
    if bundle.reprojection > limits.reprojection_px:
        return (
            f"the reprojection error is {bundle.reprojection:.2f} px,"
            f" the limit is {limits.reprojection_px:g} px"
        )
    if len(views) == 1 and bundle.second_best_cost - bundle.cost < limits.single_tag_margin:
        near = prior is not None and prior.angle_to(bundle.camera_from_body) < 0.1
        if not near:
            return f"only tag {views[0].tag.id} is detected, and it allows two poses"
    largest = float(np.sqrt(np.linalg.norm(bundle.covariance[:3, :3], 2)))
    if not largest <= limits.position_deviation:
        return (
            f"{UNCERTAIN} {largest * 1e3:.1f} mm,"
            f" the limit is {limits.position_deviation * 1e3:g} mm"
        )
    return ""


# Edges that do not belong to a pose that the others agree on.


#: An edge farther off than this many times the usual error is left out.
FAR = 4.5


def without_outliers(views: list[TagView], bundle: BundlePose) -> list[TagView] | None:
    """Views without edges that lie far off beside the others, or None when all belong."""
    errors = bundle.edge_errors
    measured = np.array([view.seen.edges for view in views])
    usual = max(1.0, float(np.median(errors[measured])) / 1.18)  # of two normal errors
    off = measured & (errors > FAR * usual)
    if not off.any():
        return None
    kept = []
    for view, wrong in zip(views, off, strict=True):
        edges = view.seen.edges & ~wrong
        if edges.sum() < 2:
            continue
        keep = np.repeat(edges, 2)
        seen = replace(
            view.seen,
            edges=edges,
            whitening=read_only(view.seen.whitening * keep[:, None]),
            target=read_only(view.seen.target * keep),
        )
        kept.append(TagView(view.tag, seen))
    return kept


class PlatformEstimator:
    """Measures the platform in an image by what is seen in it, whatever images came before.

    Args:
        rig: Its tags and platform.
        camera: The camera that took the images.
        settings: When a pose is believed.
        recent: The platform's motion, for cameras whose rows are exposed one after the other.
    """

    def __init__(
        self, rig: Rig, camera: Camera, settings: TrackerSettings, recent: RecentMotion
    ) -> None:
        self._rig, self._camera, self._settings = rig, camera, settings
        self._by_rows = RollingShutter(rig, camera, recent)
        self._modules = modules_across(rig.tag_family)
        self._platform = {tag.id: tag for tag in rig.platform_tags}
        self._frame = frozenset(tag.id for tag in rig.frame_tags)
        # Cables pull: no platform leaves the box around the outlets by more than its own size.
        size = float(np.linalg.norm(rig.half_size))
        self._lower, self._upper = rig.outlets.min(axis=0) - size, rig.outlets.max(axis=0) + size
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
        """The pose by tags that the detector found, and by those that it missed.

        Args:
            image: The image.
            time: When it was taken, [s].
            detections: What the detector found; nothing when it was not asked.
            expected: Expected pose, ``world_from_platform``, to separate a pose from
                its mirror pose and to start from when nothing was detected.
            status: Of the measurement.
        """
        views = self.views(image, detections, self._platform)
        seen = tuple(d.id for d in detections)
        return self._measured(image, time, views, seen, expected, status)

    def measured_at(self, image: Image, time: float, place: Pose, status: str) -> Observation:
        """The pose by tags that are seen where ``place`` puts them; it has no other part in it."""
        views = self._looked_for(image, self._camera_from_world.compose(place), set())
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
        agreed, measured = self._agreed(views), len(views) > 0
        if agreed.ambiguous:
            twice = ", ".join(map(str, agreed.ambiguous))
            return NoPose(time, f"tags {twice} are detected at inconsistent positions", seen)
        views = list(agreed.views)
        prior = None if expected is None else self._camera_from_world.compose(expected)
        first = solve_pnp(self._camera, views, prior) if views else None
        start = prior if first is None else first.camera_from_body
        if start is None:
            return NoPose(time, self._why_nothing(seen, measured), seen)
        views = views + self._looked_for(image, start, {v.tag.id for v in views})
        by_rows: FitByRows | None = None
        if self._camera.readout == 0.0:
            fitted = self._fitted(views, start)
        else:
            by_rows = self._by_rows.fitted(time, views, start, self._fitted)
            fitted = None if by_rows is None else (by_rows.views, by_rows.bundle)
        if fitted is None:
            return NoPose(time, "no tag of the platform fits a pose", seen)
        views, bundle = fitted
        reason = doubt(self._settings, views, bundle, prior)
        faults = edge_faults(image, self._camera, [view.seen for view in views], self._modules)
        if reason or faults.unusable:
            return NoPose(time, "; ".join(filter(None, (reason, str(faults)))), seen)
        found = self._measurement(time, views, bundle, status)
        if by_rows is None:
            return found
        covariance = read_only(found.covariance + by_rows.covariance)
        return replace(found, covariance=covariance, at_rest=by_rows.at_rest)

    def _agreed(self, views: Sequence[TagView]) -> Consensus:
        """The views that agree on a pose of the platform within its frame."""
        world_from_camera = self._camera.world_from_camera

        def possible(camera_from_platform: Pose) -> bool:
            pose = world_from_camera.compose(camera_from_platform)
            inside = np.all((pose.position >= self._lower) & (pose.position <= self._upper))
            return bool(inside) and pose.angle_to(self._rig.home) < self._settings.turn

        return agreeing(self._camera, views, possible)

    def _why_nothing(self, seen: tuple[int, ...], measured: bool) -> str:
        if mine := [str(number) for number in seen if number in self._platform]:
            tags = ", ".join(mine)
            if measured:
                return f"no pose within the workspace fits tags {tags}"
            return f"the edges of tags {tags} {UNSHARP}"
        wanted = ", ".join(map(str, self._platform))
        others = [number for number in seen if number not in self._frame]
        also = f"; detected instead: {', '.join(map(str, others))}" if others else ""
        return f"no platform tag ({self._rig.tag_family} {wanted}) detected{also}"

    def _looked_for(self, image: Image, pose: Pose, known: set[int]) -> list[TagView]:
        """Tags that the detector missed, looked for where a pose puts them.

        A cable across the white border breaks the detector's outline, not the square's edges.
        """
        missed = [t for t in self._rig.platform_tags if t.id not in known and self._faces(t, pose)]
        rough = [pixels_of(self._camera, pose.apply(tag_corners(tag))) for tag in missed]
        squares = refine(image, self._camera, np.array(rough).reshape(-1, 4, 2), self._modules)
        views = []
        for tag, square in zip(missed, squares, strict=True):
            if square is None:
                continue
            corners = pixels_from_ideal(self._camera, square.corners)
            if carries_tag(image, corners, self._rig.tag_family, tag.id):
                views.append(TagView(tag, square))
        return views

    def _faces(self, tag: Tag, camera_from_platform: Pose) -> bool:
        """Whether the camera sees a tag's front, not too much aslant."""
        camera_from_tag = camera_from_platform.compose(tag.pose)
        away = camera_from_tag.position / np.linalg.norm(camera_from_tag.position)
        return bool(-camera_from_tag.rotation[:, 2] @ away > np.cos(self._settings.view_angle))

    def _fitted(self, views: list[TagView], start: Pose) -> tuple[list[TagView], BundlePose] | None:
        """The pose of all views, without tags seen aslant and edges that do not belong."""
        views = [view for view in views if self._faces(view.tag, start)]
        for _ in range(4):
            solve = solve_pnp if len(views) == 1 else refine_pnp  # one tag alone has a rival
            bundle = solve(self._camera, views, start) if views else None
            if bundle is None:
                return None
            kept = without_outliers(views, bundle)
            if kept is None:
                return views, bundle
            views, start = kept, bundle.camera_from_body
        return None

    def _covariance(self, bundle: BundlePose, views: Sequence[TagView]) -> Array:
        """Of a pose by the scatter of its edges, along the world's axes, shape (6, 6), [m, rad]."""
        turn = np.kron(np.eye(2), self._camera.world_from_camera.rotation)
        return read_only(turn @ self._shared.scatter(bundle, views) @ turn.T)

    def _measurement(
        self, time: float, views: list[TagView], bundle: BundlePose, status: str
    ) -> PoseMeasurement:
        pose = self._camera.world_from_camera.compose(bundle.camera_from_body)
        return PoseMeasurement(
            time,
            pose,
            self._covariance(bundle, views),
            tuple(sorted(view.tag.id for view in views)),
            bundle.reprojection,
            status,
            self._shared.of(pose, views),
            self._shared.unstated,
            cable_error=self._shared.whole or 0.0,
        )
