"""Where things of known place in the world lie in a camera's picture: frame tags, the platform."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cdpr.poses import Array
from cdpr.rig import Camera, Tag
from tracking.detector import LEAST_SIDE, Detection, TagDetector
from tracking.marks import tag_corners
from tracking.picture import Image, Region
from tracking.projection import pixels_of

#: Nearer to the camera's plane nothing is seen, [m].
NEAREST = 0.02


def region_around(camera: Camera, points: Array, slack: float) -> Region | None:
    """The pixels around points of the world, or None out of view.

    Args:
        camera: Whose pixels they are.
        points: World frame, shape (n, 3), [m].
        slack: Border on each side, as a share of the larger side.
    """
    pixels = _pixels(camera, points)
    if pixels is None:
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    border = slack * (high - low).max() + 8.0
    size = np.array([camera.width, camera.height])
    left, top = np.clip(np.floor(low - border), 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(high + border), 0, size).astype(int).tolist()
    if right - left < LEAST_SIDE or bottom - top < LEAST_SIDE:
        return None
    return Region(left, top, right, bottom)


def near_places(
    camera: Camera, tags: Mapping[int, Tag], detector: TagDetector, image: Image
) -> list[Detection]:
    """Frame tags that are seen near where they should be."""
    found = []
    for tag in tags.values():
        region = region_around(camera, tag_corners(tag), slack=0.5)
        if region is not None:
            found += [d for d in detector.detect_all(image, region) if d.id == tag.id]
    return found


def nearest_to(
    camera: Camera, tags: Mapping[int, Tag], detections: Sequence[Detection]
) -> list[Detection]:
    """Of each frame tag the detection nearest to its place: others are of another print."""
    nearest: dict[int, tuple[float, Detection]] = {}
    for found in detections:
        pixels = _pixels(camera, tag_corners(tags[found.id])) if found.id in tags else None
        if pixels is None:
            continue
        distance = float(np.linalg.norm(pixels.mean(axis=0) - found.corners.mean(axis=0)))
        if found.id not in nearest or distance < nearest[found.id][0]:
            nearest[found.id] = (distance, found)
    return [found for _, found in nearest.values()]


def _pixels(camera: Camera, points: Array) -> Array | None:
    """Pixels of points of the world, None when one is not in front of the camera."""
    in_camera = camera.world_from_camera.inverse().apply(points)
    return None if np.any(in_camera[:, 2] < NEAREST) else pixels_of(camera, in_camera)
