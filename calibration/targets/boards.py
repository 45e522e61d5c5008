"""Calibration boards: their interface, chessboards and ChArUco boards."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.frame_reader import silent_opencv
from model.errors import BadInput, require_fields
from model.files.camera_file import FAMILIES
from model.files.csv_table import CsvTable
from model.pose import Array, read_only
from model.rig import Camera
from tracking.camera_model import Image
from tracking.detection.detector import TagDetector
from tracking.detection.diagnostics import UNIT_SQUARE, diagnose_tags, printed_share

LEAST_POINTS = 8
"""Minimum corners in an image: fewer do not determine the board's pose."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectedBoard:
    """Corners of a board detected in one image.

    Attributes:
        points: In the board's plane, shape (n, 3), [m].
        corners: Where they are in the image, shape (n, 2), [px].
        twice: Numbers of markers or tags left out because they were detected more than once: it is
            unknown which of them is on the board.
        marker: Side of a ChArUco board's markers by its corners and their edges, [m], within 2 %,
            or up to 5 % too small beside paper narrower than 2 px; NaN if unknown.
    """

    points: Array
    corners: Array
    twice: tuple[int, ...] = ()
    marker: float = math.nan


@runtime_checkable
class Board(Protocol):
    """Interface of a board for `calibration.intrinsics.calibrate`.

    Attributes:
        needs_lens: Whether its corners are biased by lens distortion unless the lens is known.
    """

    needs_lens: ClassVar[bool]

    def find(self, image: Image, camera: Camera | None = None) -> DetectedBoard | None:
        """Detects the board in a grey image; None where too little of it is visible.

        Args:
            image: The image.
            camera: That took it; one without distortion is assumed when left out.
        """

    def describe_other(self, image: Image) -> str:
        """What an image without the board shows instead, for messages; empty if unknown."""

    def __str__(self) -> str:
        """The board, for messages."""


def is_mirrored(board: Board, image: Image) -> bool:
    """Whether an image shows the board mirrored."""
    return board.find(np.ascontiguousarray(image[:, ::-1])) is not None


def require_board(
    holds: bool, what: str, next_step: str = "check the dimensions of the board"
) -> None:
    """Refuses impossible boards.

    Raises:
        BadInput: ``holds`` is false.
    """
    if not holds:
        raise BadInput(what, next_step=next_step)


# Corners detected by another program, from a CSV file (docs/data-formats.md).

_COLUMNS = ("picture", "x_px", "y_px", "board_x_mm", "board_y_mm")


def read_corners(path: Path) -> tuple[dict[str, DetectedBoard], dict[str, str]]:
    """Corners of a flat board by image, as detected by another program; why others are unused.

    Raises:
        BadInput: The file cannot be read, a column is missing, a value is not a number, or no
            image shows `LEAST_POINTS` that are not in one line.
    """
    table = CsvTable(path)
    table.require(_COLUMNS)
    pictures, numbers = table.texts(_COLUMNS[0]), table.of(_COLUMNS[1:])
    found: dict[str, list[Array]] = {}
    for picture, values in zip(pictures, numbers, strict=True):
        found.setdefault(picture, []).append(values)
    seen, unused = {}, {}
    for picture, lines in found.items():
        pixels, board = np.hsplit(np.array(lines), 2)
        points = np.column_stack([board / 1e3, np.zeros(len(board))])
        if len(points) < LEAST_POINTS:
            unused[picture] = f"has fewer than {LEAST_POINTS} corners"
        elif _in_a_line(points):
            unused[picture] = "has corners in one line only"
        else:
            seen[picture] = DetectedBoard(read_only(points), read_only(pixels))
    if not seen:
        raise BadInput(
            f"no image has {LEAST_POINTS} corners that are not in one line",
            where=str(path),
            next_step="write a line for every corner: its image, pixels and position on the board",
        )
    return seen, unused


