"""Circle grids, with centres corrected for perspective and lens, and grids of tags.

The centroid of a circle's image is not the image of the circle's centre. The offset follows from
the grid's homography, the lens and the circles' diameter. Centres are darkness-weighted means
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
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.targets.boards import LEAST_POINTS, DetectedBoard, require_board
from model.cameras import generic_camera
from model.errors import require_fields
from model.files.camera_file import FAMILIES, tags_in
from model.pose import Array
from model.rig import Camera
from tracking.camera_model import Image, distort_pixels, has_rays, undistort_pixels
from tracking.detection.detector import TagDetector
from tracking.detection.diagnostics import diagnose_tags, row_numbering, tag_offsets
from tracking.detection.tags import CORNER_SIGNS, dictionary, modules_across, upright_corners
from tracking.edges.refine import refine

_SEARCHED = 1600
"""Longer side of the image copy in which circles are detected, [px]."""
_LEAST_AREA, _LEAST_APART = 12.0, 4.0
"""Minimum area of a circle and distance between circles in that copy, [px²] and [px]."""
_WINDOW, _CORE = 1.3, 0.6
"""Radii of the window around a circle and of its dark core, in radii of the circle."""
_RIM = 90
"""Points of a circle's rim whose images give its centroid."""


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
    needs_lens: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Refuses impossible boards.

        Raises:
            BadInput: Too few circles, a size not above 0, circles that touch, or another value for
                ``asymmetric``.
        """
        require_fields(self)
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

    def find(self, image: Image, camera: Camera | None = None) -> DetectedBoard | None:
        """Detects the centres of its circles, if all are visible."""
        lens = camera or _plain_lens(image)
        times = max(1.0, max(image.shape) / _SEARCHED)
        small = image
        if times > 1.0:
            size = (round(image.shape[1] / times), round(image.shape[0] / times))
            small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        scale = np.array(image.shape[::-1]) / small.shape[::-1]
        for white, picture in ((False, small), (True, np.asarray(255 - small))):
            found = self._found(picture)
            centres = None if found is None else self._upright((found + 0.5) * scale - 0.5)
            if centres is not None:
                lens = lens if has_rays(lens, centres).all() else _plain_lens(image)
                dark = np.asarray(255 - image) if white else image
                return DetectedBoard(self.points(), self._refined(dark, centres, lens))
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

    def _refined(self, dark: Image, centres: Array, camera: Camera) -> Array:
        """Images of the circles' centres, shape (n, 2), [px]."""
        turn = self._homography(undistort_pixels(camera, centres))
        if turn is None:  # not after `_upright`
            return centres
        offsets, shapes = self._ellipses(turn, camera)
        return (
            np.array([_centroid(dark, *each) for each in zip(centres, shapes, strict=True)])
            - offsets
        )

    def _ellipses(self, turn: Array, camera: Camera) -> tuple[Array, Array]:
        """The circles' images: ellipses, but for the lens distortion.

        Args:
            turn: Homography from board plane to undistorted pixels, shape (3, 3).

        Returns:
            Their centroids minus the images of the circles' centres, shape (n, 2), [px], and the
            matrices E of xᵀE⁻¹x = 1 about the centroids, shape (n, 2, 2), [px²].
        """
        angles = np.arange(_RIM) * 2.0 * np.pi / _RIM
        unit = np.column_stack([np.cos(angles), np.sin(angles)])
        circle = np.vstack([np.zeros(2), self.diameter / 2.0 * unit])
        plane = self.points()[:, None, :2] + circle
        there = distort_pixels(camera, np.asarray(cv2.perspectiveTransform(plane, turn)))
        rims = there[:, 1:] - there[:, :1]
        after = np.roll(rims, -1, axis=1)
        areas = rims[..., 0] * after[..., 1] - rims[..., 1] * after[..., 0]
        offsets = np.einsum("nr,nri->ni", areas, rims + after) / (3.0 * areas.sum(axis=1)[:, None])
        axes = 2.0 / _RIM * np.einsum("nri,rj->nij", rims, unit)
        return offsets, axes @ axes.transpose(0, 2, 1)


