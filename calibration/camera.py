"""Camera matrix and lens distortion from pictures of a chessboard."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput
from cdpr.poses import Array, read_only

Image = NDArray[np.uint8]

#: Fewer pictures than this cannot be calibrated from; forty and more, tilted up to 40°, are good.
LEAST_VIEWS = 6
_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A printed chessboard.

    Attributes:
        columns: Inner corners along a row of squares.
        rows: Inner corners along a column.
        square: Side of a square, [m].
    """

    columns: int
    rows: int
    square: float

    def points(self) -> Array:
        """Inner corners in the board's plane, row after row, shape (n, 3), [m]."""
        grid = np.array([(x, y, 0.0) for y in range(self.rows) for x in range(self.columns)])
        return np.asarray(grid * self.square)


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera's matrix and distortion with what is known about their quality.

    Attributes:
        size: Width and height of the pictures, [px].
        matrix: Camera matrix, shape (3, 3), [px].
        distortion: k1, k2, p1, p2, k3; shape (5,).
        deviations: Standard deviations by name (fx, fy, cx, cy in px; the rest without unit), as
            the least-squares fit states them; real errors are a few times larger.
        view_errors: RMS distance of each used picture's corners, by name, [px].
        unused: Pictures in which the board was not found.
        data_hash: Of the corners it rests on.
    """

    size: tuple[int, int]
    matrix: Array
    distortion: Array
    deviations: dict[str, float]
    view_errors: dict[str, float]
    unused: tuple[str, ...]
    data_hash: str

    @property
    def error(self) -> float:
        """RMS distance over all pictures, [px]; small also when too little is covered."""
        return float(np.sqrt(np.mean(np.square(list(self.view_errors.values())))))


def find_board(image: Image, board: Chessboard) -> Array | None:
    """Inner corners of the board, shape (n, 2), [px], or None when it is not seen whole."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def calibrate_camera(pictures: Iterable[tuple[str, Image]], board: Chessboard) -> CameraCalibration:
    """Fits a pinhole with five distortion coefficients.

    Args:
        pictures: Names and grey pictures of one size.
        board: What they show.

    Raises:
        BadInput: Pictures of different sizes, or too few with the whole board.
    """
    views: dict[str, Array] = {}
    unused: list[str] = []
    size: tuple[int, int] | None = None
    for name, image in pictures:
        own = (image.shape[1], image.shape[0])
        size = size or own
        if own != size:
            raise BadInput(
                f"the picture has {own[0]} x {own[1]} px, the ones before {size[0]} x {size[1]} px",
                where=name,
                next_step="use pictures of one camera in one size",
            )
        corners = find_board(image, board)
        if corners is None:
            unused.append(name)
        else:
            views[name] = corners
    if size is None or len(views) < LEAST_VIEWS:
        raise BadInput(
            f"the whole board is to be seen in {len(views)} of {len(views) + len(unused)} pictures;"
            f" {LEAST_VIEWS} are the least",
            why=f"a board of {board.columns} x {board.rows} inner corners was looked for",
            next_step="check the board's numbers, or take more pictures of it, tilted up to 40°",
        )
    return calibrate_from_corners(views, board, size, tuple(unused))


def calibrate_from_corners(
    views: dict[str, Array], board: Chessboard, size: tuple[int, int], unused: tuple[str, ...] = ()
) -> CameraCalibration:
    """Fits the camera to the board's corners in each picture, shape (n, 2), [px], by name."""
    points = board.points().astype(np.float32)
    seen = [corners.astype(np.float32).reshape(-1, 1, 2) for corners in views.values()]
    nothing = np.zeros(0)
    _, matrix, distortion, _, _, deviations, _, errors = cv2.calibrateCameraExtended(
        [points] * len(seen), seen, size, np.eye(3), nothing
    )
    digest = hashlib.sha256()
    for name, corners in views.items():
        digest.update(name.encode() + np.ascontiguousarray(np.round(corners, 6)).tobytes())
    return CameraCalibration(
        size=size,
        matrix=read_only(matrix),
        distortion=read_only(np.ravel(distortion)[:5]),
        deviations=dict(zip(_NAMES, np.ravel(deviations).tolist(), strict=False)),
        view_errors=dict(zip(views, np.ravel(errors).tolist(), strict=True)),
        unused=unused,
        data_hash=digest.hexdigest(),
    )