_WINDOW = 0.3
"""Half width of the refinement window, as a share of the distance to the next corner."""
_SEARCHED = 1600
"""Longer side of the image copy searched first, [px]."""
_LARGEST, _SHARE = 11, 120
"""Largest half width: pixels, or image width by this, as large images are softer."""


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
"""OpenCV's detectors, fastest first: each finds boards that another misses."""


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A printed chessboard; it must be completely in the image.

    Attributes:
        columns: Inner corners along a row of squares.
        rows: Inner corners along a column.
        square: Side of a square, [m].
    """

    columns: int
    rows: int
    square: float
    needs_lens: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Refuses impossible boards.

        Raises:
            BadInput: Too few inner corners, a square not above 0, or a value of another type.
        """
        require_fields(self)
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

    def find(self, image: Image, camera: Camera | None = None) -> DetectedBoard | None:
        """Detects its inner corners; a large image is searched in a smaller copy first."""
        rough = None
        if (times := max(image.shape) / _SEARCHED) > 1.0:
            size = (round(image.shape[1] / times), round(image.shape[0] / times))
            small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            found = self._found(small)
            scale = np.array([image.shape[1], image.shape[0]]) / size
            rough = None if found is None else (found + 0.5) * scale - 0.5
        rough = self._found(image) if rough is None else rough
        return None if rough is None else DetectedBoard(self.points(), self._refined(image, rough))

    def _found(self, image: Image) -> Array | None:
        """Approximate inner corners, from the first detector that finds all, shape (n, 2), [px]."""
        for finder in _FINDERS:
            try:
                found, corners = finder(image, (self.columns, self.rows))
            except cv2.error:  # such as for images too small for the board
                continue
            if found:
                return np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        return None

    def describe_other(self, image: Image) -> str:
        """Size of another chessboard that the image shows."""
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        try:
            found, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags=flags)
        except cv2.error:  # such as for images too small for a board
            return ""
        if not found:
            return ""
        columns, rows = max(meta.shape), min(meta.shape)  # a board does not show its orientation
        return f"a chessboard of {columns} x {rows} inner corners, or part of one"

    def _refined(self, image: Image, corners: Array) -> Array:
        """Corners refined to saddle points, which halves the error; shape (n, 2), [px].

        The window holds one corner only: less than half of the distance to the next.
        """
        grid = corners.reshape(self.rows, self.columns, 2)
        gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
        largest = max(_LARGEST, image.shape[1] / _SHARE)
        half = int(np.clip(_WINDOW * min(gaps), 2, largest))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        start = corners.astype(np.float32).reshape(-1, 1, 2)
        better = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)
        return np.asarray(better, dtype=np.float64).reshape(-1, 2)


# ChArUco boards: corners between markers; partial views suffice.


_LEAST_FOURS = 4
"""Markers of 16 modules give false detections: this many at once do not."""
_ARUCO = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in dir(cv2.aruco)
    if name.startswith("DICT_") and name.isupper()
}
_SMOOTHED, _SMOOTHED_LIMITS = 0.28, (1.0, 8.0)
"""Smoothing of the brightness around a corner: standard deviation as a share of the distance to the
nearest marker, and its limits, [px]."""
_REACH, _STEPS, _SETTLED = 4.0, 8, 0.01
"""Half width of the window in standard deviations, Newton steps, and the largest last one, [px]."""
_LEAST_CURVATURE = 1.0
"""Of a saddle, in squared grey levels; noise has less."""
DICTIONARIES = tuple(sorted(_ARUCO))
"""Names of the dictionaries of ArUco markers, such as 4X4_50."""


