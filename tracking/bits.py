"""Whether a square in the picture carries a given tag's pattern."""

from __future__ import annotations

import numpy as np

from cdpr.poses import Array
from tracking.decoding import module_brightness
from tracking.marks import modules_across, official_modules
from tracking.picture import Image

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
    values = module_brightness(image, corners, modules_across(family))
    seen = values[1:-1, 1:-1].ravel()
    wanted = official_modules(family, number)[1:-1, 1:-1].ravel().astype(np.float64)
    seen, wanted = seen - seen.mean(), wanted - wanted.mean()
    size = float(np.linalg.norm(seen) * np.linalg.norm(wanted))
    return size > 0.0 and float(seen @ wanted) > LEAST_CORRELATION * size
