"""Images of boards by a camera with known parameters."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from model.pose import Array, Pose, matrix_from_rotation_vector

SIZE = (640, 480)
MATRIX = np.array([[600.0, 0.0, 322.0], [0.0, 603.0, 238.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.05, 0.0008, -0.0006, 0.0])
_SUB = 2


def poses_before_the_camera(
    middle: Array, count: int, seed: int = 4, spread: float = 0.06
) -> list[Pose]:
    """Tilted board poses whose centre, board frame, shape (3,), [m], is near the image centre."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        turn = matrix_from_rotation_vector(rng.uniform(-0.6, 0.6, 3))
        position = np.array([*rng.uniform(-spread, spread, 2), rng.uniform(0.4, 0.6)])
        poses.append(Pose(position - turn @ middle, turn))
    return poses


@cache
def sample_rays(distortion: tuple[float, ...] = tuple(DISTORTION)) -> Array:
    """Rays of 2 x 2 samples per pixel, camera frame, shape (n, 3); cached for all images."""
    columns = (np.arange(SIZE[0] * _SUB) + 0.5) / _SUB - 0.5
    rows = (np.arange(SIZE[1] * _SUB) + 0.5) / _SUB - 0.5
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    lens = np.array(distortion)
    flat = cv2.undistortPoints(pixels, MATRIX, lens, criteria=stop).reshape(-1, 2)
    return np.column_stack([flat, np.ones(len(flat))])


def picture_of(
    print_: np.ndarray,
    pixel: float,
    origin: Array,
    pose: Pose,
    distortion: tuple[float, ...] = tuple(DISTORTION),
) -> np.ndarray:
    """Image of a print on a board in front of a grey wall.

    Args:
        print_: Grey image of the print.
        pixel: Side of its pixels, [m].
        origin: Where the board's origin is on it, shape (2,), [m] from its top left corner.
        pose: Of the board's frame, whose x and y run along the print's, in the camera's.
        distortion: Of the lens.
    """
    rows, columns = _around(print_.shape, pixel, origin, pose, distortion)
    rays = sample_rays(distortion).reshape(SIZE[1] * _SUB, -1, 3)[rows, columns] @ pose.rotation
    eye = -pose.rotation.T @ pose.position
    on_board = eye[:2] + (-eye[2] / rays[..., 2])[..., None] * rays[..., :2]
    found = ((on_board + origin) / pixel - 0.5).astype(np.float32)
    fine = np.full((SIZE[1] * _SUB, SIZE[0] * _SUB), 150.0, np.float32)
    fine[rows, columns] = cv2.remap(
        print_.astype(np.float32),
        found[..., 0],
        found[..., 1],
        cv2.INTER_LINEAR,
        borderValue=150.0,
    )
    return np.round(cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)).astype(np.uint8)


def _around(
    shape: tuple[int, ...],
    pixel: float,
    origin: Array,
    pose: Pose,
    distortion: tuple[float, ...],
) -> tuple[slice, slice]:
    """Rows and columns of the samples that may show a print; see `picture_of`."""
    y, x = (np.linspace(-1.0, size + 1.0, 30) * pixel for size in shape[:2])
    rim = [(a, b) for a in x for b in y if a in x[[0, -1]] or b in y[[0, -1]]]
    points = np.column_stack([np.array(rim) - origin, np.zeros(len(rim))])
    zero = np.zeros(3)
    pixels = cv2.projectPoints(pose.apply(points), zero, zero, MATRIX, np.array(distortion))[0]
    low, high = pixels.reshape(-1, 2).min(axis=0), pixels.reshape(-1, 2).max(axis=0)
    first = np.clip(np.floor(low - 4.0) * _SUB, 0, np.array(SIZE) * _SUB).astype(int)
    last = np.clip(np.ceil(high + 4.0) * _SUB, 0, np.array(SIZE) * _SUB).astype(int)
    return slice(first[1], last[1]), slice(first[0], last[0])


def with_noise(image: np.ndarray, seed: int) -> np.ndarray:
    """An image with the noise of a sensor."""
    noise = np.random.default_rng(seed).normal(scale=1.5, size=image.shape)
    return np.clip(image + noise, 0.0, 255.0).round().astype(np.uint8)