@dataclass(frozen=True)
class Charuco:
    """A chessboard with ArUco markers in its white squares; partial views suffice.

    Attributes:
        columns: Squares along a row.
        rows: Squares along a column.
        square: Side of a square, [m].
        marker: Side of a marker, [m].
        dictionary: One of `DICTIONARIES`.
        legacy: Whether a board with an even number of rows starts as OpenCV before 4.6 drew it.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str
    legacy: bool = False
    needs_lens: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Refuses impossible boards.

        Raises:
            BadInput: Too few squares, a marker that does not fit its square, a dictionary that is
                unknown or has too few markers, or another value for ``legacy``.
        """
        require_fields(self)
        require_board(min(self.columns, self.rows) >= 3, "a ChArUco board needs 3 squares per side")
        require_board(0.0 < self.marker < self.square, "a marker must be smaller than its square")
        require_board(
            self.dictionary in _ARUCO,
            f"unknown dictionary {self.dictionary!r}",
            f"use one of {', '.join(DICTIONARIES)}",
        )
        markers = cv2.aruco.getPredefinedDictionary(_ARUCO[self.dictionary]).bytesList.shape[0]
        wanted = self.columns * self.rows // 2
        require_board(
            markers >= wanted,
            f"dictionary {self.dictionary} has {markers} markers; the board needs {wanted}",
            "check the dictionary's name",
        )

    def __str__(self) -> str:
        """Its kind, size and dictionary."""
        return f"a ChArUco board of {self.columns} x {self.rows} squares with {self.dictionary}"

    def find(self, image: Image, camera: Camera | None = None) -> DetectedBoard | None:
        """Detects its visible inner corners; black and white may be inverted."""
        seen = self._seen_in(image)
        return self._seen_in(np.asarray(255 - image)) if seen is None else seen

    def _seen_in(self, image: Image) -> DetectedBoard | None:
        squares, markers, twice = self._markers_in(image)
        if not len(markers):
            return None
        corners, numbers, _, _ = self._detector.detectBoard(
            image, markerCorners=squares, markerIds=markers
        )
        if np.size(numbers) < LEAST_POINTS:  # None when nothing is detected
            return None
        # OpenCV's corners are refined in windows that contain parts of markers.
        rough = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        to_markers = rough[:, None] - np.reshape(squares, (-1, 2))
        better, found = _saddles(image, rough, np.linalg.norm(to_markers, axis=2).min(axis=1))
        points = np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        chosen = points[np.ravel(numbers)[found]]
        if len(chosen) < LEAST_POINTS or _in_a_line(chosen):
            return None
        around = self._squares(np.ravel(markers), chosen, better[found])
        modules = self._board.getDictionary().markerSize + 2
        share = printed_share(image, np.reshape(squares, (-1, 4, 2)), around, modules)
        return DetectedBoard(chosen, better[found], twice, share * self.square)

    def _squares(self, markers: NDArray[np.int32], points: Array, corners: Array) -> Array:
        """Corners of the squares around markers, shape (n, 4, 2), [px]; NaN if not detected."""
        seen = np.full((self.columns + 1, self.rows + 1, 2), np.nan)
        seen[tuple(np.round(points[:, :2] / self.square).astype(int).T)] = corners
        middles = np.mean(self._board.getObjPoints(), axis=1)[:, :2]
        own = np.where(markers < len(middles), markers, 0)  # 0 is at the edge, so NaN
        cells = (middles[own] / self.square).astype(int)[:, None] + UNIT_SQUARE.astype(int)
        return np.asarray(seen[cells[..., 0], cells[..., 1]])

    def describe_other(self, image: Image) -> str:
        """The board rotated or of OpenCV's other pattern, else tags and markers in the image."""
        exchanged = replace(self, columns=self.rows, rows=self.columns)
        for other in (exchanged, replace(exchanged, legacy=not self.legacy)):
            if self.columns != self.rows and other.find(image) is not None:
                legacy = " `legacy=True`" if other.legacy else ""
                return f"{other}: try `columns={other.columns}` `rows={other.rows}`{legacy}"
        if replace(self, legacy=not self.legacy).find(image) is not None:
            use = "without" if self.legacy else "with"
            drawn = "4.6 and later draw" if self.legacy else "before 4.6 drew"
            return f"the board as versions of OpenCV {drawn} it: try {use} `legacy=True`"
        family = self.dictionary if self.dictionary in FAMILIES else FAMILIES[-1]
        tags = diagnose_tags(image, family, [])
        fours = TagDetector("4X4_1000").detect(image)
        if len(fours) < _LEAST_FOURS:
            return tags
        return f"{tags}; 4X4 {', '.join(str(d.id) for d in fours)}"

    def _markers_in(
        self, image: Image
    ) -> tuple[list[NDArray[np.float32]], NDArray[np.int32], tuple[int, ...]]:
        """Markers, their numbers, and numbers left out because they appear more than once."""
        corners, found, _ = self._marker_detector.detectMarkers(image)
        numbers = np.array([], np.int32) if not corners else np.ravel(found).astype(np.int32)
        seen, counts = np.unique(numbers, return_counts=True)
        once = np.isin(numbers, seen[counts == 1])
        kept = [np.asarray(c, np.float32) for c, one in zip(corners, once, strict=True) if one]
        return kept, numbers[once].reshape(-1, 1), tuple(seen[counts > 1].tolist())

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
        dictionary = cv2.aruco.getPredefinedDictionary(_ARUCO[self.dictionary])
        size = (self.columns, self.rows)
        with silent_opencv():  # it warns about markers almost as large as their squares
            board = cv2.aruco.CharucoBoard(size, self.square, self.marker, dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def _marker_detector(self) -> cv2.aruco.ArucoDetector:
        return cv2.aruco.ArucoDetector(self._board.getDictionary())

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._board)


