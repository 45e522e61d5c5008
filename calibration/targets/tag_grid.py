"""Grids of tags: their corners, in a picture that may show a part only.

Kalibr's AprilGrid numbers its tags from the bottom left and its rows upward, draws borders of two
modules, and lets a black square touch each corner of a tag, so that corners are saddles as those of
a chessboard.

Source: ethz-asl/kalibr, kalibr_create_target_pdf and GridCalibrationTargetAprilgrid.cpp.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from calibration.targets.board import LEAST_POINTS, Seen, plain_camera, require_board
from model.files.camera_file import FAMILIES, tags_in
from model.pose import Array
from tracking.camera_model import Image
from tracking.detection.detector import TagDetector
from tracking.detection.diagnostics import diagnose_tags
from tracking.detection.tags import CORNER_SIGNS, dictionary, modules_across, upright_corners
from tracking.edges.refine import refine

TagOrder = Literal["rows", "kalibr"]
ORDERS = {
    "rows": "numbered from the top left, rows downward",
    "kalibr": "numbered from the bottom left, rows upward, as Kalibr prints them",
}
"""How tags are numbered, by name."""
_SADDLE = 0.12
"""Half of the window a corner is refined in where black squares touch it, in sides of a tag."""
_BETTER, _OFF = 3.0, 0.05
"""The other order is right where it fits better by this factor, and ours misfits by that share of a
tag's side."""


