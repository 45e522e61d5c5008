"""Circle grids, with centres corrected for perspective, and grids of tags.

A circle is imaged as an ellipse whose centre is not the image of the circle's centre. The offset
follows from the grid's homography and the circles' diameter. Centres are darkness-weighted means
over the pixels of a circle, so they do not depend on the detector's thresholds.

A grid of tags may be visible in part. Kalibr's AprilGrid numbers its tags from the bottom left and
its rows upward, draws borders of two modules, and has a black square at each corner of a tag, so
that corners are saddle points as on a chessboard.

Source: Heikkilä, "Geometric camera calibration using circular control points", IEEE TPAMI 22(10),
2000, section 2.2 (bias of the centre of a projected circle); ethz-asl/kalibr,
kalibr_create_target_pdf and GridCalibrationTargetAprilgrid.cpp.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.targets.boards import LEAST_POINTS, DetectedBoard, generic_camera, require_board
from model.errors import truth_value
from model.pose import Array
from model.tag_families import FAMILIES, tags_in
from tracking.camera_model import Image
from tracking.detection.detector import TagDetector
from tracking.detection.diagnostics import diagnose_tags
from tracking.detection.tags import CORNER_SIGNS, dictionary, modules_across, upright_corners
from tracking.edges.refine import refine

_SEARCHED = 1600
"""Longer side of the image copy in which circles are detected, [px]."""
_LEAST_AREA, _LEAST_APART = 12.0, 4.0
"""Minimum area of a circle and distance between circles in that copy, [px²] and [px]."""
_WINDOW, _CORE = 1.3, 0.6
"""Radii of the window around a circle and of its dark core, in radii of the circle."""


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """Printed circles, dark on white or white on dark; all must be in the image.

    Attributes:
        columns: Circles along a row.
        rows: Rows.
        spacing: Between rows, [m]. In a symmetric grid also between columns; in an asymmetric one
            circles of a row are twice as far apart, and every other row is shifted by the
            spacing, the second one to the right.
        diameter: Of a circle, [m].
        asymmetric: Whether every other row is shifted.
    """

    columns: int
    rows: int
    spacing: float
    diameter: float
    asymmetric: bool = False

    def __post_init__(self) -> None:
        """Refuses impossible boards.

        Raises:
            BadInput: Too few circles, a size not above 0, circles that touch, or another value for
                ``asymmetric``.
        """
        truth_value("asymmetric", self.asymmetric)
        require_board(min(self.columns, self.rows) >= 3, "a circle grid needs 3 circles per side")
        apart = self.spacing * (np.sqrt(2.0) if self.asymmetric else 1.0)
        require_board(0.0 < self.diameter < apart, "circles must be larger than 0 mm and not touch")

    def __str__(self) -> str:
        """Its kind and size."""
        kind = "an asymmetric" if self.asymmetric else "a symmetric"
        return f"{kind} grid of {self.columns} x {self.rows} circles"

    def points(self) -> Array:
        """Centres in the board's plane, row after row, shape (n, 3), [m]."""
        step = 2.0 if self.asymmetric else 1.0
        grid = [
            (step * x + (y % 2 if self.asymmetric else 0), y, 0.0)
            for y in range(self.rows)
            for x in range(self.columns)
        ]
        return np.asarray(np.array(grid) * self.spacing)

    def find(self, image: Image) -> DetectedBoard | None:
        """Detects the centres of its circles, if all are visible."""
        times = max(1.0, max(image.shape) / _SEARCHED)
        small = image
        if times > 1.0:
            size = (round(image.shape[1] / times), round(image.shape[0] / times))
            small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        scale = np.array(image.shape[::-1]) / small.shape[::-1]
        for white, picture in ((False, small), (True, 255 - small)):
            found = self._found(np.asarray(picture))
            centres = None if found is None else self._upright((found + 0.5) * scale - 0.5)
            if centres is not None:
                dark = np.asarray(255 - image) if white else image
                return DetectedBoard(self.points(), self._refined(dark, centres))
        return None

    def describe_other(self, image: Image) -> str:
        """The same grid with rows and columns exchanged, or of the other kind."""
        others = [
            CircleGrid(*count, self.spacing, min(self.diameter, 0.9 * self.spacing), asymmetric)
            for count in ((self.rows, self.columns), (self.columns, self.rows))
            for asymmetric in (False, True)
        ]
        return next((str(g) for g in others if str(g) != str(self) and g.find(image)), "")

    def _found(self, image: Image) -> Array | None:
        """Approximate centres of dark circles, shape (n, 2), [px]."""
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID if self.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        detector = self._blob_detector(image)
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            size = (self.columns, self.rows)
            try:
                found, centres = cv2.findCirclesGrid(
                    image, size, flags=flags, blobDetector=detector
                )
            except cv2.error:  # such as for images too small for the board
                continue
            if found:
                return np.asarray(centres, dtype=np.float64).reshape(-1, 2)
        return None

    def _blob_detector(self, image: Image) -> cv2.SimpleBlobDetector:
        """For circles up to the largest that fit; OpenCV's default limit is 5000 px²."""
        parameters = cv2.SimpleBlobDetector.Params()
        parameters.minArea = _LEAST_AREA
        parameters.maxArea = float(max(5000.0, image.size / (self.columns * self.rows)))
        parameters.minDistBetweenBlobs = _LEAST_APART
        return cv2.SimpleBlobDetector.create(parameters)

    def _upright(self, centres: Array) -> Array | None:
        """Centres in an order without mirroring; None where there is none."""
        if self._homography(centres) is not None:
            return centres
        if self.asymmetric:
            return None
        flipped = centres.reshape(self.rows, self.columns, 2)[:, ::-1].reshape(-1, 2)
        return flipped if self._homography(flipped) is not None else None

    def _homography(self, centres: Array) -> Array | None:
        """Homography from board plane to image, (3, 3); None if mirrored or not found."""
        plane = self.points()[:, :2]
        turn, _ = cv2.findHomography(plane, centres)
        if np.shape(turn) != (3, 3) or np.linalg.det(turn) * np.sign(turn[2, 2]) <= 0.0:
            return None
        return np.asarray(turn, dtype=np.float64)

    def _refined(self, dark: Image, centres: Array) -> Array:
        """Images of the circles' centres, shape (n, 2), [px]."""
        turn = self._homography(centres)
        if turn is None:  # not after `_upright`
            return centres
        middles = np.array(
            [_centroid(dark, c, e) for c, e in zip(centres, self._ellipses(turn)[1], strict=True)]
        )
        return np.asarray(middles - self._ellipses(turn)[0])

    def _ellipses(self, turn: Array) -> tuple[Array, Array]:
        """The ellipses that are the circles' images.

        Returns:
            Their centres minus the images of the circles' centres, shape (n, 2), [px], and the
            matrices E of xᵀE⁻¹x = 1 about the ellipse centres, shape (n, 2, 2), [px²].
        """
        offsets, shapes = [], []
        for x, y, _ in self.points().tolist():
            move = np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])
            there = turn @ move
            # Dual of the circle x² + y² = r² is diag(r², r², −1); it maps by H C* Hᵀ.
            dual = there @ np.diag([self.diameter**2 / 4.0] * 2 + [-1.0]) @ there.T
            dual = dual / dual[2, 2]
            middle = dual[:2, 2]
            offsets.append(middle - there[:2, 2] / there[2, 2])
            shapes.append(np.outer(middle, middle) - dual[:2, :2])
        return np.array(offsets), np.array(shapes)


