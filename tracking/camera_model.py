"""The camera as straight lines: pixels without lens distortion ("ideal" pixels) and back.

Lines of the world are straight in ideal pixels, so lines are fitted and poses are solved there. A
pixel's centre has whole coordinates, as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.pose import Array
from model.rig import Camera

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)


def ideal_from_pixels(camera: Camera, pixels: Array) -> Array:
    """Removes the lens distortion of points, shape (..., 2), [px]; same shape."""
    flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if not camera.distortion.size:
        return flat.reshape(pixels.shape)
    ideal = cv2.undistortPoints(
        flat, camera.matrix, camera.distortion, P=camera.matrix, criteria=_CRITERIA
    )
    return np.asarray(ideal, dtype=np.float64).reshape(pixels.shape)


def pixels_from_ideal(camera: Camera, ideal: Array) -> Array:
    """Puts the lens distortion back on points, shape (..., 2), [px]; same shape."""
    flat = np.asarray(ideal, dtype=np.float64).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ np.linalg.inv(camera.matrix).T
    return pixels_of(camera, rays).reshape(ideal.shape)


def pixels_of(camera: Camera, points_in_camera: Array) -> Array:
    """Distorted pixels of points in front of the camera, shape (n, 3), [m]; shape (n, 2)."""
    zero = np.zeros(3)
    points = np.ascontiguousarray(points_in_camera, dtype=np.float64)
    pixels = cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def project_undistorted(camera: Camera, points_in_camera: Array) -> Array:
    """Ideal pixels of points, shape (..., 3), [m]; shape (..., 2)."""
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    scaled = points_in_camera[..., :2] / points_in_camera[..., 2:]
    return np.asarray(scaled * [fx, fy] + camera.matrix[:2, 2])


# Images and parts of them.


Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of pixels, right and bottom not included."""

    left: int
    top: int
    right: int
    bottom: int


def require_image_format(image: Image, camera: Camera, rig: str) -> None:
    """An image of another kind than the camera was calibrated for would measure wrongly.

    Args:
        image: The image.
        camera: Whose it should be.
        rig: Name of the rig that has it.

    Raises:
        BadInput: It is not a grey one of 8 bits, or not of the camera's size.
    """
    wanted = (camera.height, camera.width)
    if image.shape != wanted or image.dtype != np.uint8:
        size = " x ".join(map(str, image.shape[1::-1] if image.ndim > 1 else image.shape))
        raise BadInput(
            f"the image has {size} px ({image.dtype}, {image.ndim} dimensions); camera"
            f" {camera.name!r} takes grey 8-bit images of {wanted[1]} x {wanted[0]} px",
            where=f"rig {rig}",
            next_step="use full-size images of this camera, or correct the rig file",
        )
