"""Cables in the synthetic camera's picture: thin lines, hidden by what stands before them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.cables import Cables
from cdpr.poses import Array, Pose
from cdpr.rig import Camera
from simulation.camera_canvas import Image8, Image32, pixels_of

#: Points along a cable, and how far a point must lie behind a surface to be hidden, [m].
POINTS, HIDDEN = 96, 3e-3
#: Cables without a radius in the rig file are drawn with this one, [m].
DRAWN_RADIUS = 0.75e-3
#: Brightness of a cable, and binary digits of a pixel that OpenCV draws with.
CABLE, SHIFT = 34.0, 4
#: Nearest distance that is drawn, [m].
NEAR = 0.05


def draw_cables(
    picture: Image8,
    depth: Image32,
    camera: Camera,
    cables: Cables,
    camera_from_world: Pose,
    radius: float,
) -> None:
    """Draws every cable's visible parts.

    Args:
        picture: Shape (height, width), changed in place.
        depth: Distance along the camera's z axis of what each pixel shows, same shape, [m].
        camera: The camera.
        cables: Where the cables run, world frame.
        camera_from_world: Pose.
        radius: Of the cables, [m]; 0 for the drawn default.
    """
    share = np.linspace(0.0, 1.0, POINTS)[:, None]
    starts, ends = camera_from_world.apply(cables.exits), camera_from_world.apply(cables.anchors)
    lines = starts[:, None] + share * (ends - starts)[:, None]  # (m, POINTS, 3)
    pixels = pixels_of(camera, np.maximum(lines, [-np.inf, -np.inf, NEAR]).reshape(-1, 3))
    seen = _seen(pixels, lines[..., 2].ravel(), depth).reshape(len(lines), POINTS)
    width = 2.0 * (radius or DRAWN_RADIUS) * camera.matrix[0, 0]
    for line, shown, track in zip(lines, seen, pixels.reshape(len(lines), POINTS, 2), strict=True):
        for first, last in _runs(shown):
            middle_depth = float(line[(first + last) // 2, 2])
            _draw_run(picture, track[first : last + 1], width / middle_depth)


def _seen(pixels: Array, distance: Array, depth: Image32) -> NDArray[np.bool_]:
    """Which points are in the picture, in front of the camera and not behind a surface."""
    height, width = depth.shape
    inside = (distance > NEAR) & np.all(pixels > -0.5, axis=1)
    inside &= (pixels[:, 0] < width - 0.5) & (pixels[:, 1] < height - 0.5)
    column, row = np.where(inside[:, None], np.round(pixels), 0).astype(np.int64).T
    return np.asarray(inside & (distance < depth[row, column] + HIDDEN))


def _runs(shown: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each unbroken run, short enough to have one width."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], shown, [False]]).astype(np.int8)))
    runs = []
    for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        runs += [(i, min(i + 16, after - 1)) for i in range(first, max(after - 1, first + 1), 16)]
    return [(first, last) for first, last in runs if last > first]


def _draw_run(picture: Image8, track: Array, width_px: float) -> None:
    points = np.round(track * (1 << SHIFT)).astype(np.int32).reshape(1, -1, 1, 2)
    thickness = max(1, round(width_px))
    cv2.polylines(picture, [points[0]], False, CABLE, thickness, cv2.LINE_AA, SHIFT)
