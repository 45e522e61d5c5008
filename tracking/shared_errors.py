"""What is wrong in all pictures of a camera alike: its lens, its place, the tags.

Such errors do not average away over pictures, so their covariance is kept beside that of the
corners' scatter. A camera's place that was found by pictures moves with the errors of its lens: a
focal length that is too long puts the camera too far away, and what it measures near the tags that
located it hardly moves. So a lens error counts by what it does to place and pose together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.cameras import Z_95
from model.errors import BadInput, Fault
from model.pose import Array, Pose, lever_arm_matrix, read_only, skew
from model.rig import Camera, Rig, Tag
from tracking.camera_model import ideal_slopes, project_undistorted, ray_slopes, rays_of
from tracking.detection.tags import tag_corners
from tracking.pnp import BundlePose, TagView, expected_cost, moved_by_pixels, solve_pnp

_GRID = 7
"""Points along each side of the picture at which a rotation is fitted to lens errors."""


def missing_errors(rig: Rig, camera: Camera) -> tuple[str, ...]:
    """What of the chain from lens to cables says nothing about how far off it is.

    Returns:
        Keys of the rig file, and what finds them; empty where all of them are there.
    """
    stated = {
        "lens_covariance (`cdpr calibrate camera`)": camera.lens_covariance,
        "pose_covariance (`cdpr calibrate extrinsics`)": camera.pose_covariance,
        "tags: error_mm (`cdpr calibrate tags`)": rig.tag_error,
        "outlets_error_mm (`cdpr calibrate rig`)": rig.outlet_error,
        "anchors_error_mm (`cdpr calibrate rig`)": rig.anchor_error,
    }
    return tuple(key for key, value in stated.items() if value is None)


def require_stated_errors(rig: Rig, cameras: Sequence[Camera]) -> None:
    """Refuses to measure clearance where nothing says how far off it may be.

    Raises:
        BadInput: For a camera that is so; it asks for one number.
    """
    for camera in cameras:
        missing = missing_errors(rig, camera)
        if missing and camera.error is None:
            raise BadInput(
                f"it is unknown how far off camera {camera.name!r} measures, so it cannot measure"
                " clearance",
                where=f"rig {rig.name}",
                why=f"calibrations have not stated {', '.join(missing)}",
                next_step=f"add `error_mm` to camera {camera.name!r} in the rig file: by how many"
                " mm the measured platform and cables may be off, 95 %; or run these calibrations",
                values={"camera": camera.name},
            )


class SharedErrors:
    """The covariance of what is wrong in all pictures of a camera alike.

    Calibrations state it, or, where one of them is missing, one number of the operator.

    Args:
        rig: Its tags.
        camera: Its lens and place.
    """

    def __init__(self, rig: Rig, camera: Camera) -> None:
        missing = missing_errors(rig, camera)
        self.unstated = bool(missing) and camera.error is None
        """Whether a part of it is not stated."""
        self.whole = camera.error if missing else None
        """The operator's number, where it stands for all of it, cables included, [m]."""
        self._camera, self._tag_error = camera, rig.tag_error or 0.0
        count = 4 + camera.distortion.size
        self._place = np.zeros((6, 6))
        self._lens, self._place_by_lens = np.zeros((count, count)), np.zeros((6, count))
        if camera.pose_covariance is not None:
            self._place = camera.pose_covariance
        if camera.lens_covariance is None:
            return
        self._lens = camera.lens_covariance
        if camera.pose_by_lens is None:
            self._place_by_lens[3:] = implied_rotation(camera)
        else:
            by_lens = self._place_by_lens = camera.pose_by_lens
            self._place = _positive(self._place - by_lens @ self._lens @ by_lens.T)

    def of(self, pose: Pose, views: Sequence[TagView]) -> Array:
        """Covariance of position [m] and rotation vector [rad], world axes, shape (6, 6).

        Args:
            pose: The measured one, ``world_from_platform``.
            views: The tags that it rests on.
        """
        if self.whole is not None:
            return read_only(np.diag([(self.whole / Z_95) ** 2] * 3 + [0.0] * 3))
        world_from_camera = self._camera.world_from_camera
        camera_from_body = world_from_camera.inverse().compose(pose)
        by_place = lever_arm_matrix(pose.position - world_from_camera.position)
        steps = moved_by_pixels(
            self._camera,
            views,
            camera_from_body,
            np.concatenate(
                [self._pixels_by_lens(views), self._pixels_by_tags(views, camera_from_body)], axis=2
            ),
        )
        steps = np.kron(np.eye(2), world_from_camera.rotation) @ steps
        count = len(self._lens)
        by_lens = steps[:, :count] + by_place @ self._place_by_lens
        by_tags = steps[:, count:]
        return read_only(
            by_place @ self._place @ by_place.T
            + by_lens @ self._lens @ by_lens.T
            + by_tags @ by_tags.T
        )

    def scatter(self, bundle: BundlePose, views: Sequence[TagView]) -> Array:
        """Covariance of a pose by the scatter of its edges alone, camera's axes, shape (6, 6).

        Edges that fit badly widen it. Where tags are off as stated, edges fit worse by that much,
        and it is in `of` already: counted here once more, intervals would be too wide.

        Args:
            bundle: The pose in the camera's frame.
            views: The tags that it rests on.
        """
        misfit, pose = bundle.misfit(bundle.freedom), bundle.camera_from_body
        if self.whole is not None or not self._tag_error or misfit <= 1.0:
            return bundle.covariance
        by_tags = self._pixels_by_tags(views, pose)
        left = bundle.misfit(expected_cost(self._camera, views, pose, by_tags))
        return read_only(bundle.covariance * (max(left, 1.0) / misfit))

    def _pixels_by_lens(self, views: Sequence[TagView]) -> Array:
        """Slopes of the ideal pixels of all corners, shape (t, 8, n)."""
        ideal = np.concatenate([view.seen.corners for view in views])
        return ideal_slopes(self._camera, ideal).reshape(len(views), 8, -1)

    def _pixels_by_tags(self, views: Sequence[TagView], camera_from_body: Pose) -> Array:
        """Slopes of the same by each tag's errors of size 1, where they look to be, (t, 8, 6 t)."""
        matrix = self._camera.matrix
        slopes = np.zeros((len(views), 8, 6 * len(views)))
        for k, view in enumerate(views):
            shifts = camera_from_body.rotation @ tag_error_slopes(view.tag, self._tag_error)
            points = camera_from_body.apply(tag_corners(view.tag))
            for corner, (x, y, z) in enumerate(points):
                by_point = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
                by_point *= np.array([[matrix[0, 0]], [matrix[1, 1]]])
                rows = slice(2 * corner, 2 * corner + 2)
                slopes[k, rows, 6 * k : 6 * k + 6] = by_point @ shifts[corner]
        return slopes


