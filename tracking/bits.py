"""Whether a square in the picture carries a given tag's pattern."""

from __future__ import annotations

import cv2
import numpy as np

from cdpr.poses import Array
from tracking.detector import Image
from tracking.marks import modules_across, official_modules

#: Least correlation of brightness and pattern; another tag's pattern reaches about 0.5.
LEAST_CORRELATION = 0.75


def carries_tag(image: Image, corners: Array, family: str, number: int) -> bool:
    """Compares the inner modules of a square with a tag's.

    Args:
        image: Grey picture.
        corners: In the order of `tracking.marks.CORNER_SIGNS`, shape (4, 2), [px], as in the
            picture.
        family: Such as ``tag36h11``.
        number: Number in the family.
    """
    side = modules_across(family)
    square = np.array([[0, 0], [side, 0], [side, side], [0, side]], dtype=np.float32)
    turn = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    centre = np.arange(side) + 0.5
    grid = np.stack(np.meshgrid(centre, centre), axis=-1).reshape(-1, 1, 2)
    places = cv2.perspectiveTransform(grid, turn).astype(np.float32).reshape(side, side, 2)
    column, row = np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1])
    values = cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = np.asarray(values, dtype=np.float64)[1:-1, 1:-1].ravel()
    wanted = official_modules(family, number)[1:-1, 1:-1].ravel().astype(np.float64)
    seen, wanted = seen - seen.mean(), wanted - wanted.mean()
    size = float(np.linalg.norm(seen) * np.linalg.norm(wanted))
    return size > 0.0 and float(seen @ wanted) > LEAST_CORRELATION * size
