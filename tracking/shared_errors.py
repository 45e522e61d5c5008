"""Errors common to all images of a camera: lens, extrinsics, tags.

They do not average out over images, so their covariance is kept beside that of the corners'
scatter. Extrinsics found from images depend on the lens errors: too long a focal length puts the
camera too far away, but hardly moves what it measures near the tags that located it. So lens
errors are propagated through extrinsics and pose together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from model.cameras import Z_95, exchanged_sources
from model.errors import Fault
from model.pose import Array, Pose, points_by_twist, read_only, skew
from model.rig import Camera, Rig, Tag
from tracking.camera_model import (
    lever_arm_matrix,
    point_slopes,
    ray_slopes,
    rays_of,
    reprojection_errors,
    rms,
    sight_offsets,
    undistorted_slopes,
)
from tracking.clearance import missing_errors
from tracking.detection.tags import mounted_rotated, tag_corners
from tracking.measurement import pose_gap
from tracking.pnp import (
    HUBER,
    BundlePose,
    Squares,
    TagView,
    edge_sizes,
    huber_weights,
    solve_pnp,
)

_GRID = 7
"""Points along each side of the image at which a rotation is fitted to lens errors."""


class SharedErrors:
    """Covariance of the errors common to all images of a camera.

    Calibrations state them, or, if one is missing, a single value by the operator.

    Args:
        rig: Its tags.
        camera: Its lens and extrinsics.
    """

    def __init__(self, rig: Rig, camera: Camera) -> None:
        missing = missing_errors(rig, camera)
        self.unstated = bool(missing) and camera.error is None
        """Whether a part of the errors is not stated."""
        self.operator_error = camera.error if missing else None
        """The operator's value, if it replaces all other errors, cables included, [m]."""
        self._camera, self._tag_error = camera, rig.tag_error or 0.0
        self._extrinsics, self._extrinsics_by_lens = split_extrinsics(camera)
        count = 4 + camera.distortion.size
        self._lens = np.zeros((count, count))
        if camera.lens_covariance is not None:
            self._lens = camera.lens_covariance

    def of(self, pose: Pose, views: Sequence[TagView]) -> Array:
        """Covariance of position [m] and rotation vector [rad], world axes, shape (6, 6).

        Args:
            pose: The measured pose, ``world_from_platform``.
        """
        if self.operator_error is not None:
            return read_only(np.diag([(self.operator_error / Z_95) ** 2] * 3 + [0.0] * 3))
        world_from_camera = self._camera.world_from_camera
        camera_from_body = world_from_camera.inverse().compose(pose)
        by_extrinsics = lever_arm_matrix(pose.position - world_from_camera.position)
        steps = moved_by_pixels(
            self._camera,
            views,
            camera_from_body,
            np.concatenate(
                [
                    pixels_by_lens(self._camera, views),
                    self._pixels_by_tags(views, camera_from_body),
                ],
                axis=2,
            ),
        )
        steps = np.kron(np.eye(2), world_from_camera.rotation) @ steps
        count = len(self._lens)
        by_lens = steps[:, :count] + by_extrinsics @ self._extrinsics_by_lens
        by_tags = steps[:, count:]
        return read_only(
            by_extrinsics @ self._extrinsics @ by_extrinsics.T
            + by_lens @ self._lens @ by_lens.T
            + by_tags @ by_tags.T
        )

    def scatter(self, bundle: BundlePose, views: Sequence[TagView]) -> Array:
        """Covariance of a pose from the scatter of its edges, camera axes, shape (6, 6).

        A misfit of edges widens it, except for the part that stated tag errors explain: `of`
        includes them already.

        Args:
            bundle: The pose in the camera frame.
        """
        return bundle.covariance_if(self.expected_cost(bundle, views))

    def expected_cost(self, bundle: BundlePose, views: Sequence[TagView]) -> float:
        """The expected cost of a fitted pose, with the stated errors of tags."""
        if self.operator_error is not None or not self._tag_error:
            return bundle.freedom
        pose = bundle.camera_from_body
        return expected_cost(self._camera, views, pose, self._pixels_by_tags(views, pose))

    def _pixels_by_tags(self, views: Sequence[TagView], camera_from_body: Pose) -> Array:
        """Derivatives of the same by unit errors of each tag's pose, shape (t, 8, 6 t)."""
        slopes = np.zeros((len(views), 8, 6 * len(views)))
        for k, view in enumerate(views):
            shifts = camera_from_body.rotation @ tag_error_slopes(view.tag, self._tag_error)
            points = camera_from_body.apply(tag_corners(view.tag))
            by_tag = point_slopes(self._camera, points) @ shifts
            slopes[k, :, 6 * k : 6 * k + 6] = by_tag.reshape(8, 6)
        return slopes


