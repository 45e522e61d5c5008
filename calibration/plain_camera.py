"""A camera of which nothing is known but the size of its pictures."""

from __future__ import annotations

import numpy as np

from cdpr.poses import Pose
from cdpr.rig import Camera


def plain_camera(size: tuple[int, int], name: str = "camera") -> Camera:
    """A camera as most are: no distortion, and a view of about 53° across.

    Args:
        size: Width and height of its pictures, [px].
        name: For messages.
    """
    width, height = size
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    return Camera(name, width, height, matrix, np.zeros(5), Pose.level([0.0, 0.0, 0.0]), 10.0)
