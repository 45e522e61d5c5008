"""How far off the surveyed places of tags may be, and what that does to their pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array, Pose, skew
from cdpr.rig import Camera, Tag
from tracking.marks import tag_corners


@dataclass(frozen=True, slots=True)
class Survey:
    """How well tags were surveyed, one standard deviation along or about any axis.

    Attributes:
        shift: Of each corner by itself, or, where ``turn`` is told, of each tag as a whole, [m].
        turn: Of each tag's rotation, [rad]; 0 for tags that lie as they are told to. None where
            every corner was surveyed by itself: then the corners tell how a tag is turned.
    """

    shift: float
    turn: float | None = None

    def slopes(self, tag: Tag) -> Array:
        """How independent errors of size 1 shift a tag's corners, shape (12, k), [m]."""
        if self.turn is None:
            return self.shift * np.eye(12)
        arms = tag_corners(tag) - tag.pose.position
        turns = self.turn * np.concatenate([-skew(arm) for arm in arms])
        return np.concatenate([self.shift * np.tile(np.eye(3), (4, 1)), turns], axis=1)

    def of_pixels(self, camera: Camera, camera_from_world: Pose, tag: Tag) -> Array:
        """Covariance of a tag's ideal pixels by errors of the survey, shape (8, 8), [px²]."""
        spread = pixel_slopes(camera, camera_from_world, tag_corners(tag)) @ self.slopes(tag)
        covariance: Array = spread @ spread.T
        return covariance


def pixel_slopes(camera: Camera, camera_from_world: Pose, points: Array) -> Array:
    """Derivative of ideal pixels by points in the world, shape (n, 3): (2 n, 3 n), [px/m]."""
    slopes = np.zeros((2 * len(points), 3 * len(points)))
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    for k, (x, y, z) in enumerate(camera_from_world.apply(points)):
        by_camera = np.array([[fx / z, 0.0, -fx * x / z**2], [0.0, fy / z, -fy * y / z**2]])
        slopes[2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = by_camera @ camera_from_world.rotation
    return slopes