def moved_by_pixels(camera: Camera, views: Sequence[TagView], pose: Pose, shifts: Array) -> Array:
    """Change of a fitted pose with shifts of its corners, to first order.

    Args:
        pose: ``camera_from_body`` that fits them.
        shifts: Of each tag's undistorted corners by each of k causes, shape (t, 8, k), [px].

    Returns:
        Shift [m] and rotation [rad] along the camera's axes, shape (6, k).
    """
    return _by_pixels(Squares.of(camera, views), pose, shifts)[0]


def expected_cost(camera: Camera, views: Sequence[TagView], pose: Pose, shifts: Array) -> float:
    """Expected cost of a fitted pose whose corners have known errors beside their scatter.

    Args:
        pose: ``camera_from_body`` that fits them.
        shifts: Of each tag's undistorted corners by each of k independent causes of unit variance,
            shape (t, 8, k), [px].
    """
    left = _by_pixels(Squares.of(camera, views), pose, shifts)[1]
    measured = np.array([view.seen.edges for view in views])
    scatter = max(1.0 - 3.0 / np.count_nonzero(measured), 0.0)  # the pose absorbs six errors
    variances = scatter + np.mean(np.sum(left**2, axis=1).reshape(-1, 4, 2), axis=2)[measured]
    # Mean Huber cost of a pair of normal errors of equal variance: Rayleigh's distribution.
    near = 2.0 * variances * -np.expm1(-0.5 * HUBER**2 / np.maximum(variances, 1e-12))
    beyond = 2.0 * HUBER * np.sqrt(2.0 * np.pi * variances)
    return float(np.sum(near + beyond * ndtr(-HUBER / np.sqrt(np.maximum(variances, 1e-12)))))


def _by_pixels(squares: Squares, pose: Pose, shifts: Array) -> tuple[Array, Array]:
    """Change of a pose with its corners, (6, k), and remaining edge errors, (8 t, k)."""
    slopes = squares.jacobian(pose).reshape(-1, 6)
    causes = (squares.whitening @ shifts).reshape(len(slopes), -1)
    weighted = slopes * huber_weights(squares.errors(pose))[:, None]
    steps = np.asarray(np.linalg.solve(slopes.T @ weighted, weighted.T @ causes))
    return steps, causes - slopes @ steps


def pixels_by_lens(camera: Camera, views: Sequence[TagView]) -> Array:
    """Derivatives of the undistorted corners by the n lens parameters, shape (t, 8, n)."""
    undistorted = np.concatenate([view.seen.corners for view in views])
    return undistorted_slopes(camera, undistorted).reshape(len(views), 8, -1)


def split_extrinsics(camera: Camera) -> tuple[Array, Array]:
    """Errors of a camera's pose that are independent of its lens, and those that follow from it.

    Returns:
        The covariance of the former, world axes, shape (6, 6), [m, rad]; and the derivatives of the
        pose by the n lens parameters, shape (6, n). Both are 0 where unknown.
    """
    covariance, by_lens = np.zeros((6, 6)), np.zeros((6, 4 + camera.distortion.size))
    if camera.pose_covariance is not None:
        covariance = camera.pose_covariance
    if camera.lens_covariance is None:
        return covariance, by_lens
    if camera.pose_by_lens is None:
        by_lens[3:] = implied_rotation(camera)
        return covariance, by_lens
    by_lens = camera.pose_by_lens
    return _positive(covariance - by_lens @ camera.lens_covariance @ by_lens.T), by_lens


def tag_error_slopes(tag: Tag, error: float) -> Array:
    """Corner shifts by independent unit errors of a tag's pose, shape (4, 3, 6), [m].

    The tag's shift and its rotation each contribute half of the squared corner error.

    Args:
        error: Of its corners, 95 %, RMS, [m].
    """
    arms = tag_corners(tag) - tag.pose.position
    reach = float(rms(arms))
    shift = error / Z_95 / np.sqrt(6.0)
    turn = error / Z_95 / (2.0 * reach)
    return np.asarray(points_by_twist(arms) * np.repeat([shift, turn], 3))


