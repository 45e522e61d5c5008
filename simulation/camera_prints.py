"""Printed tags for the synthetic camera: the official pictures, white border included."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from cdpr.tag_families import drawn_upside_down, opencv_dictionary
from simulation.camera_canvas import Image32

#: Brightness of ink and paper in full light.
INK, PAPER = 28.0, 236.0


def _dictionary(family: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, opencv_dictionary(family)))


def modules_across(family: str) -> int:
    """Modules along the side of the black square."""
    return _dictionary(family).markerSize + 2


@lru_cache(maxsize=256)
def tag_print(family: str, number: int, across: int, down: int) -> Image32:
    """A tag with one module of white around it, upright as its own project draws it.

    Args:
        family: Such as ``tag36h11``.
        number: Number in the family.
        across: Texels along the upper side of a module.
        down: Texels along its left side.
    """
    modules = modules_across(family)
    picture = np.asarray(cv2.aruco.generateImageMarker(_dictionary(family), number, modules))
    upright = picture[::-1, ::-1] if drawn_upside_down(family) else picture
    upright = np.pad(upright, 1, constant_values=255)
    print_: Image32 = np.where(upright > 127, PAPER, INK).astype(np.float32)
    return print_.repeat(down, axis=0).repeat(across, axis=1)
