"""Printed tags for the synthetic camera: the official pictures, white border included."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from simulation.camera_canvas import Image32

#: Brightness of ink and paper in full light.
INK, PAPER = 28.0, 236.0
FAMILIES = {
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag36h10": cv2.aruco.DICT_APRILTAG_36H10,
    "tag36h11": cv2.aruco.DICT_APRILTAG_36H11,
}


def modules_across(family: str) -> int:
    """Modules along the side of the black square."""
    return cv2.aruco.getPredefinedDictionary(FAMILIES[family]).markerSize + 2


@lru_cache(maxsize=256)
def tag_print(family: str, number: int, across: int, down: int) -> Image32:
    """A tag with one module of white around it, upright as the AprilTag project draws it.

    Args:
        family: Such as ``tag36h11``.
        number: Number in the family.
        across: Texels along the upper side of a module.
        down: Texels along its left side.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    modules = modules_across(family)
    picture = cv2.aruco.generateImageMarker(dictionary, number, modules)
    upright = np.pad(picture[::-1, ::-1], 1, constant_values=255)  # OpenCV's stand on their head
    print_: Image32 = np.where(upright > 127, PAPER, INK).astype(np.float32)
    return print_.repeat(down, axis=0).repeat(across, axis=1)