def _centroid(dark: Image, centre: Array, shape: Array) -> Array:
    """Darkness-weighted centroid of an ellipse, shape (2,), [px].

    Args:
        dark: Image in which circles are dark.
        centre: Approximate centre of the ellipse, shape (2,), [px].
        shape: Its matrix, from `CircleGrid._ellipses`.
    """
    inverse = np.linalg.inv(shape)
    reach = _WINDOW * np.sqrt(np.diag(shape)) + 2.0
    for _ in range(3):
        low = np.maximum(np.floor(centre - reach), 0).astype(int)
        high = np.minimum(np.ceil(centre + reach) + 1, dark.shape[::-1]).astype(int)
        pixels = np.stack(np.meshgrid(*map(np.arange, low, high)), axis=-1) - centre
        radii = np.sqrt(np.maximum(np.einsum("...i,ij,...j", pixels, inverse, pixels), 0.0))
        values = dark[low[1] : high[1], low[0] : high[0]].astype(np.float64)
        rim = 1.0 + 1.0 / np.sqrt(max(float(np.linalg.eigvalsh(shape)[0]), 1.0))
        window = radii < max(_WINDOW, rim)
        core, ring = radii < _CORE, window & (radii > rim)
        if not core.any() or ring.sum() < 4:
            return centre
        ink, paper = float(np.median(values[core])), float(np.median(values[ring]))
        if paper - ink < 5.0:
            return centre
        weight = np.clip((paper - values) / (paper - ink), 0.0, 1.0) * window
        step = np.einsum("ij,ijk->k", weight, pixels) / weight.sum()
        if np.linalg.norm(step) > reach.min():
            return centre
        centre = centre + step
    return centre


