"""Cables in the synthetic camera's image: thin lines, with occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from model.kinematics import Cables
from model.pose import Array, Pose
from model.rig import Camera
from simulation.camera.rendering import Image8, Image32
from tracking.camera_model import pixels_of

#: Points along a cable, and distance behind a surface from which a point is hidden, [m].
POINTS, HIDDEN = 96, 3e-3
#: Bisections of the interval between points to find the end of a visible part.
HALVINGS = 8
#: Drawn radius of cables without one in the rig file, [m].
DRAWN_RADIUS = 0.75e-3
#: Brightness of a cable, and fractional bits of OpenCV's pixel coordinates.
CABLE, SHIFT = 34.0, 4
#: Nearest distance that is drawn, [m], and margin beyond the image border, [px]: thick lines have
#: square ends.
NEAR, BEYOND = 0.05, 40.0
#: Number of points drawn with the same width.
_OF_ONE_WIDTH = 16


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
        depth: Depth of each pixel along the camera's z axis, same shape, [m].
        cables: Of the rig, world frame.
        radius: Of the cables, [m]; 0 for the default.
    """
    starts, ends = camera_from_world.apply(cables.exits), camera_from_world.apply(cables.anchors)
    lines = _Lines.before_lens(camera, depth, starts, ends)
    width = 2.0 * (radius or DRAWN_RADIUS) * camera.matrix[0, 0]
    for points in lines.visible():
        track = pixels_of(camera, points)
        for first in range(0, len(points) - 1, _OF_ONE_WIDTH):
            last = min(first + _OF_ONE_WIDTH, len(points) - 1)
            middle_depth = float(points[(first + last) // 2, 2])
            _draw_run(picture, track[first : last + 1], width / middle_depth)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Straight lines in front of a camera, parametrised from 0 at the start to 1 at the end.

    Attributes:
        camera: The camera.
        depth: Of each pixel, shape (height, width), [m].
        starts: Camera frame, shape (m, 3), [m].
        spans: From start to end, shape (m, 3), [m].
    """

    camera: Camera
    depth: Image32
    starts: Array
    spans: Array

    @classmethod
    def before_lens(cls, camera: Camera, depth: Image32, starts: Array, ends: Array) -> _Lines:
        """The parts of lines farther than `NEAR`."""
        spans = ends - starts
        rising = np.where(spans[:, 2] == 0.0, 1e-12, spans[:, 2])
        crossing = np.clip((NEAR - starts[:, 2]) / rising, 0.0, 1.0)
        begin = np.where(starts[:, 2] < NEAR, crossing, 0.0)[:, None]
        end = np.where(ends[:, 2] < NEAR, crossing, 1.0)[:, None]
        before = np.maximum(starts[:, 2], ends[:, 2]) > NEAR
        return cls(camera, depth, (starts + begin * spans)[before], ((end - begin) * spans)[before])

    def visible(self) -> list[Array]:
        """Points along each continuous visible part, shape (k, 3) each, [m]."""
        grid = np.linspace(0.0, 1.0, POINTS)
        count = len(self.starts)
        shown = self._seen(np.repeat(np.arange(count), POINTS), np.tile(grid, count))
        edges = np.zeros((count, POINTS + 2), dtype=np.int8)
        edges[:, 1:-1] = shown.reshape(count, POINTS)
        change = np.diff(edges, axis=1)
        line, first = np.nonzero(change == 1)
        last = np.nonzero(change == -1)[1] - 1
        begins = self._border(line, grid[first], grid[np.maximum(first - 1, 0)])
        ends = self._border(line, grid[last], grid[np.minimum(last + 1, POINTS - 1)])
        return [
            self._points(number, np.array([begin, *grid[a : b + 1], end]))
            for number, a, b, begin, end in zip(
                line[:, None], first, last, begins, ends, strict=True
            )
        ]

    def _border(self, line: NDArray[np.int64], seen: Array, unseen: Array) -> Array:
        """Last visible parameter between a visible and a hidden one, shape (k,)."""
        for _ in range(HALVINGS):
            middle = (seen + unseen) / 2.0
            there = self._seen(line, middle)
            seen, unseen = np.where(there, middle, seen), np.where(there, unseen, middle)
        return seen

    def _seen(self, line: NDArray[np.int64], share: Array) -> NDArray[np.bool_]:
        """Whether points are in the image or its margin, and not behind a surface."""
        points = self._points(line, share)
        if not len(points):
            return np.zeros(0, dtype=bool)
        pixels = pixels_of(self.camera, points)
        size = np.array(self.depth.shape[::-1])
        inside = np.all((pixels > -BEYOND) & (pixels < size + BEYOND), axis=1)
        within = np.clip(np.round(np.where(inside[:, None], pixels, 0.0)), 0, size - 1)
        column, row = within.astype(np.int64).T
        return np.asarray(inside & (points[:, 2] < self.depth[row, column] + HIDDEN))

    def _points(self, line: NDArray[np.int64], share: Array) -> Array:
        points: Array = self.starts[line] + share[:, None] * self.spans[line]
        return points


def _draw_run(picture: Image8, track: Array, width_px: float) -> None:
    points = np.round(track * (1 << SHIFT)).astype(np.int32).reshape(1, -1, 1, 2)
    thickness = max(1, round(width_px))
    cv2.polylines(picture, [points[0]], False, CABLE, thickness, cv2.LINE_AA, SHIFT)
