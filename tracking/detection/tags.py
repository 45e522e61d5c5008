"""Tag families: their images and the corners of a tag.

OpenCV draws every AprilTag family turned by 180° against the images of the AprilTag project,
which labs print; ArUco markers are printed as OpenCV draws them. A tag's frame here is that of the
printed image: x right, y up, z out of it.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.files.camera_file import FAMILIES, drawn_upside_down, opencv_dictionary
from model.pose import Array
from model.rig import Tag

#: Top left, top right, bottom right, bottom left of the upright image, in half sides.
CORNER_SIGNS = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family.

    Raises:
        BadInput: The family is not known.
    """
    if family not in FAMILIES:
        raise BadInput(
            f"unknown tag family {family!r}",
            next_step=f"use one of {', '.join(FAMILIES)}",
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, opencv_dictionary(family)))


def modules_across(family: str) -> int:
    """Modules along the side of the black square, border included."""
    return dictionary(family).markerSize + 2


@lru_cache(maxsize=256)
def official_modules(family: str, number: int) -> NDArray[np.bool_]:
    """White modules of the printed image, black border included, rows from the top."""
    side = modules_across(family)
    picture = cv2.aruco.generateImageMarker(dictionary(family), number, side)
    return np.asarray((picture[::-1, ::-1] if drawn_upside_down(family) else picture) > 127)


def upright_corners(family: str, opencv_corners: Array) -> Array:
    """OpenCV's detected corners, shape (4, 2), in the order of `CORNER_SIGNS`."""
    return np.roll(opencv_corners, 2, axis=0) if drawn_upside_down(family) else opencv_corners


def tag_corners(tag: Tag) -> Array:
    """Corners of a tag in the frame of its carrier (platform or world), shape (4, 3), [m]."""
    flat = np.column_stack([CORNER_SIGNS * tag.size / 2.0, np.zeros(4)])
    return tag.pose.apply(flat)
