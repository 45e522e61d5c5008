"""Cameras and tags of a rig, and what a camera's place makes its poses err by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.files.rig_file import CameraDocument, TagDocument, TagsDocument
from model.pose import Array, Pose, read_only, skew


@dataclass(frozen=True, slots=True, eq=False)
class Tag:
    """A fiducial tag in the frame of what carries it (x right, y up, z out of the print).

    Attributes:
        id: Number in its family.
        size: Side of the black square, [m].
        pose: ``platform_from_tag`` or ``world_from_tag``.
    """

    id: int
    size: float
    pose: Pose


SURE = 1.96
"""Standard deviations that hold 95 % of a normal error."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A calibrated camera.

    Attributes:
        name: Name in the rig file.
        width: Picture width, [px].
        height: Picture height, [px].
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: OpenCV coefficients of the lens, shape (k,).
        world_from_camera: Pose; x right, y down, z along the view.
        rate: Pictures a second, [Hz].
        lens: One of `model.files.documents.LENSES`.
        place_covariance: Of ``world_from_camera``: position [m] and rotation vector [rad] along the
            world's axes, shape (6, 6); None where the rig file does not say.
        whole_error: Whether that covariance stands for all that is shared, tags included.
        readout: From the exposure of the top row to that of the bottom row, [s]; images are stamped
            with the time of the middle one.
    """

    name: str
    width: int
    height: int
    matrix: Array
    distortion: Array
    world_from_camera: Pose
    rate: float
    lens: str = "pinhole"
    place_covariance: Array | None = None
    whole_error: bool = False
    readout: float = 0.0

    def row_times(self, pixels: Array) -> Array:
        """When rows are exposed, after the middle one.

        Args:
            pixels: Shape (..., 2), [px].

        Returns:
            Shape (...), [s].
        """
        return np.asarray(self.readout * ((pixels[..., 1] + 0.5) / self.height - 0.5))

    def shared_covariance(self, world_from_body: Pose) -> Array:
        """What its place makes every pose that it measures err by alike, shape (6, 6), [m, rad].

        It is common to all pictures: no mean over them makes it smaller.

        Args:
            world_from_body: The measured pose.

        Returns:
            Of position and rotation vector along the world's axes; 0 where nothing is stated.
        """
        if self.place_covariance is None:
            return np.zeros((6, 6))
        arm = world_from_body.position - self.world_from_camera.position
        by_place = np.eye(6)
        by_place[:3, 3:] = -skew(arm)
        return np.asarray(by_place @ self.place_covariance @ by_place.T)


def tag_from(document: TagDocument) -> Tag:
    """The tag that a rig file describes."""
    return Tag(id=document.id, size=document.size_mm / 1000.0, pose=document.pose())


def tag_error_in(tags: TagsDocument | None) -> float | None:
    """How far off corners of the platform's tags are, 95 %, [m]; None where not stated."""
    return None if tags is None or tags.error_mm is None else tags.error_mm / 1e3


def camera_from(document: CameraDocument) -> Camera:
    """The camera that a rig file describes."""
    matrix = [
        [document.fx_px, 0.0, document.cx_px],
        [0.0, document.fy_px, document.cy_px],
        [0.0, 0.0, 1.0],
    ]
    return Camera(
        name=document.name,
        width=document.width_px,
        height=document.height_px,
        matrix=read_only(matrix),
        distortion=read_only(document.distortion),
        world_from_camera=document.world_from_camera.pose(),
        rate=document.rate_hz,
        lens=document.lens,
        place_covariance=_place_covariance(document),
        whole_error=document.pose_covariance is None and document.error_mm is not None,
        readout=document.readout_ms / 1e3,
    )


def _place_covariance(document: CameraDocument) -> Array | None:
    if document.pose_covariance is not None:
        scales = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)
        return read_only(np.array(document.pose_covariance) * np.outer(scales, scales))
    if document.error_mm is not None:  # the same everywhere: as of a camera that is shifted
        deviation = document.error_mm / 1e3 / SURE
        return read_only(np.diag([deviation**2] * 3 + [0.0] * 3))
    return None
