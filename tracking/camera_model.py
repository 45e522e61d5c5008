"""Camera model: lens distortion, undistorted pixels, rays and their derivatives.

Straight lines of the world are straight in undistorted pixels, so lines are fitted and poses are
solved there. Pixel centres have integer coordinates, as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.files.camera_file import FISHEYE, Gamma
from model.pose import Array, Pose, require_real, skew
from model.rig import Camera

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
_CONVERGED = 1e-5
"""Rays of OpenCV's iteration are refined if they miss their pixel by more, [px]."""
_SIMPLE, _BEND = 5, 0.4
"""OpenCV's iteration converges for up to this number of coefficients, where the radial terms change
the scale along the radius by less than this share."""
_NEWTON_STEPS, _LONGEST_STEP, _AT_ONCE = 30, 0.3, 100_000
"""For these rays: iterations, largest step, and rays per batch."""
WIDEST = 1.5
"""Rays of a fisheye farther off the axis are clamped to this angle, below 90°, [rad], or to the one
from which on the radius increases with the angle by less than `_LEAST_SLOPE`."""
_LEAST_SLOPE = 1e-3
_ANGLES, _ANGLE_STEPS = np.linspace(0.0, WIDEST, 1000), 5
"""Angles at which Newton's method for rays of a fisheye starts, [rad], and number of its steps."""


def undistort_pixels(camera: Camera, pixels: Array) -> Array:
    """Removes the lens distortion from points, shape (..., 2), [px]; same shape."""
    flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if not camera.distortion.size:
        return flat.reshape(pixels.shape)
    rays = rays_of(camera.lens, camera.matrix, camera.distortion, flat)
    matrix = camera.matrix
    undistorted = rays * [matrix[0, 0], matrix[1, 1]] + matrix[:2, 2]
    return np.asarray(undistorted).reshape(pixels.shape)


def rays_of(lens: str, matrix: Array, distortion: Array, pixels: Array) -> Array:
    """Intersections of rays through pixels with the plane 1 m in front of the camera.

    Args:
        lens: One of `model.files.documents.LENSES`.
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: OpenCV coefficients of this lens, shape (k,).
        pixels: Shape (..., 2), [px].

    Returns:
        x and y, shape (n, 2), [m].
    """
    flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if lens == FISHEYE:
        return _fisheye_rays(matrix, distortion, flat.reshape(-1, 2))
    near = cv2.undistortPoints(flat, matrix, distortion, criteria=_CRITERIA)
    rays: Array = np.asarray(near, dtype=np.float64)
    if np.size(distortion) <= _SIMPLE and _bend(distortion, rays) < _BEND:
        return rays.reshape(-1, 2)
    points = np.concatenate([rays, np.ones((len(rays), 1, 1))], axis=2)
    back = project(lens, matrix, distortion, points)
    missed = np.flatnonzero(np.abs(back - flat[:, 0]).max(axis=1, initial=0.0) > _CONVERGED)
    for start in range(0, len(missed), _AT_ONCE):
        part = missed[start : start + _AT_ONCE]
        rays[part] = _refined_rays(matrix, distortion, flat[part], rays[part])
    return rays.reshape(-1, 2)


def _bend(distortion: Array, rays: Array) -> float:
    """Bound on the change of scale along the radius by k1, k2 and k3, over rays of a batch."""
    squared = float((rays**2).sum(axis=-1).max(initial=0.0))
    k1, k2, _, _, k3 = np.abs(np.resize(np.append(distortion, np.zeros(5)), 5))
    return float(squared * (2.0 * k1 + squared * (4.0 * k2 + squared * 6.0 * k3)))


def _fisheye_rays(matrix: Array, distortion: Array, pixels: Array) -> Array:
    """Rays through pixels of a fisheye, on the branch where the radius increases from 0.

    OpenCV's iteration may leave that branch: it begins at the radius, not at an angle of it.
    """
    coefficients = np.zeros(10)
    coefficients[1::2] = 1.0, *np.ravel(distortion)[:4]
    radius_by_angle = np.polynomial.Polynomial(coefficients)
    slope = radius_by_angle.deriv()
    angles = _ANGLES[np.logical_and.accumulate(slope(_ANGLES) > _LEAST_SLOPE)]
    away = (pixels - matrix[:2, 2]) / [matrix[0, 0], matrix[1, 1]]
    radius = np.linalg.norm(away, axis=1)
    angle = np.interp(radius, radius_by_angle(angles), angles)
    for _ in range(_ANGLE_STEPS):
        step = (radius_by_angle(angle) - radius) / np.maximum(slope(angle), _LEAST_SLOPE)
        angle = np.clip(angle - step, 0.0, angles[-1])
    return np.asarray(away * (np.tan(angle) / np.maximum(radius, 1e-12))[:, None])


