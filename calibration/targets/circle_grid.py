"""Grids of circles: their centres in a picture, freed of what perspective adds.

A circle is seen as an ellipse, whose middle is not where the circle's middle is seen. The grid's
homography says by how much, so that the circles' diameter is needed. Middles are means of
darkness over the pixels of a circle, which takes the thresholds of the finder out of them.

Source: Heikkilä, "Geometric camera calibration using circular control points", IEEE TPAMI 22(10),
2000, section 2.2 (bias of the centre of a projected circle).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibration.targets.board import Seen, require_board
from model.pose import Array
from tracking.camera_model import Image

_SEARCHED = 1600
"""Longer side of the picture in which the circles are looked for, [px]."""
_LEAST_AREA, _LEAST_APART = 12.0, 4.0
"""Of the circles in that picture, [px²] and [px]."""
_WINDOW, _CORE = 1.3, 0.6
"""Radii of the window around a circle and of its dark part, in radii of the circle."""


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """Printed circles, dark on white or white on dark; all of them must be in the picture.

    Attributes:
        columns: Circles along a row.
        rows: Rows.
        spacing: Of neighbouring rows, [m]. In a symmetric grid columns are as far apart; in an
            asymmetric one circles of a row are twice as far apart, and every other row is shifted
            by the spacing, the second one to the right.
        diameter: Of a circle, [m].
        asymmetric: Whether every other row is shifted.
    """

    columns: int
    rows: int
    spacing: float
    diameter: float
    asymmetric: bool = False

    def __post_init__(self) -> None:
        """Refuses boards that cannot be.

        Raises:
            BadInput: Too few circles, sizes that are none, or circles that touch.
        """
        require_board(min(self.columns, self.rows) >= 3, "a circle grid needs 3 circles a side")
        apart = self.spacing * (np.sqrt(2.0) if self.asymmetric else 1.0)
        require_board(
            0.0 < self.diameter < apart, "circles must have a size, and white between them"
        )

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

    def find(self, image: Image) -> Seen | None:
        """The centres of its circles, where all are to be seen."""
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
                return Seen(self.points(), self._refined(dark, centres))
        return None

    def instead(self, image: Image) -> str:
        """The same grid with rows and columns exchanged, or of the other kind."""
        others = [
            CircleGrid(*count, self.spacing, min(self.diameter, 0.9 * self.spacing), asymmetric)
            for count in ((self.rows, self.columns), (self.columns, self.rows))
            for asymmetric in (False, True)
        ]
        return next((str(g) for g in others if str(g) != str(self) and g.find(image)), "")

    def _found(self, image: Image) -> Array | None:
        """Centres of dark circles roughly, shape (n, 2), [px]."""
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID if self.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        detector = self._blob_detector(image)
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            size = (self.columns, self.rows)
            try:
                found, centres = cv2.findCirclesGrid(
                    image, size, flags=flags, blobDetector=detector
                )
            except cv2.error:  # as for pictures too small to hold the board
                continue
            if found:
                return np.asarray(centres, dtype=np.float64).reshape(-1, 2)
        return None

    def _blob_detector(self, image: Image) -> cv2.SimpleBlobDetector:
        """For circles from tiny to as large as fit; OpenCV's own stops at 5000 px²."""
        parameters = cv2.SimpleBlobDetector.Params()
        parameters.minArea = _LEAST_AREA
        parameters.maxArea = float(max(5000.0, image.size / (self.columns * self.rows)))
        parameters.minDistBetweenBlobs = _LEAST_APART
        return cv2.SimpleBlobDetector.create(parameters)

    def _upright(self, centres: Array) -> Array | None:
        """Centres in an order that the board can have unmirrored; None where it cannot."""
        if self._homography(centres) is not None:
            return centres
        if self.asymmetric:
            return None
        flipped = centres.reshape(self.rows, self.columns, 2)[:, ::-1].reshape(-1, 2)
        return flipped if self._homography(flipped) is not None else None

    def _homography(self, centres: Array) -> Array | None:
        """From the board's plane to the picture, (3, 3); None where it mirrors or is none."""
        plane = self.points()[:, :2]
        turn, _ = cv2.findHomography(plane, centres)
        if np.shape(turn) != (3, 3) or np.linalg.det(turn) * np.sign(turn[2, 2]) <= 0.0:
            return None
        return np.asarray(turn, dtype=np.float64)

    def _refined(self, dark: Image, centres: Array) -> Array:
        """Where the circles' middles are seen, shape (n, 2), [px]."""
        turn = self._homography(centres)
        if turn is None:  # not after `_upright`
            return centres
        middles = np.array(
            [_middle(dark, c, e) for c, e in zip(centres, self._ellipses(turn)[1], strict=True)]
        )
        return np.asarray(middles - self._ellipses(turn)[0])

    def _ellipses(self, turn: Array) -> tuple[Array, Array]:
        """The ellipses as which the circles are seen.

        Returns:
            Their middles less the images of the circles' own, shape (n, 2), [px], and the matrices
            E of xᵀE⁻¹x = 1 around these middles, shape (n, 2, 2), [px²].
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


def _middle(dark: Image, centre: Array, shape: Array) -> Array:
    """Mean of darkness over an ellipse's surroundings, shape (2,), [px].

    Args:
        dark: Picture in which circles are dark.
        centre: Of the ellipse, roughly, shape (2,), [px].
        shape: Its matrix, as of `CircleGrid._ellipses`.
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
