"""The camera as straight lines: pixels without lens distortion ("ideal" pixels) and back.

Lines of the world are straight in ideal pixels, so lines are fitted and poses are solved there. A
pixel's centre has whole coordinates, as in OpenCV.
"""

from __future__ import annotations

import cv2
import numpy as np

from cdpr.poses import Array
from cdpr.rig import Camera

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


def ideal_of(camera: Camera, points_in_camera: Array) -> Array:
    """Ideal pixels of points, shape (..., 3), [m]; shape (..., 2)."""
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    scaled = points_in_camera[..., :2] / points_in_camera[..., 2:]
    return np.asarray(scaled * [fx, fy] + camera.matrix[:2, 2])