def _refined_rays(matrix: Array, distortion: Array, pixels: Array, rays: Array) -> Array:
    """Rays refined by Newton's method; OpenCV's iteration is off by pixels in wide lenses."""
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
    """Pixels of points in front of the camera; arguments as in `rays_of`.

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
    """Derivatives of rays through given pixels by fx, fy, cx, cy and the distortion.

    Args:
        rays: Their intersections with the plane 1 m in front of it, shape (p, 2), [m].

    Returns:
        Shape (p, 2, n), [m] per unit of each of the n parameters.
    """
    points = np.column_stack([rays, np.ones(len(rays))])
    by_point, by_lens = _projection_slopes(camera, points)
    return np.asarray(-np.linalg.solve(by_point[..., :2], by_lens))


def _projection_slopes(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Derivatives of image pixels by n points, (n, 2, 3), and by lens parameters, (n, 2, k)."""
    zero, count = np.zeros(3), 4 + camera.distortion.size
    flat = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 1, 3)
    if camera.lens == FISHEYE:
        by = cv2.fisheye.projectPoints(flat, zero, zero, camera.matrix, camera.distortion)[1]
        by_point, by_lens = slice(11, 14), slice(0, 8)
    else:
        by = cv2.projectPoints(flat, zero, zero, camera.matrix, camera.distortion)[1]
        by_point, by_lens = slice(3, 6), slice(6, 6 + count)
    slopes = np.asarray(by, dtype=np.float64).reshape(len(flat), 2, -1)
    return slopes[..., by_point], slopes[..., by_lens]


def image_slopes(camera: Camera, points: Array) -> Array:
    """Derivatives of image pixels by points in front of the camera.

    Args:
        points: Camera frame, shape (..., 3), [m].

    Returns:
        Shape (..., 2, 3), [px/m].
    """
    return np.asarray(_projection_slopes(camera, points)[0].reshape(*points.shape[:-1], 2, 3))


def point_slopes(camera: Camera, points: Array) -> Array:
    """Derivatives of undistorted pixels by points; arguments as in `image_slopes`.

    Returns:
        Shape (..., 2, 3), [px/m].
    """
    slopes = np.zeros((*points.shape[:-1], 2, 3))
    depth = points[..., 2]
    for axis in range(2):
        focal = camera.matrix[axis, axis]
        slopes[..., axis, axis] = focal / depth
        slopes[..., axis, 2] = -focal * points[..., axis] / depth**2
    return slopes


def pose_slopes(camera: Camera, points: Array, pose: Pose) -> Array:
    """Derivatives of undistorted pixels by shift [m] and rotation [rad], camera axes.

    Args:
        points: In the body's frame, shape (..., 3), [m].
        pose: ``camera_from_body``.

    Returns:
        Shape (..., 2, 6), [px].
    """
    arms = points @ pose.rotation.T
    by_point = point_slopes(camera, arms + pose.position)
    by_turn = _cross(arms[..., None, :], by_point)  # d(turn × arm) seen through by_point
    return np.concatenate([by_point, by_turn], axis=-1)


def _cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; np.cross takes four times as long on small arrays."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def undistorted_slopes(camera: Camera, undistorted: Array) -> Array:
    """Derivatives of undistorted pixels by the lens parameters, as in `ray_slopes`.

    Args:
        undistorted: Pixels without distortion, shape (p, 2), [px].

    Returns:
        Shape (p, 2, n), [px] per unit of each of the n parameters.
    """
    focal, middle = camera.matrix[[0, 1], [0, 1]], camera.matrix[:2, 2]
    return np.asarray(ray_slopes(camera, (undistorted - middle) / focal) * focal[:, None])


def directions(camera: Camera, undistorted: Array) -> Array:
    """Points of the rays through undistorted pixels, shape (n, 2), 1 m in front; shape (n, 3)."""
    flat = np.asarray(undistorted, dtype=np.float64)
    rays = np.column_stack([flat, np.ones(len(flat))]) @ np.linalg.inv(camera.matrix).T
    return np.asarray(rays)


def distort_pixels(camera: Camera, undistorted: Array) -> Array:
    """Applies the lens distortion to points, shape (..., 2), [px]; same shape."""
    rays = directions(camera, undistorted.reshape(-1, 2))
    return pixels_of(camera, rays).reshape(undistorted.shape)


def pixels_of(camera: Camera, points_in_camera: Array) -> Array:
    """Distorted pixels of points in front of the camera, shape (n, 3), [m]; shape (n, 2)."""
    return project(camera.lens, camera.matrix, camera.distortion, points_in_camera)


