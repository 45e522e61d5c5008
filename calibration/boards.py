"""Calibration boards: where their points are, and finding these in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput
from cdpr.poses import Array, Pose
from cdpr.rig import Camera
from cdpr.tag_families import FAMILIES
from tracking.detector import TagDetector
from tracking.edges import refine
from tracking.marks import CORNER_SIGNS, modules_across
from tracking.picture import Image

LEAST_POINTS = 8
"""Of a board in a picture: fewer say too little about its pose."""

_WINDOW = 0.3
"""Half of the window a corner is refined in, as part of the way to the next."""

_ARUCO = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_") and name.isupper()
}
DICTIONARIES = tuple(sorted(_ARUCO))
"""Names of the dictionaries of ArUco markers, such as 4X4_50."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A board in a picture.

    Attributes:
        points: In the board's plane, shape (n, 3), [m].
        corners: Where they are in the picture, shape (n, 2), [px].
    """

    points: Array
    corners: Array


class Board(Protocol):
    """What `calibration.camera` needs of a board."""

    def find(self, image: Image) -> Seen | None:
        """The board in a grey picture; None where too little of it is to be seen."""
        ...

    def __str__(self) -> str:
        """What was looked for, for messages."""
        ...


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A printed chessboard; all of it must be in the picture.

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
        _require(min(self.columns, self.rows) >= 3, "a chessboard needs 3 inner corners a side")
        _require(self.square > 0.0, "the side of a square must be above 0 mm")

    def __str__(self) -> str:
        """Its kind and size."""
        return f"a chessboard of {self.columns} x {self.rows} inner corners"

    def points(self) -> Array:
        """Inner corners in the board's plane, row after row, shape (n, 3), [m]."""
        grid = np.array([(x, y, 0.0) for y in range(self.rows) for x in range(self.columns)])
        return np.asarray(grid * self.square)

    def find(self, image: Image) -> Seen | None:
        """Its inner corners."""
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        try:
            size = (self.columns, self.rows)
            found, corners = cv2.findChessboardCornersSB(image, size, flags=flags)
        except cv2.error:  # as for pictures too small to hold the board
            return None
        if not found:
            return None
        return Seen(self.points(), self._refined(image, np.asarray(corners, np.float32)))

    def _refined(self, image: Image, corners: NDArray[np.float32]) -> Array:
        """Corners at the saddles of brightness, which halves the error; shape (n, 2), [px].

        A window holds one corner only: less than half of the way to the next.
        """
        grid = corners.reshape(self.rows, self.columns, 2)
        gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
        half = int(np.clip(_WINDOW * min(gaps), 2, 11))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        better = cv2.cornerSubPix(image, corners.reshape(-1, 1, 2), (half, half), (-1, -1), stop)
        return np.asarray(better, dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class Charuco:
    """A chessboard with ArUco markers in its white squares; parts of it will do.

    Attributes:
        columns: Squares along a row.
        rows: Squares along a column.
        square: Side of a square, [m].
        marker: Side of a marker, [m].
        dictionary: One of `DICTIONARIES`.
        legacy: Whether the first square is as OpenCV drew it before 4.6, where the number of rows
            is even.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        """Refuses boards that cannot be.

        Raises:
            BadInput: Too few squares, a marker that does not fit its square, or a dictionary that
                is not known or has too few markers.
        """
        _require(min(self.columns, self.rows) >= 3, "a ChArUco board needs 3 squares a side")
        _require(0.0 < self.marker < self.square, "a marker must be smaller than its square")
        _require(
            self.dictionary in _ARUCO,
            f"unknown dictionary {self.dictionary!r}",
            f"use one of {', '.join(DICTIONARIES)}",
        )
        markers = cv2.aruco.getPredefinedDictionary(_ARUCO[self.dictionary]).bytesList.shape[0]
        wanted = self.columns * self.rows // 2
        _require(
            markers >= wanted,
            f"dictionary {self.dictionary} has {markers} markers, the board needs {wanted}",
            "check the dictionary's name",
        )

    def __str__(self) -> str:
        """Its kind, size and dictionary."""
        return f"a ChArUco board of {self.columns} x {self.rows} squares with {self.dictionary}"

    def find(self, image: Image) -> Seen | None:
        """Its inner corners, as far as they are to be seen."""
        corners, numbers, _, _ = self._detector.detectBoard(image)
        if np.size(numbers) < LEAST_POINTS:  # None where there is none
            return None
        points = np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        chosen = points[np.ravel(numbers)]
        if _in_a_line(chosen):
            return None
        return Seen(chosen, np.asarray(corners, dtype=np.float64).reshape(-1, 2))

    def markers(self) -> list[tuple[Array, NDArray[np.bool_]]]:
        """Top left corner in the board's plane, shape (2,), [m], and white modules of each."""
        dictionary = self._board.getDictionary()
        side = dictionary.markerSize + 2
        numbers = [int(number) for number in np.ravel(self._board.getIds())]
        return [
            (
                np.asarray(corners, dtype=np.float64)[0, :2],
                np.asarray(cv2.aruco.generateImageMarker(dictionary, number, side) > 127),
            )
            for number, corners in zip(numbers, self._board.getObjPoints(), strict=True)
        ]

    @cached_property
    def _board(self) -> cv2.aruco.CharucoBoard:
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square,
            self.marker,
            cv2.aruco.getPredefinedDictionary(_ARUCO[self.dictionary]),
        )
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._board)


