"""Finding tags in a picture, in all of it or in a part, by their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from cdpr.poses import Array, read_only
from tracking.decoding import TagDecoder
from tracking.marks import dictionary, upright_corners
from tracking.picture import Image, Region
from tracking.squares import squares_in

#: Shortest outline of a tag that is looked for, [px].
LEAST_PERIMETER = 44.0
#: Smallest side of a region that is searched, [px].
LEAST_SIDE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A tag that was seen.

    Attributes:
        id: Its number.
        corners: Roughly, in the order of `tracking.marks.CORNER_SIGNS`, shape (4, 2), [px].
    """

    id: int
    corners: Array


class TagDetector:
    """Finds the tags of one family with OpenCV, without its corner refinement.

    OpenCV's refinements are off by 0.26 px and more (sub-pixel) or biased by 0.45 px (AprilTag);
    `tracking.edges` does it instead.

    Args:
        family: Such as ``tag36h11``.

    Raises:
        BadInput: The family is not known.
    """

    def __init__(self, family: str) -> None:
        self.family = family
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def detect(
        self, image: Image, region: Region | None = None, *, thorough: bool = False
    ) -> list[Detection]:
        """Tags in the picture or in a region of it, each number once (the largest).

        Args:
            image: Grey picture.
            region: Where to look; everywhere when left out.
            thorough: Also finds small, faint and blurred tags, in about ten times the time.
        """
        largest = {d.id: d for d in self.detect_all(image, region, thorough=thorough)}
        return list(largest.values())

    def detect_all(
        self, image: Image, region: Region | None = None, *, thorough: bool = False
    ) -> list[Detection]:
        """As `detect`, but every tag of a number that is seen more than once, the largest last."""
        origin = np.zeros(2)
        if region is not None:
            image = image[region.top : region.bottom, region.left : region.right]
            origin = np.array([region.left, region.top], dtype=np.float64)
            if min(image.shape) < LEAST_SIDE:
                return []
        found = self._detect(np.ascontiguousarray(image), thorough)
        found.sort(key=lambda d: (d.id, _area(d.corners)))
        return [Detection(d.id, read_only(d.corners + origin)) for d in found]

    def _detect(self, image: Image, thorough: bool) -> list[Detection]:
        found = self._plainly(image)
        return found + self._thoroughly(image, found) if thorough else found

    def _plainly(self, image: Image) -> list[Detection]:
        # OpenCV counts this limit in shares of the picture: in a small region noise would pass it.
        self._parameters.minMarkerPerimeterRate = LEAST_PERIMETER / max(image.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, numbers, _ = self._detector.detectMarkers(image)
        if numbers is None:
            return []
        squares = [np.asarray(c, dtype=np.float64).reshape(4, 2) for c in corners]
        return [
            Detection(int(number), upright_corners(self.family, square))
            for number, square in zip(np.ravel(numbers), squares, strict=True)
        ]

    def _thoroughly(self, image: Image, known: Sequence[Detection]) -> list[Detection]:
        """Further tags, of squares that OpenCV does not find or cannot read."""
        readings = [self._decoder.read(image, square) for square in squares_in(image, self.family)]
        better = sorted((r for r in readings if r is not None), key=lambda r: -r.correlation)
        new: list[Detection] = []
        for reading in better:
            if not any(_overlap(reading.corners, d.corners) for d in (*known, *new)):
                new.append(Detection(reading.id, reading.corners))
        return new

    @cached_property
    def _decoder(self) -> TagDecoder:
        return TagDecoder(self.family)


def _overlap(a: Array, b: Array) -> bool:
    """Whether the middle of one square lies in the other."""
    return any(
        cv2.pointPolygonTest(one.astype(np.float32), other.mean(axis=0).tolist(), False) >= 0
        for one, other in ((a, b), (b, a))
    )


def _area(corners: Array) -> float:
    """Area of a quadrilateral, [px²]."""
    x, y = (corners[2] - corners[0]), (corners[3] - corners[1])
    return abs(float(x[0] * y[1] - x[1] * y[0])) / 2.0
