"""Pictures between which nothing moved: copies, or pictures of what stood still.

They err alike, and together they tell no more than one. A copy that was saved anew as JPEG has its
corners elsewhere by as much as noise moves them, so both are told by one limit.
"""

from __future__ import annotations

import numpy as np

from cdpr.poses import Array

SAME_VIEW = 0.1
"""Corners that nothing moved are nearer than that to each other in two pictures, RMS, [px]."""


def nothing_moved(corners: Array, before: Array) -> bool:
    """Whether the same corners are in the same places, shape (..., 2) both, [px]."""
    return bool(np.mean(np.sum((corners - before) ** 2, axis=-1)) < SAME_VIEW**2)


def as_in(first: str) -> str:
    """Why a picture is not used that shows the same as another, named ``first``."""
    return f"shows the same as {first}: nothing moved in between"
