"""Images of boards by a camera with known parameters."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

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
def sample_rays(distortion: tuple[float, ...] = tuple(DISTORTION)) -> NDArray[np.float32]:
    """Rays (x, y, 1) of 2 x 2 samples per pixel, camera frame, x and y; cached for all images."""
    columns = (np.arange(SIZE[0] * _SUB) + 0.5) / _SUB - 0.5
    rows = (np.arange(SIZE[1] * _SUB) + 0.5) / _SUB - 0.5
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    flat = cv2.undistortPoints(pixels, MATRIX, np.array(distortion), criteria=stop)
    return flat.reshape(SIZE[1] * _SUB, SIZE[0] * _SUB, 2).astype(np.float32)


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
    eye = -pose.rotation.T @ pose.position
    # From a ray to where it meets the board, in pixels of the print, times its way to the board.
    across = (eye[:2] + origin)[:, None] * pose.rotation[:, 2] - eye[2] * pose.rotation[:, :2].T
    to_print = np.vstack([across / pixel - 0.5 * pose.rotation[:, 2], pose.rotation[:, 2]])
    met = cv2.transform(sample_rays(distortion)[rows, columns], to_print.astype(np.float32))
    found = met[..., :2] / met[..., 2:]
    fine = np.full((SIZE[1] * _SUB, SIZE[0] * _SUB), 150.0, np.float32)
    fine[rows, columns] = cv2.remap(
        print_.astype(np.float32), found, None, cv2.INTER_LINEAR, borderValue=150.0
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
    sides = [np.broadcast_arrays(x, end) for end in y[[0, -1]]]
    sides += [np.broadcast_arrays(end, y) for end in x[[0, -1]]]
    rim = np.concatenate([np.column_stack(side) for side in sides])
    points = np.column_stack([rim - origin, np.zeros(len(rim))])
    zero = np.zeros(3)
    pixels = cv2.projectPoints(pose.apply(points), zero, zero, MATRIX, np.array(distortion))[0]
    low, high = pixels.reshape(-1, 2).min(axis=0), pixels.reshape(-1, 2).max(axis=0)
    first = np.clip(np.floor(low - 4.0) * _SUB, 0, np.array(SIZE) * _SUB).astype(int)
    last = np.clip(np.ceil(high + 4.0) * _SUB, 0, np.array(SIZE) * _SUB).astype(int)
    return slice(first[1], last[1]), slice(first[0], last[0])


def with_noise(image: np.ndarray, seed: int) -> np.ndarray:
    """An image with the noise of a sensor."""
    noise = np.random.default_rng(seed).standard_normal(image.shape, np.float32)
    return np.clip(image + np.float32(1.5) * noise, 0.0, 255.0).round().astype(np.uint8)