TagOrder = Literal["rows", "kalibr"]
ORDERS = {
    "rows": "numbered from the top left, rows downward",
    "kalibr": "numbered from the bottom left, rows upward, as Kalibr prints them",
}
"""Numbering of the tags, by name."""
_SADDLE = 0.12
"""Half width of the refinement window for corners that black squares touch, in tag sides."""
_SADDLE_NEAR = 0.25
"""The same of the first window, which is not wider than the squares."""
_BETTER, _OFF = 3.0, 0.05
"""The other order is right if it fits better by this factor and this order misfits by that share
of a tag's side."""


@dataclass(frozen=True)
class TagGrid:
    """A grid of AprilTags, numbered row by row; partial views suffice.

    Attributes:
        columns: Tags along a row.
        rows: Tags along a column.
        tag: Side of a tag's black square, [m].
        gap: Between neighbouring black squares, [m].
        family: One of `model.files.rig_file.FAMILIES`.
        first: Smallest number: of the tag at the top left, or at the bottom left.
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
        """Refuses impossible boards.

        Raises:
            BadInput: Too few tags, a size not above 0, an unknown family, or numbers outside the
                family.
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

    def find(self, image: Image) -> DetectedBoard | None:
        """Detects the corners of its completely visible tags.

        Black and white may be inverted. None, too, where the numbers contradict the order and the
        other order fits.
        """
        seen = self._seen_in(image)
        return self._seen_in(np.asarray(255 - image)) if seen is None else seen

    def _seen_in(self, image: Image) -> DetectedBoard | None:
        squares, twice = self._edges(image)
        if self.order == "kalibr":  # printed by Kalibr, or with narrow borders by others
            squares, twice = max((squares, twice), self._saddles(image), key=lambda f: len(f[0]))
        if 4 * len(squares) < LEAST_POINTS:
            return None
        # OpenCV draws some families upside down compared to AprilTag's images.
        turned = {number: np.roll(square, 2, axis=0) for number, square in squares.items()}
        ours, as_turned = self._misfit(squares), self._misfit(turned)
        if as_turned < min(ours / _BETTER, _OFF):
            squares, ours = turned, as_turned
        corners = np.concatenate(list(squares.values()))
        others = replace(self, order=self._other_order())._misfit(squares)
        if ours > max(_BETTER * others, _OFF):
            return None
        return DetectedBoard(self.points_of(squares), corners, twice)

    def _edges(self, image: Image) -> tuple[dict[int, Array], tuple[int, ...]]:
        """Corners of tags by intersecting edges, by number, and numbers seen more than once."""
        numbers = range(self.first, self.first + self.columns * self.rows)
        detected = [d for d in self._detector.detect_all(image) if d.id in numbers]
        counts = Counter(d.id for d in detected)
        detected = [d for d in detected if counts[d.id] == 1]
        rough = np.array([d.corners for d in detected]).reshape(-1, 4, 2)
        # An edge is short: its curvature from lens distortion is negligible.
        lens = generic_camera((image.shape[1], image.shape[0]))
        squares = refine(image, lens, rough, modules_across(self.family))
        whole = {d.id: s.corners for d, s in zip(detected, squares, strict=True) if s and s.whole}
        return whole, tuple(number for number, count in counts.items() if count > 1)

    def _saddles(self, image: Image) -> tuple[dict[int, Array], tuple[int, ...]]:
        """As `_edges`, for tags with wide borders and black squares at their corners."""
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
            start: NDArray[Any] = corners.astype(np.float32).reshape(-1, 1, 2)
            # From the contour's corner, which may be some pixels off, in a large window first.
            for share in (_SADDLE_NEAR, _SADDLE):
                half = max(2, int(share * side))
                better = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), stop)
                moved, start = np.any(better != start, axis=2), better
            if moved.all():  # OpenCV leaves a corner unchanged if the saddle is not in its window
                squares[number] = np.asarray(better, dtype=np.float64).reshape(4, 2)
        return squares, tuple(number for number, count in counts.items() if count > 1)

    def _misfit(self, squares: dict[int, Array]) -> float:
        """RMS misfit of corners to a homography of the board, in sides of a tag."""
        corners = np.concatenate(list(squares.values()))
        plane = self.points_of(squares)[:, :2] / self.tag
        back, _ = cv2.findHomography(corners, plane)
        if np.shape(back) != (3, 3):
            return float("inf")
        there = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), back).reshape(-1, 2)
        return float(np.sqrt(np.mean(np.sum((there - plane) ** 2, axis=1))))

    def _other_order(self) -> str:
        return next(order for order in ORDERS if order != self.order)

    def describe_other(self, image: Image) -> str:
        """The tags in another order, else tags that the image shows."""
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
