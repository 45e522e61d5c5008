"""Images of single tags with exactly known corners, for tests."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from model.pose import Array, Pose, matrix_from_rotation_vector, read_only
from model.rig import Camera, Tag
from simulation.camera.camera import sample_rays
from simulation.camera.rendering import Canvas, draw_tag
from tracking.camera_model import Region, project_undistorted
from tracking.detection.tags import tag_corners

FAMILY = "tag36h11"
SIZE = 0.096


def small_camera(distortion: tuple[float, ...] = (-0.08, 0.03, 0.0005, -0.0005)) -> Camera:
    """A camera of 320 x 240 px whose world is its own frame."""
    matrix = np.array([[400.0, 0.0, 159.5], [0.0, 400.0, 119.5], [0.0, 0.0, 1.0]])
    here = Pose.level(np.zeros(3))
    return Camera("small", 320, 240, matrix, np.array(distortion), here, 10.0)


def cropped(camera: Camera, region: Region) -> Camera:
    """The camera with the pixels of a region only, which are searched faster."""
    size = region.right - region.left, region.bottom - region.top
    matrix = camera.matrix.copy()
    matrix[:2, 2] -= region.left, region.top
    return replace(camera, width=size[0], height=size[1], matrix=read_only(matrix))


@dataclass(frozen=True)
class TagPicture:
    """An image of one tag, its pose and its true corners."""

    image: NDArray[np.uint8]
    tag: Tag
    camera_from_tag: Pose
    corners: Array  # undistorted pixels, (4, 2)


class TagPrinter:
    """Renders one tag in front of a grey wall."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._rays = sample_rays(camera)

    def image(
        self, camera_from_tag: Pose, rng: np.random.Generator, noise: float = 1.0, number: int = 301
    ) -> TagPicture:
        """An image with a tag at a pose."""
        tag = Tag(number, SIZE, Pose.level(np.zeros(3)))
        canvas = Canvas.blank(self.camera, self._rays, 120.0)
        draw_tag(canvas, FAMILY, tag, Pose.level(np.zeros(3)), camera_from_tag)
        pixels = canvas.pixels()
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        image = np.clip(np.round(pixels), 0, 255).astype(np.uint8)
        corners = project_undistorted(self.camera, camera_from_tag.apply(tag_corners(tag)))
        return TagPicture(image, tag, camera_from_tag, corners)


def facing(rng: np.random.Generator, distance: float, tilt: float) -> Pose:
    """A tag facing the camera, tilted up to ``tilt`` [rad] and rotated at random."""
    upright = np.diag([1.0, -1.0, -1.0])
    roll = matrix_from_rotation_vector([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    axis = rng.standard_normal(3) * [1, 1, 0]
    lean = matrix_from_rotation_vector(axis / np.linalg.norm(axis) * rng.uniform(0, tilt))
    position = np.array([*rng.uniform(-0.12, 0.12, 2) * distance, distance])
    return Pose(position, lean @ roll @ upright)