def reprojection_errors(camera: Camera, points: Array, undistorted: Array) -> Array:
    """Errors of points in the image, lens distortion included.

    Args:
        points: In front of it, camera frame, shape (..., 3), [m].
        undistorted: Where they are measured, shape (..., 2), [px] without distortion.

    Returns:
        Expected minus measured image pixels, shape (..., 2), [px].
    """
    expected = pixels_of(camera, points).reshape(undistorted.shape)
    return np.asarray(expected - distort_pixels(camera, undistorted))


def sight_offsets(camera: Camera, points: Array, undistorted: Array) -> Array:
    """Offsets of points from the lines of sight through pixels without distortion.

    Args:
        points: Camera frame, shape (n, 3), [m].
        undistorted: Shape (n, 2), [px].

    Returns:
        Shape (n, 3), [m].
    """
    rays = directions(camera, undistorted)
    along = np.sum(points * rays, axis=1) / np.sum(rays**2, axis=1)
    return np.asarray(points - along[:, None] * rays)


def rms(vectors: Array) -> Array:
    """Root mean square length of vectors, shape (..., n, k); shape (...)."""
    return np.asarray(np.sqrt(np.mean(np.sum(vectors**2, axis=-1), axis=-1)))


_ROUND_TRIP = 0.01
"""Pixels undistorted and distorted again return within this, [px], where the lens has rays."""


def has_rays(camera: Camera, pixels: Array) -> NDArray[np.bool_]:
    """Whether points, shape (..., 2), [px], can be undistorted: not 90° off the axis; (...)."""
    if not pixels.size:
        return np.ones(pixels.shape[:-1], dtype=np.bool_)
    back = distort_pixels(camera, undistort_pixels(camera, pixels))
    return np.asarray(np.abs(back - pixels).max(axis=-1) < _ROUND_TRIP)


def project_undistorted(camera: Camera, points_in_camera: Array) -> Array:
    """Undistorted pixels of points, shape (..., 3), [m]; shape (..., 2)."""
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
    """Refuses an image of another format than the camera's.

    Args:
        camera: The camera it should be from.

    Raises:
        BadInput: It is not an array of grey 8-bit pixels of the camera's size, or some are masked.
    """
    if not isinstance(image, np.ndarray):
        raise BadInput(
            f"expected an image as a NumPy array, not {type(image).__name__}",
            where=f"rig {rig}, camera {camera.name!r}",
            next_step="pass a grey image; `cv2.imread` returns None for a file it cannot read",
        )
    wanted = (camera.height, camera.width)
    if image.shape != wanted or image.dtype != np.uint8:
        size = " x ".join(map(str, image.shape[1::-1] if image.ndim > 1 else image.shape))
        raise BadInput(
            f"the image has {size} px ({image.dtype}, {image.ndim} dimensions); camera"
            f" {camera.name!r} takes grey 8-bit images of {wanted[1]} x {wanted[0]} px",
            where=f"rig {rig}",
            next_step="use full-size images of this camera, or correct the rig file",
        )
    require_real(image)  # none masked


# Gamma.


def linear(camera: Camera, image: Image) -> Image:
    """An image with grey levels in proportion to light, in which edges are where they are.

    A bright region looks larger in an image with gamma: half way between the grey levels of black
    and white there is less than half the light.

    Args:
        image: Grey, shape (h, w).
    """
    return image if camera.gamma == 1.0 else _by_table(image, _decoding(camera.gamma))


def encoded(camera: Camera, image: Image) -> Image:
    """The inverse of `linear`."""
    return image if camera.gamma == 1.0 else _by_table(image, _encoding(camera.gamma))


_LEVELS = np.arange(256) / 255.0


@cache
def _decoding(gamma: Gamma) -> NDArray[np.uint8]:
    """Light of each grey level. Source: IEC 61966-2-1 for sRGB."""
    if gamma == "srgb":
        light = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4)
    else:
        light = _LEVELS**gamma
    return _table(light)


@cache
def _encoding(gamma: Gamma) -> NDArray[np.uint8]:
    """Grey level of each light. Source: IEC 61966-2-1 for sRGB."""
    if gamma == "srgb":
        power = 1.055 * _LEVELS ** (1.0 / 2.4) - 0.055
        levels = np.where(_LEVELS <= 0.0031308, 12.92 * _LEVELS, power)
    else:
        levels = _LEVELS ** (1.0 / gamma)
    return _table(levels)


def _table(values: Array) -> NDArray[np.uint8]:
    table = np.round(255.0 * values).astype(np.uint8)
    table.flags.writeable = False
    return table


def _by_table(image: Image, table: Image) -> Image:
    return np.asarray(cv2.LUT(image, table), np.uint8)


def lever_arm_matrix(arm: Array) -> Array:
    """Maps the error twist of a frame to that of a body in it, shape (6, 6), world axes.

    Args:
        arm: From the frame's origin to the body's, world axes, shape (3,), [m].
    """
    by_frame = np.eye(6)
    by_frame[:3, 3:] = -skew(arm)
    return by_frame