@dataclass(frozen=True)
class TagGrid:
    """A grid of AprilTags, numbered row after row; parts of it will do.

    Attributes:
        columns: Tags along a row.
        rows: Tags along a column.
        tag: Side of a tag's black square, [m].
        gap: Between neighbouring black squares, [m].
        family: One of `model.files.rig_file.FAMILIES`.
        first: The smallest number: of the tag at the top left, or at the bottom left.
        order: One of `ORDERS`.
    """

    columns: int
    rows: int
    tag: float
    gap: float
    family: str
    first: int = 0
    order: str = "rows"

    def __post_init__(self) -> None:
        """Refuses boards that cannot be.

        Raises:
            BadInput: Too few tags, sizes that are none, an unknown family, or numbers that it
                does not have.
        """
        require_board(self.columns * self.rows >= 4, "a tag grid needs 4 tags")
        require_board(min(self.columns, self.rows) >= 1, "a tag grid needs a row and a column")
        require_board(self.tag > 0.0, "the side of a tag must be above 0 mm")
        require_board(self.gap > 0.0, "the gap between tags must be above 0 mm")
        require_board(
            self.family in FAMILIES,
            f"unknown tag family {self.family!r}",
            f"use one of {', '.join(FAMILIES)}",
        )
        require_board(
            self.order in ORDERS,
            f"unknown order of tags {self.order!r}",
            f"use one of {', '.join(ORDERS)}",
        )
        last = self.first + self.columns * self.rows - 1
        require_board(
            self.first >= 0 and last < tags_in(self.family),
            f"{self.family} has the tags 0 to {tags_in(self.family) - 1}; the grid needs"
            f" {self.first} to {last}",
            "choose a smaller first number, fewer tags or a larger family",
        )

    def __str__(self) -> str:
        """Its kind, size and numbers."""
        last = self.first + self.columns * self.rows - 1
        return f"a grid of {self.columns} x {self.rows} tags, {self.family} {self.first} to {last}"

    def find(self, image: Image) -> Seen | None:
        """The corners of its tags, as far as these are to be seen whole.

        Black and white may be exchanged. None, too, where the numbers contradict the order and the
        other order fits.
        """
        seen = self._seen_in(image)
        return self._seen_in(np.asarray(255 - image)) if seen is None else seen

    def _seen_in(self, image: Image) -> Seen | None:
        squares, twice = self._edges(image)
        if self.order == "kalibr":  # printed by Kalibr, or by others with narrow borders
            squares, twice = max((squares, twice), self._saddles(image), key=lambda f: len(f[0]))
        if 4 * len(squares) < LEAST_POINTS:
            return None
        corners = np.concatenate(list(squares.values()))
        other = replace(self, order=self._other_order())
        ours, others = (grid._misfit(squares) for grid in (self, other))
        if ours > max(_BETTER * others, _OFF):
            return None
        return Seen(self.points_of(squares), corners, twice)

    def _edges(self, image: Image) -> tuple[dict[int, Array], tuple[int, ...]]:
        """Corners of tags by number where their edges meet, and numbers seen more than once."""
        numbers = range(self.first, self.first + self.columns * self.rows)
        detected = [d for d in self._detector.detect_all(image) if d.id in numbers]
        counts = Counter(d.id for d in detected)
        detected = [d for d in detected if counts[d.id] == 1]
        rough = np.array([d.corners for d in detected]).reshape(-1, 4, 2)
        # An edge is short: its bend by the lens does not count.
        lens = plain_camera((image.shape[1], image.shape[0]))
        squares = refine(image, lens, rough, modules_across(self.family))
        whole = {d.id: s.corners for d, s in zip(detected, squares, strict=True) if s and s.whole}
        return whole, tuple(number for number, count in counts.items() if count > 1)

    def _saddles(self, image: Image) -> tuple[dict[int, Array], tuple[int, ...]]:
        """As `_edges`, of tags with wide borders whose corners black squares touch."""
        found, ids, _ = self._wide_detector.detectMarkers(image)
        numbers = [int(n) for n in np.ravel(ids)] if found else []
        counts = Counter(numbers)
        last = self.first + self.columns * self.rows
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        squares: dict[int, Array] = {}
        for number, square in zip(numbers, found, strict=True):
            if counts[number] > 1 or not self.first <= number < last:
                continue
            corners = upright_corners(self.family, np.reshape(square, (4, 2)))
            side = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min()
            half = max(2, int(_SADDLE * side))
            start = corners.astype(np.float32).reshape(-1, 1, 2)
            better = cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)
            squares[number] = np.asarray(better, dtype=np.float64).reshape(4, 2)
        return squares, tuple(number for number, count in counts.items() if count > 1)

    def _misfit(self, squares: dict[int, Array]) -> float:
        """RMS distance of corners from the nearest flat view of the board, in sides of a tag."""
        corners = np.concatenate(list(squares.values()))
        plane = self.points_of(squares)[:, :2] / self.tag
        back, _ = cv2.findHomography(corners, plane)
        if np.shape(back) != (3, 3):
            return float("inf")
        there = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), back).reshape(-1, 2)
        return float(np.sqrt(np.mean(np.sum((there - plane) ** 2, axis=1))))

    def _other_order(self) -> str:
        return next(order for order in ORDERS if order != self.order)

    def instead(self, image: Image) -> str:
        """The tags in another order, else tags that the picture shows."""
        other = self._other_order()
        if replace(self, order=other).find(image) is not None:
            return f"these tags {ORDERS[other]}: try --order {other}"
        return diagnose_tags(image, self.family, [])

    def points_of(self, numbers: Iterable[int]) -> Array:
        """Corners of tags in the board's plane, y down the rows, shape (4 n, 3), [m]."""
        return np.concatenate([self._corners_of(number) for number in numbers])

    def _corners_of(self, number: int) -> Array:
        """Corners of a tag in the board's plane, y down the rows, shape (4, 3), [m]."""
        row, column = self.position_of(number)
        step, middle = self.tag + self.gap, self.tag / 2.0
        flat = CORNER_SIGNS * [middle, -middle] + [column * step + middle, row * step + middle]
        return np.column_stack([flat, np.zeros(4)])

    def position_of(self, number: int) -> tuple[int, int]:
        """Row from the top and column of a tag."""
        row, column = divmod(number - self.first, self.columns)
        return (row if self.order == "rows" else self.rows - 1 - row), column

    @cached_property
    def _detector(self) -> TagDetector:
        return TagDetector(self.family)

    @cached_property
    def _wide_detector(self) -> cv2.aruco.ArucoDetector:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        parameters.markerBorderBits = 2
        return cv2.aruco.ArucoDetector(dictionary(self.family), parameters)
