"""What is wrong in all pictures of a camera alike: its lens, its place, the tags.

Such errors do not average away over pictures, so their covariance is kept beside that of the
corners' scatter. A camera's place that was found by pictures moves with the errors of its lens: a
focal length that is too long puts the camera too far away, and what it measures near the tags that
located it hardly moves. So a lens error counts by what it does to place and pose together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.cameras import SURE
from model.errors import BadInput
from model.pose import Array, Pose, carried, read_only, skew
from model.rig import Camera, Rig, Tag
from tracking.camera_model import ideal_slopes, ray_slopes, rays_of
from tracking.detection.tags import tag_corners
from tracking.pnp import BundlePose, TagView, expected_cost, moved_by_pixels

_GRID = 7
"""Points along each side of the picture at which a rotation is fitted to lens errors."""


def missing_errors(rig: Rig, camera: Camera) -> tuple[str, ...]:
    """What of the chain from lens to cables says nothing about how far off it is.

    Returns:
        Keys of the rig file, and what finds them; empty where all of them are there.
    """
    stated = {
        "lens_covariance (`cdpr calibrate camera`)": camera.lens_covariance,
        "pose_covariance (`cdpr calibrate extrinsics`)": camera.place_covariance,
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
        if camera.place_covariance is not None:
            self._place = camera.place_covariance
        if camera.lens_covariance is None:
            return
        self._lens = camera.lens_covariance
        if camera.place_by_lens is None:
            self._place_by_lens[3:] = implied_rotation(camera)
        else:
            by_lens = self._place_by_lens = camera.place_by_lens
            self._place = _positive(self._place - by_lens @ self._lens @ by_lens.T)

    def of(self, pose: Pose, views: Sequence[TagView]) -> Array:
        """Covariance of position [m] and rotation vector [rad], world axes, shape (6, 6).

        Args:
            pose: The measured one, ``world_from_platform``.
            views: The tags that it rests on.
        """
        if self.whole is not None:
            return read_only(np.diag([(self.whole / SURE) ** 2] * 3 + [0.0] * 3))
        world_from_camera = self._camera.world_from_camera
        camera_from_body = world_from_camera.inverse().compose(pose)
        by_place = carried(pose.position - world_from_camera.position)
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
    shift = error / SURE / np.sqrt(6.0)
    turn = error / SURE / (2.0 * reach)
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