def _saddles(image: Image, rough: Array, gaps: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Saddle points of the smoothed brightness, by Newton's method.

    Squares and their blur are point-symmetric about a corner, so neither blur nor smoothing moves
    its saddle point, as long as the smoothing does not reach the markers.

    Args:
        rough: Approximate corners, shape (n, 2), [px].
        gaps: Distance from each to the nearest marker, shape (n,), [px].

    Returns:
        The points, shape (n, 2), [px], and whether each is a saddle nearer than the marker, (n,).
    """
    widths = np.clip(_SMOOTHED * gaps, *_SMOOTHED_LIMITS)[:, None]
    window = np.arange(-(reach := int(np.ceil(_REACH * widths.max()))), reach + 1)
    last = np.array(image.shape[::-1])[:, None] - 1
    found = rough
    for _ in range(_STEPS):
        pixels = np.round(found).astype(int)[:, :, None] + window
        x, y = np.clip(pixels, 0, last).transpose(1, 0, 2)
        brightness = image[y[:, :, None], x[:, None, :]].astype(np.float64)
        apart = (pixels - found[:, :, None]) / widths[:, None]
        weight = np.exp(-(apart**2) / 2.0)
        weight /= weight.sum(axis=2, keepdims=True)
        orders = np.stack([weight, weight * apart, weight * (apart**2 - 1.0)])
        by_x, by_y = orders.transpose(2, 1, 0, 3)
        # Derivatives, in widths: rows by y and columns by x, of the orders 0 to 2.
        slopes = by_y @ brightness @ by_x.transpose(0, 2, 1)
        x, y, xx, xy, yy = (slopes[:, *at] for at in ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0)))
        curvature = np.minimum(xx * yy - xy**2, -_LEAST_CURVATURE)
        step = np.column_stack([xy * y - yy * x, xy * x - xx * y]) / curvature[:, None] * widths
        found = np.clip(found + step, rough - gaps[:, None], rough + gaps[:, None])
    is_saddle = (np.abs(step).max(axis=1) < _SETTLED) & (curvature < -_LEAST_CURVATURE)
    return found, is_saddle


def _in_a_line(points: Array) -> bool:
    """Whether points are collinear, up to rounding."""
    along, across = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
    return bool(across <= 1e-4 * along)