def implied_rotation(camera: Camera) -> Array:
    """The camera rotation that best compensates lens errors, world axes, shape (3, n).

    Extrinsics found from images with these lens errors are rotated by this.
    """
    across = np.linspace(0.0, camera.width - 1.0, _GRID)
    down = np.linspace(0.0, camera.height - 1.0, _GRID)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = rays_of(camera.lens, camera.matrix, camera.distortion, pixels)
    x, y = rays.T
    by_turn = np.stack(
        [np.column_stack([-x * y, 1.0 + x * x, -y]), np.column_stack([-1.0 - y * y, x * y, x])],
        axis=1,
    ).reshape(-1, 3)
    by_lens = ray_slopes(camera, rays).reshape(len(by_turn), -1)
    in_camera = -np.linalg.lstsq(by_turn, by_lens, rcond=None)[0]
    return np.asarray(camera.world_from_camera.rotation @ in_camera)


def _positive(matrix: Array) -> Array:
    """The nearest covariance: negative eigenvalues from rounding become 0."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(positive * np.outer(scale, scale))


# Tags that are not where a pose puts them.


#: An intact square is elsewhere if the error of an edge exceeds this many expected deviations. A
#: rolling shutter in unknown motion causes 9 of them, a size that is 1 % wrong mostly 13 or more.
ELSEWHERE = 10.0


def displaced_tag(
    camera: Camera, views: Sequence[TagView], pose: Pose, expected: float, contradiction: float
) -> TagView | None:
    """The tag with the largest errors whose square is intact, but not where a pose puts it.

    What hides an edge of a tag or is mistaken for one mostly leaves no square. A tag of another
    size, number or pose is a square: its edges fit each other at some pose, but not at this one.

    Args:
        views: Tags with all their measured edges.
        pose: ``camera_from_body``.
        expected: Squared error of an edge, in variances.
        contradiction: Limit of the misfit of a tag's own edges, in `expected`.
    """
    errors = edge_sizes(Squares.of(camera, views).errors(pose))
    off = np.any(errors > ELSEWHERE * np.sqrt(expected), axis=1)
    for index in map(int, np.argsort(-errors.sum(axis=1))):
        view = views[index]
        alone = solve_pnp(camera, [view]) if off[index] else None
        if alone is not None and alone.cost <= contradiction * expected * max(1, alone.freedom):
            return view
    return None


# Check of the camera's pose against frame tags.


PERHAPS_MOVED = "the camera moved"
"""Part of the reason for a missing pose where the last check failed."""


class CameraMoved(Fault):
    """The frame tags are not at their expected positions in the image."""

    code = "camera_moved"


@dataclass(frozen=True, slots=True, eq=False)
class CameraCheck:
    """Reprojection errors of the frame tags.

    Attributes:
        tags: Numbers of the completely visible tags.
        errors: RMS error of each tag's corners in the image, shape (t,), [px].
        distances: The same from their lines of sight, shape (t,), [m].
        gaps: Expected minus measured corners in the image, shape (t, 4, 2), [px].
    """

    tags: tuple[int, ...]
    errors: Array
    distances: Array
    gaps: Array

    @property
    def error(self) -> float:
        """Median of the tags' errors, robust against one displaced tag, [px]."""
        return float(np.median(self.errors)) if len(self.errors) else 0.0

    @property
    def distance(self) -> float:
        """Median of the tags' errors at their distances, [m]."""
        return float(np.median(self.distances)) if len(self.distances) else 0.0

    def agrees(self, other: CameraCheck, limit_px: float) -> bool:
        """Whether tags seen in both checks are at the same positions, by the median of them."""
        both = [k for k, tag in enumerate(self.tags) if tag in other.tags]
        changes = [self.gaps[k] - other.gaps[other.tags.index(self.tags[k])] for k in both]
        return not both or float(np.median(rms(np.array(changes)))) <= limit_px


def check_camera(camera: Camera, views: Sequence[TagView]) -> CameraCheck:
    """Reprojection errors of frame tags; partly visible tags are left out."""
    camera_from_world = camera.world_from_camera.inverse()
    whole = [view for view in views if view.seen.whole]
    errors, distances, gaps = [], [], []
    for view in whole:
        points = camera_from_world.apply(tag_corners(view.tag))
        gaps.append(reprojection_errors(camera, points, view.seen.corners))
        errors.append(float(rms(gaps[-1])))
        distances.append(float(rms(sight_offsets(camera, points, view.seen.corners))))
    tags = tuple(view.tag.id for view in whole)
    return CameraCheck(tags, read_only(errors), read_only(distances), read_only(gaps))