def tag_error_slopes(tag: Tag, error: float) -> Array:
    """How independent errors of size 1 of a tag's place shift its corners, shape (4, 3, 6), [m].

    Half of the square of the corners' error is the tag's shift, half its turn.

    Args:
        tag: The tag.
        error: Of its corners, 95 %, RMS, [m].
    """
    arms = tag_corners(tag) - tag.pose.position
    reach = float(np.sqrt(np.mean(np.sum(arms**2, axis=1))))
    shift = error / Z_95 / np.sqrt(6.0)
    turn = error / Z_95 / (2.0 * reach)
    return np.array([np.hstack([shift * np.eye(3), -turn * skew(arm)]) for arm in arms])


def implied_rotation(camera: Camera) -> Array:
    """The rotation of a camera that best undoes errors of its lens, world axes, shape (3, n).

    A camera's rotation that is found by pictures of that lens is found turned by this.
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
    """The nearest covariance: what rounding makes negative is 0."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    alike = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(alike * np.outer(scale, scale))


# Whether the camera stands where the rig file says, by tags of known place in the world.


class CameraMoved(Fault):
    """The tags on the frame are not where the camera should see them."""

    code = "camera_moved"


@dataclass(frozen=True, slots=True, eq=False)
class CameraCheck:
    """How far frame tags lie from where the rig file puts them in the image.

    Attributes:
        tags: Numbers of the tags seen whole.
        errors: RMS error of each tag's corners, shape (t,), [px].
        distances: The same at each tag's place, shape (t,), [m].
    """

    tags: tuple[int, ...]
    errors: Array
    distances: Array

    @property
    def error(self) -> float:
        """Median of the tags' errors: one knocked tag among several does not count, [px]."""
        return float(np.median(self.errors)) if len(self.errors) else 0.0

    @property
    def distance(self) -> float:
        """Median of the tags' errors at their places, [m]."""
        return float(np.median(self.distances)) if len(self.distances) else 0.0


