"""Squares in a picture that may be tags, also small, faint and blurred ones."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cdpr.poses import Array
from tracking.marks import dictionary
from tracking.picture import Image

#: Shortest outline of a square, [px].
LEAST_PERIMETER = 30.0
#: Larger pictures are not enlarged: their tags have pixels enough, and time is short, [px].
MOST_PIXELS = 4_000_000


@dataclass(frozen=True, slots=True)
class Pass:
    """One way to make dark squares stand out.

    Attributes:
        scale: How much the picture is enlarged.
        smoothing: Standard deviation of the smoothing before, [px].
        step: How much darker than its surroundings ink is, [grey levels].
        windows: Sides of the surroundings: smallest, largest, step, [px of the enlarged picture].
    """

    scale: int
    smoothing: float
    step: float
    windows: tuple[int, int, int]


#: Small ones; faint and noisy ones; blurred ones.
PASSES = (
    Pass(1, 0.0, 2.0, (3, 23, 10)),
    Pass(2, 0.8, 2.0, (7, 47, 20)),
    Pass(2, 1.2, 3.0, (21, 81, 30)),
)


def squares_in(image: Image, family: str) -> list[Array]:
    """Outlines of squares, clockwise on the screen from any corner, shape (4, 2) each, [px].

    Args:
        image: Grey picture.
        family: Whose tags are looked for.
    """
    found: list[Array] = []
    for way in PASSES:
        if way.scale == 1 or image.size <= MOST_PIXELS:
            found += _squares(image, family, way)
    return found


def _squares(image: Image, family: str, way: Pass) -> list[Array]:
    if way.smoothing > 0.0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), way.smoothing), dtype=np.uint8)
    if way.scale > 1:
        size = (image.shape[1] * way.scale, image.shape[0] * way.scale)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.adaptiveThreshConstant = way.step
    parameters.adaptiveThreshWinSizeMin = way.windows[0]
    parameters.adaptiveThreshWinSizeMax = way.windows[1]
    parameters.adaptiveThreshWinSizeStep = way.windows[2]
    parameters.minMarkerPerimeterRate = LEAST_PERIMETER * way.scale / max(image.shape)
    parameters.minOtsuStdDev = 1.0
    detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)
    read, _, unread = detector.detectMarkers(image)
    squares = [np.asarray(s, dtype=np.float64).reshape(4, 2) for s in (*read, *unread)]
    return [(square + 0.5) / way.scale - 0.5 for square in squares]
