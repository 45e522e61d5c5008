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
from model.files.camera_file import FISHEYE
from model.pose import Array
from model.rig import Camera

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
_CONVERGES = 5
"""OpenCV's iteration reaches its limit with that number of coefficients."""
_NEWTON_STEPS, _LONGEST_STEP, _AT_ONCE = 30, 0.3, 100_000
"""Of the rays of other lenses: iterations, length of a step, and how many at once."""
WIDEST = 1.5
"""Rays farther off the axis are put there: beyond 90° none meets the plane before it, [rad]."""


def ideal_from_pixels(camera: Camera, pixels: Array) -> Array:
    """Removes the lens distortion of points, shape (..., 2), [px]; same shape."""
    flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if not camera.distortion.size:
        return flat.reshape(pixels.shape)
    rays = rays_of(camera.lens, camera.matrix, camera.distortion, flat)
    matrix = camera.matrix
    ideal = rays * [matrix[0, 0], matrix[1, 1]] + matrix[:2, 2]
    return np.asarray(ideal).reshape(pixels.shape)


def rays_of(lens: str, matrix: Array, distortion: Array, pixels: Array) -> Array:
    """Where rays through pixels meet the plane a metre before the camera.

    Args:
        lens: One of `model.files.documents.LENSES`.
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: OpenCV coefficients of this lens, shape (k,).
        pixels: Shape (..., 2), [px].

    Returns:
        Its x and y, shape (n, 2), [m].
    """
    flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if lens == FISHEYE:
        inside = _before_the_camera(matrix, distortion, flat)
        near = cv2.fisheye.undistortPoints(inside, matrix, distortion, criteria=_CRITERIA)
        return np.asarray(near, dtype=np.float64).reshape(-1, 2)
    near = cv2.undistortPoints(flat, matrix, distortion, criteria=_CRITERIA)
    rays: Array = np.asarray(near, dtype=np.float64)
    if np.size(distortion) > _CONVERGES:
        parts = range(0, len(flat), _AT_ONCE)
        for part in (slice(start, start + _AT_ONCE) for start in parts):
            rays[part] = _polished_rays(matrix, distortion, flat[part], rays[part])
    return rays.reshape(-1, 2)


def _before_the_camera(matrix: Array, distortion: Array, pixels: Array) -> Array:
    """Pixels of a fisheye, those of rays beyond `WIDEST` moved inward to it."""
    turns = WIDEST ** np.arange(2, 10, 2)
    widest = WIDEST * (1.0 + float(np.ravel(distortion)[:4] @ turns))
    scale, middle = np.array([matrix[0, 0], matrix[1, 1]]), matrix[:2, 2]
    away = (pixels - middle) / scale
    radius = np.linalg.norm(away, axis=-1, keepdims=True)
    return np.asarray(middle + away * scale * np.minimum(1.0, widest / np.maximum(radius, 1e-12)))


def _polished_rays(matrix: Array, distortion: Array, pixels: Array, rays: Array) -> Array:
    """Rays whose pixels are right, by Newton; OpenCV's iteration is pixels off in wide lenses."""
    zero = np.zeros(3)
    for _ in range(_NEWTON_STEPS):
        points = np.concatenate([rays, np.ones((len(rays), 1, 1))], axis=2)
        seen, slopes = cv2.projectPoints(points, zero, zero, matrix, distortion)
        gap = (pixels - seen).reshape(-1, 2)
        by = np.asarray(slopes)[:, 3:5].reshape(-1, 2, 2)
        across = by[:, 0, 0] * by[:, 1, 1] - by[:, 0, 1] * by[:, 1, 0]
        solvable = np.abs(across) > 1e-6
        across = np.where(solvable, across, 1.0)
        step = (
            np.column_stack(
                [
                    by[:, 1, 1] * gap[:, 0] - by[:, 0, 1] * gap[:, 1],
                    by[:, 0, 0] * gap[:, 1] - by[:, 1, 0] * gap[:, 0],
                ]
            )
            / across[:, None]
        )
        size = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, _LONGEST_STEP / np.maximum(size, 1e-12)) * solvable[:, None]
        rays = rays + step.reshape(-1, 1, 2)
        if float(size.max(initial=0.0)) < 1e-10:
            break
    return rays


def project(lens: str, matrix: Array, distortion: Array, points: Array) -> Array:
    """Pixels of points in front of the camera; the arguments are those of `rays_of`.

    Args:
        lens: One of `model.files.documents.LENSES`.
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: OpenCV coefficients of this lens, shape (k,).
        points: Camera frame, shape (n, 3), [m].

    Returns:
        Shape (n, 2), [px].
    """
    zero = np.zeros(3)
    flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
    if lens == FISHEYE:
        pixels = cv2.fisheye.projectPoints(flat, zero, zero, matrix, distortion)[0]
    else:
        pixels = cv2.projectPoints(flat, zero, zero, matrix, distortion)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def ray_slopes(camera: Camera, rays: Array) -> Array:
    """How rays through given pixels move with the camera's n numbers (fx, fy, cx, cy, distortion).

    Args:
        camera: The camera.
        rays: Where they meet the plane a metre before it, shape (p, 2), [m].

    Returns:
        Shape (p, 2, n), [m] for each unit of a number.
    """
    zero, count = np.zeros(3), 4 + camera.distortion.size
    points = np.column_stack([rays, np.ones(len(rays))]).reshape(-1, 1, 3)
    if camera.lens == FISHEYE:
        by = cv2.fisheye.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[1]
        slopes = np.asarray(by, dtype=np.float64).reshape(len(rays), 2, -1)
        by_ray, by_lens = slopes[..., 11:13], slopes[..., :8]
    else:
        by = cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[1]
        slopes = np.asarray(by, dtype=np.float64).reshape(len(rays), 2, -1)
        by_ray, by_lens = slopes[..., 3:5], slopes[..., 6 : 6 + count]
    return np.asarray(-np.linalg.solve(by_ray, by_lens))


def ideal_slopes(camera: Camera, ideal: Array) -> Array:
    """How ideal pixels of given pixels move with the camera's n numbers, as `ray_slopes`.

    Args:
        camera: The camera.
        ideal: Pixels without distortion, shape (p, 2), [px].

    Returns:
        Shape (p, 2, n), [px] for each unit of a number.
    """
    focal, middle = camera.matrix[[0, 1], [0, 1]], camera.matrix[:2, 2]
    return np.asarray(ray_slopes(camera, (ideal - middle) / focal) * focal[:, None])


def pixels_from_ideal(camera: Camera, ideal: Array) -> Array:
    """Puts the lens distortion back on points, shape (..., 2), [px]; same shape."""
    flat = np.asarray(ideal, dtype=np.float64).reshape(-1, 2)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ np.linalg.inv(camera.matrix).T
    return pixels_of(camera, rays).reshape(ideal.shape)


def pixels_of(camera: Camera, points_in_camera: Array) -> Array:
    """Distorted pixels of points in front of the camera, shape (n, 3), [m]; shape (n, 2)."""
    return project(camera.lens, camera.matrix, camera.distortion, points_in_camera)


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