def check_camera(camera: Camera, views: Sequence[TagView]) -> CameraCheck:
    """Compares frame tags with where they should be seen; tags seen in part are left out."""
    camera_from_world = camera.world_from_camera.inverse()
    whole = [view for view in views if view.seen.whole]
    errors, distances = [], []
    for view in whole:
        points = camera_from_world.apply(tag_corners(view.tag))
        gap = project_undistorted(camera, points) - view.seen.corners
        errors.append(float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))))
        distances.append(errors[-1] * float(points[:, 2].mean()) / float(camera.matrix[0, 0]))
    tags = tuple(view.tag.id for view in whole)
    return CameraCheck(tags, read_only(errors), read_only(distances))


def measured_camera(camera: Camera, views: Sequence[TagView]) -> tuple[Pose, Array] | None:
    """Where the camera stands by the frame tags it sees.

    Returns:
        ``world_from_camera`` and the covariance of position [m] and rotation vector [rad] along the
        world's axes, shape (6, 6); None when the tags do not give one.
    """
    found = solve_pnp(camera, views, camera.world_from_camera.inverse())
    if found is None or not np.all(np.isfinite(found.covariance)):
        return None
    change = change_of_inverse(found.camera_from_body)
    return found.camera_from_body.inverse(), read_only(change @ found.covariance @ change.T)


def change_of_inverse(pose: Pose) -> Array:
    """How the inverse of a pose shifts and turns when the pose does, shape (6, 6).

    Each shifts [m] and turns [rad] along the axes of its own outer frame: when (R, p) does, its
    inverse turns by −Rᵀ turn, and its position −Rᵀ p shifts by −Rᵀ shift − Rᵀ (p × turn).
    """
    back = pose.rotation.T
    change = np.zeros((6, 6))
    change[:3, :3] = change[3:, 3:] = -back
    change[:3, 3:] = -back @ skew(pose.position)
    return change


def refuse_moved_camera(
    camera: Camera, views: Sequence[TagView], limit_px: float
) -> CameraCheck | None:
    """Checks the camera when frame tags are seen.

    Returns:
        The check, or None when no frame tag is seen whole.

    Raises:
        CameraMoved: Most tags lie farther than ``limit_px`` from where they should be.
    """
    check = check_camera(camera, views)
    if not check.tags:
        return None
    if check.error <= limit_px:
        return check
    values: dict[str, float | str] = {
        "error_px": round(check.error, 3),
        "limit_px": limit_px,
        "error_mm": round(check.distance * 1e3, 2),
        "frame_tags": ", ".join(map(str, check.tags)),
    }
    by = ""
    found = measured_camera(camera, views)
    if found is not None:
        shift = camera.world_from_camera.distance_to(found[0])
        turn = float(np.degrees(camera.world_from_camera.angle_to(found[0])))
        values |= {"moved_mm": round(shift * 1e3, 1), "turned_deg": round(turn, 3)}
        by = f": it is off by {shift * 1e3:.1f} mm and {turn:.2f}°"
    raise CameraMoved(
        f"camera {camera.name!r} is not at the pose in the rig file{by}",
        where=f"frame tags {values['frame_tags']}",
        why=f"reprojection error {check.error:.2f} px ({check.distance * 1e3:.1f} mm), limit"
        f" {limit_px:g} px: the camera or the tags were moved, or the lens refocused",
        next_step="restore it, or calibrate its pose again and write it into the rig file under"
        " cameras: world_from_camera",
        values=values,
    )