def _plain_lens(image: Image) -> Camera:
    """A camera of an image, without distortion."""
    return generic_camera((image.shape[1], image.shape[0]))


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
_OFF = 0.5
"""Tags that are off from their neighbours by this share of the distance contradict the board."""


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
    needs_lens: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Refuses impossible boards.

        Raises:
            BadInput: Too few tags, a size not above 0, an unknown family, or numbers outside the
                family.
        """
        require_fields(self)
        require_board(self.columns * self.rows >= 4, "a tag grid needs 4 tags")
        require_board(min(self.columns, self.rows) >= 1, "a tag grid needs a row and a column")
        require_board(self.tag > 0.0 and self.gap > 0.0, "tags, and gaps, must be larger than 0 mm")
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

    def find(self, image: Image, camera: Camera | None = None) -> DetectedBoard | None:
        """Detects the corners of its completely visible tags.

        Black and white may be inverted. None, too, where the tags contradict the board: where a
        tag's nearest neighbour is in another direction than by its number.
        """
        lens = camera or _plain_lens(image)
        seen = self._seen_in(image, lens)
        return self._seen_in(np.asarray(255 - image), lens) if seen is None else seen

    def _seen_in(self, image: Image, camera: Camera) -> DetectedBoard | None:
        squares, twice = self._squares(image, camera)
        if 4 * len(squares) < LEAST_POINTS:
            return None
        offsets = tag_offsets(squares)
        # OpenCV draws some families upside down compared to AprilTag's images.
        misfits = self._misfit(squares, offsets), self._misfit(squares, -offsets)
        if min(misfits) > _OFF:
            return None
        if misfits[1] < misfits[0]:
            squares = {number: np.roll(square, 2, axis=0) for number, square in squares.items()}
        corners = np.concatenate(list(squares.values()))
        return DetectedBoard(self.points_of(squares), corners, twice)

    def _squares(self, image: Image, camera: Camera) -> tuple[dict[int, Array], tuple[int, ...]]:
        """Corners of its tags by number, and numbers seen more than once."""
        found = self._edges(image, camera)
        if self.order == "kalibr":  # printed by Kalibr, or with narrow borders by others
            found = max(found, self._saddles(image), key=lambda f: len(f[0]))
        return found

    def _edges(self, image: Image, camera: Camera) -> tuple[dict[int, Array], tuple[int, ...]]:
        """Corners of tags by intersecting edges, by number, and numbers seen more than once."""
        numbers = range(self.first, self.first + self.columns * self.rows)
        detected = [d for d in self._detector.detect_all(image) if d.id in numbers]
        counts = Counter(d.id for d in detected)
        detected = [d for d in detected if counts[d.id] == 1]
        rough = np.array([d.corners for d in detected]).reshape(-1, 4, 2)
        near, plain = has_rays(camera, rough).all(axis=1), _plain_lens(image)
        whole = {}
        for lens, which in ((camera, near), (plain, ~near)):
            squares = refine(image, lens, rough[which], modules_across(self.family))
            for k, square in zip(np.flatnonzero(which).tolist(), squares, strict=True):
                if square and square.whole:
                    whole[detected[k].id] = distort_pixels(lens, square.corners)
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

    def _misfit(self, numbers: Iterable[int], offsets: Array) -> float:
        """Largest error of a tag's nearest neighbours, as a share of their distance.

        Args:
            offsets: From `tag_offsets`, shape (n, n, 2).
        """
        middles = self.points_of(numbers).reshape(-1, 4, 3).mean(axis=1)[:, :2] / self.tag
        wanted = middles - middles[:, None]
        apart = np.linalg.norm(wanted, axis=2)
        np.fill_diagonal(apart, np.inf)
        nearest = apart < 1.01 * apart.min(axis=1, keepdims=True)
        errors = np.linalg.norm(offsets - wanted, axis=2) / apart
        return float(np.minimum(errors, errors.T)[nearest].max())

    def describe_other(self, image: Image) -> str:
        """The tags in another order or grid, else tags that the image shows."""
        other = next(order for order in ORDERS if order != self.order)
        if replace(self, order=other).find(image) is not None:
            return f"these tags {ORDERS[other]}: try `order={other!r}`"
        if (grid := self._as_seen(image)) is not None and grid.find(image) is not None:
            names = ("columns", "rows", "first", "order")
            right = {name: getattr(grid, name) for name in names}
            wrong = [f"`{n}={value!r}`" for n, value in right.items() if getattr(self, n) != value]
            return f"tags that fit {grid}: try {' '.join(wrong)}"
        return diagnose_tags(image, self.family, [])

    def _as_seen(self, image: Image) -> TagGrid | None:
        """The grid by its tags' neighbours, where some of its own numbers are among them."""
        most = tags_in(self.family)
        every = replace(self, columns=most, rows=1, first=0)
        squares, _ = every._squares(image, _plain_lens(image))
        own = range(self.first, self.first + self.columns * self.rows)
        rows = row_numbering(squares)
        if rows is None or not any(number in own for number in squares):
            return None
        lowest, columns = min(squares), rows.columns
        firsts = range(lowest + 1) if rows.start is None else range(rows.start, lowest + 1, columns)
        first = min(firsts, key=lambda number: abs(number - self.first), default=lowest)
        needed = (max(squares) - first) // columns + 1
        count = max(needed, min(self.rows, (most - first) // columns))
        if first + columns * count > most:
            return None
        order = "kalibr" if rows.upward else "rows"
        return replace(self, columns=columns, rows=count, first=first, order=order)

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
