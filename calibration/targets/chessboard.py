"""Chessboards: their inner corners in an image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from calibration.targets.board import Seen, require_board
from model.pose import Array
from tracking.camera_model import Image

_WINDOW = 0.3
"""Half of the window a corner is refined in, as part of the way to the next."""
_SEARCHED = 1600
"""Longer side of the image in which the board is looked for, [px]."""
_LARGEST, _SHARE = 11, 120
"""At most this many pixels, or this share of the image width: large images are softer."""


def _classic(image: Image, size: tuple[int, int]) -> tuple[bool, object]:
    return cv2.findChessboardCorners(image, size)


def _sectors(flags: int) -> Callable[[Image, tuple[int, int]], tuple[bool, object]]:
    return lambda image, size: cv2.findChessboardCornersSB(image, size, flags=flags)


_FINDERS = (
    _classic,
    _sectors(cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE),
    _sectors(0),
    _sectors(cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY),
)
"""OpenCV's finders, the fastest first: each finds boards that another one loses."""


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A printed chessboard; all of it must be in the image.

    Attributes:
        columns: Inner corners along a row of squares.
        rows: Inner corners along a column.
        square: Side of a square, [m].
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        """Refuses boards that cannot be.

        Raises:
            BadInput: Fewer than three inner corners a side, or a square without a size.
        """
        require_board(
            min(self.columns, self.rows) >= 3,
            "a chessboard needs at least 3 inner corners per side",
        )
        require_board(self.square > 0.0, "the side of a square must be above 0 mm")

    def __str__(self) -> str:
        """Its kind and size."""
        return f"a chessboard of {self.columns} x {self.rows} inner corners"

    def points(self) -> Array:
        """Inner corners in the board's plane, row after row, shape (n, 3), [m]."""
        grid = np.array([(x, y, 0.0) for y in range(self.rows) for x in range(self.columns)])
        return np.asarray(grid * self.square)

    def find(self, image: Image) -> Seen | None:
        """Its inner corners; in large images they are looked for in a smaller copy first."""
        rough = None
        if (times := max(image.shape) / _SEARCHED) > 1.0:
            size = (round(image.shape[1] / times), round(image.shape[0] / times))
            small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            found = self._found(small)
            scale = np.array([image.shape[1], image.shape[0]]) / size
            rough = None if found is None else (found + 0.5) * scale - 0.5
        rough = self._found(image) if rough is None else rough
        return None if rough is None else Seen(self.points(), self._refined(image, rough))

    def _found(self, image: Image) -> Array | None:
        """Its inner corners roughly, by the first finder that finds all, shape (n, 2), [px]."""
        for finder in _FINDERS:
            try:
                found, corners = finder(image, (self.columns, self.rows))
            except cv2.error:  # as for pictures too small to hold the board
                continue
            if found:
                return np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        return None

    def instead(self, image: Image) -> str:
        """Inner corners of another chessboard that the image shows."""
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        try:
            found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags=flags)
        except cv2.error:  # as for images too small to hold a board
            return ""
        if not found:
            return ""
        columns, rows = max(meta.shape), min(meta.shape)  # a board does not show its orientation
        return f"a chessboard of {columns} x {rows} inner corners, or part of one"

    def _refined(self, image: Image, corners: Array) -> Array:
        """Corners at the saddles of brightness, which halves the error; shape (n, 2), [px].

        A window holds one corner only: less than half of the way to the next.
        """
        grid = corners.reshape(self.rows, self.columns, 2)
        gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
        largest = max(_LARGEST, image.shape[1] / _SHARE)
        half = int(np.clip(_WINDOW * min(gaps), 2, largest))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        start = corners.astype(np.float32).reshape(-1, 1, 2)
        better = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)
        return np.asarray(better, dtype=np.float64).reshape(-1, 2)