def measured_camera(camera: Camera, views: Sequence[TagView]) -> tuple[Pose, Array] | None:
    """The camera's pose from visible frame tags.

    Returns:
        ``world_from_camera`` and the covariance of position [m] and rotation vector [rad] along the
        world's axes, shape (6, 6); None if the tags do not determine it.
    """
    found = solve_pnp(camera, views, camera.world_from_camera.inverse())
    if found is None or not np.all(np.isfinite(found.covariance)):
        return None
    change = change_of_inverse(found.camera_from_body)
    return found.camera_from_body.inverse(), read_only(change @ found.covariance @ change.T)


def change_of_inverse(pose: Pose) -> Array:
    """Derivative of the inverse of a pose by the pose, shape (6, 6).

    Shifts [m] and rotations [rad] are along the axes of each pose's outer frame: for a change of
    (R, p) the inverse rotates by −Rᵀ turn, and its position −Rᵀ p shifts by −Rᵀ shift − Rᵀ (p ×
    turn).
    """
    back = pose.rotation.T
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = -back
    change[:3, 3:] = -back @ skew(pose.position)
    return change


def require_unmoved_camera(
    camera: Camera,
    views: Sequence[TagView],
    limit_px: float,
    before: CameraCheck | None,
    rig: Rig,
) -> CameraCheck | None:
    """Checks the camera's pose if frame tags are visible.

    Another print of a covered tag, or something along its edge, fails a check as well, but not the
    next one in the same manner.

    Args:
        views: Of frame tags.
        limit_px: Largest median error of the tags.
        before: The check of the last image; None if it passed.
        rig: Its tags, and cameras with which this one may be exchanged.

    Returns:
        The check, or None if no frame tag is completely visible.

    Raises:
        CameraMoved: The error exceeds the limit, and the tags are where they were before.
    """
    check = check_camera(camera, views)
    if not check.tags:
        return None
    if check.error <= limit_px or before is None or not check.agrees(before, limit_px):
        return check
    values: dict[str, float | str] = {
        "error_px": round(check.error, 3),
        "limit_px": limit_px,
        "error_mm": round(check.distance * 1e3, 2),
        "frame_tags": ", ".join(map(str, check.tags)),
    }

    def fit(tags: tuple[Tag, ...]) -> bool:
        rotated = [replace(view, tag=tag) for view, tag in zip(views, tags, strict=True)]
        return check_camera(camera, rotated).error <= limit_px

    stated = [view.tag for view in views]
    mounted = mounted_rotated(stated, rig.tag_family, fit) if len(check.tags) > 1 else None
    if mounted is not None:
        raise CameraMoved(
            f"frame tags {values['frame_tags']} are not mounted as the rig file states",
            where=f"camera {camera.name!r}",
            why=mounted[0],
            next_step=mounted[1],
            values=values,
        )
    what = f"camera {camera.name!r} is not at the pose in the rig file"
    why = (
        f"reprojection error {check.error:.2f} px ({check.distance * 1e3:.1f} mm), limit"
        f" {limit_px:g} px: the camera or the tags were moved, or the lens refocused"
    )
    next_step = (
        "restore it, or calibrate its pose again and write it into the rig file under cameras:"
        " world_from_camera"
    )
    found = measured_camera(camera, views)
    if found is not None:
        shift = camera.world_from_camera.distance_to(found[0])
        turn = float(np.degrees(camera.world_from_camera.angle_to(found[0])))
        values |= {"moved_mm": round(shift * 1e3, 1), "turned_deg": round(turn, 3)}
        what += f": it is off by {shift * 1e3:.1f} mm and {turn:.2f}°"
        gaps = {c.name: pose_gap(c.world_from_camera, found[0]) for c in (*rig.cameras, camera)}
        nearest = min(gaps, key=gaps.__getitem__)
        if nearest != camera.name and gaps[nearest] <= 1.0:
            what = f"the images of camera {camera.name!r} are from the pose of camera {nearest!r}"
            why, next_step = exchanged_sources(camera.name, nearest)
    where = f"frame tags {values['frame_tags']}"
    raise CameraMoved(what, where=where, why=why, next_step=next_step, values=values)
