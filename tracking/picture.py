"""Pictures and parts of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of pixels, right and bottom not included."""

    left: int
    top: int
    right: int
    bottom: int
