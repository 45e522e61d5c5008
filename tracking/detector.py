"""Finding tags in a picture, in all of it or in a part, by their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array, read_only
from tracking.marks import FAMILIES, dictionary, upright_corners

#: Shortest outline of a tag that is looked for, [px].
LEAST_PERIMETER = 44.0

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of pixels, right and bottom not included."""

    left: int
    top: int
    right: int
    bottom: int


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

    def detect(self, image: Image, region: Region | None = None) -> list[Detection]:
        """Tags in the picture or in a region of it, each number once (the largest)."""
        if region is None:
            return self._detect(image, np.zeros(2))
        part = image[region.top : region.bottom, region.left : region.right]
        if min(part.shape) < 16:
            return []
        return self._detect(np.ascontiguousarray(part), np.array([region.left, region.top]))

    def _detect(self, image: Image, origin: Array) -> list[Detection]:
        # OpenCV counts this limit in shares of the picture: in a small region noise would pass it.
        self._parameters.minMarkerPerimeterRate = LEAST_PERIMETER / max(image.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, numbers, _ = self._detector.detectMarkers(image)
        if numbers is None:
            return []
        best: dict[int, Array] = {}
        for number, points in zip([int(n) for n in np.ravel(numbers)], corners, strict=True):
            found = np.asarray(points, dtype=np.float64).reshape(4, 2) + origin
            if number not in best or _area(found) > _area(best[number]):
                best[number] = found
        return [Detection(n, read_only(upright_corners(c))) for n, c in sorted(best.items())]


def _area(corners: Array) -> float:
    """Area of a quadrilateral, [px²]."""
    x, y = (corners[2] - corners[0]), (corners[3] - corners[1])
    return abs(float(x[0] * y[1] - x[1] * y[0])) / 2.0


def what_else_is_seen(image: Image, family: str, expected: Sequence[int]) -> str:
    """Says which tags a picture shows that are not the expected ones, for an error message."""
    seen = []
    for other in FAMILIES:
        if other == "tag16h5" and other != family:  # so small that it is found by chance
            continue
        wanted = set(expected) if other == family else set()
        numbers = [d.id for d in TagDetector(other).detect(image) if d.id not in wanted]
        if numbers:
            seen.append(f"{other} {', '.join(map(str, numbers))}")
    return "; ".join(seen) or "no tag of any known family"