@dataclass(frozen=True)
class TagGrid:
    """A grid of AprilTags, numbered row after row from the top left; parts of it will do.

    Attributes:
        columns: Tags along a row.
        rows: Tags along a column.
        tag: Side of a tag's black square, [m].
        gap: Between neighbouring black squares, [m].
        family: One of `cdpr.tag_families.FAMILIES`.
        first: Number of the tag at the top left.
    """

    columns: int
    rows: int
    tag: float
    gap: float
    family: str
    first: int = 0

    def __post_init__(self) -> None:
        """Refuses boards that cannot be.

        Raises:
            BadInput: Too few tags, sizes that are none, or an unknown family.
        """
        _require(self.columns * self.rows >= 4, "a tag grid needs 4 tags")
        _require(min(self.columns, self.rows) >= 1, "a tag grid needs a row and a column")
        _require(self.tag > 0.0, "the side of a tag must be above 0 mm")
        _require(self.gap > 0.0, "the gap between tags must be above 0 mm")
        _require(
            self.family in FAMILIES,
            f"unknown tag family {self.family!r}",
            f"use one of {', '.join(FAMILIES)}",
        )

    def __str__(self) -> str:
        """Its kind, size and numbers."""
        last = self.first + self.columns * self.rows - 1
        return f"a grid of {self.columns} x {self.rows} tags, {self.family} {self.first} to {last}"

    def find(self, image: Image) -> Seen | None:
        """The corners of its tags, as far as these are to be seen whole."""
        detected = [
            d
            for d in self._detector.detect(image)
            if 0 <= d.id - self.first < self.columns * self.rows
        ]
        rough = np.array([d.corners for d in detected]).reshape(-1, 4, 2)
        lens = _plain_camera(image)  # an edge is short: its bend by the lens does not count
        squares = refine(image, lens, rough, modules_across(self.family))
        whole = [(d.id, s) for d, s in zip(detected, squares, strict=True) if s and s.whole]
        if 4 * len(whole) < LEAST_POINTS:
            return None
        points = np.concatenate([self._corners_of(number) for number, _ in whole])
        return Seen(points, np.concatenate([square.corners for _, square in whole]))

    def _corners_of(self, number: int) -> Array:
        """Corners of a tag in the board's plane, y down the rows, shape (4, 3), [m]."""
        row, column = divmod(number - self.first, self.columns)
        step, middle = self.tag + self.gap, self.tag / 2.0
        flat = CORNER_SIGNS * [middle, -middle] + [column * step + middle, row * step + middle]
        return np.column_stack([flat, np.zeros(4)])

    @cached_property
    def _detector(self) -> TagDetector:
        return TagDetector(self.family)


def mirrored(board: Board, image: Image) -> bool:
    """Whether a picture shows the board only when it is flipped over."""
    return board.find(np.ascontiguousarray(image[:, ::-1])) is not None


def _require(holds: bool, what: str, next_step: str = "check the numbers of the board") -> None:
    if not holds:
        raise BadInput(what, next_step=next_step)


def _in_a_line(points: Array) -> bool:
    """Whether points do not span the board's plane."""
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    return bool(np.linalg.svd(flat, compute_uv=False)[1] < 1e-9)


def _plain_camera(image: Image) -> Camera:
    height, width = image.shape
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return Camera("plain", width, height, matrix, np.zeros(5), Pose.level([0.0, 0.0, 0.0]), 1.0)
