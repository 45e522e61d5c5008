"""Observations of tags by a perfect detector with known noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calibration.tag_map.observations import TagObservations
from model.pose import Pose
from model.rig import Camera, Tag
from tracking.camera_model import project_undistorted
from tracking.detection.tags import tag_corners
from tracking.edges.refine import RefinedTag


def seen_tag(
    camera: Camera, camera_from_carrier: Pose, tag: Tag, noise: float, rng: np.random.Generator
) -> RefinedTag | None:
    """The square of a tag; None if it faces away or is out of the image."""
    points = camera_from_carrier.apply(tag_corners(tag))
    normal = camera_from_carrier.rotation @ tag.pose.rotation[:, 2]
    middle = points.mean(axis=0)
    if middle[2] < 0.1 or normal @ middle > -0.3 * np.linalg.norm(middle):
        return None
    pixels = project_undistorted(camera, points)
    if (pixels < 5).any() or (pixels > [camera.width - 5, camera.height - 5]).any():
        return None
    corners = pixels + noise * rng.standard_normal((4, 2))
    whitening = np.eye(8) / max(noise, 1e-4)
    return RefinedTag(corners, whitening, whitening @ corners.ravel(), np.ones(4, bool))


def observe(
    camera: Camera,
    tags: Sequence[Tag],
    poses: Mapping[str, Pose],
    noise: float,
    rng: np.random.Generator,
) -> TagObservations:
    """Tags of a carrier at poses ``camera_from_carrier``, by image."""
    squares = {}
    for name, pose in poses.items():
        seen = {tag.id: seen_tag(camera, pose, tag, noise, rng) for tag in tags}
        squares[name] = {number: square for number, square in seen.items() if square is not None}
    return TagObservations({name: found for name, found in squares.items() if found}, {})
