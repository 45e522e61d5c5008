"""Images of single tags under one hard condition each, with exactly known corners."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from model.pose import Array, Pose, matrix_from_rotation_vector
from model.rig import Camera, Tag
from simulation.camera.camera import sample_rays
from simulation.camera.rendering import Canvas, draw_tag
from tests.tracking.tag_images import SIZE, small_camera
from tracking.camera_model import pixels_of
from tracking.detection.tags import tag_corners

WALL = 120.0


@dataclass(frozen=True)
class Condition:
    """Imaging condition of a tag.

    Attributes:
        side_px: Side of its square in a frontal view.
        tilt: Between its normal and the view, [rad].
        motion_px: Motion of the image during the exposure.
        blur_px: Standard deviation of the lens's blur.
        contrast: Brightness of paper minus that of ink, of 255.
        noise: Standard deviation, of 255.
    """

    side_px: float = 48.0
    tilt: float = 0.4
    motion_px: float = 0.0
    blur_px: float = 0.0
    contrast: float = 208.0
    noise: float = 1.5


@dataclass(frozen=True)
class HardImage:
    """An image of one tag and its true corners, shape (4, 2), [px], lens included."""

    image: NDArray[np.uint8]
    number: int
    corners: Array


class HardPrinter:
    """Renders one tag in front of a grey wall.

    Args:
        family: Of the tag.
        numbers: Number of tags in the family.
        camera: The camera of the images.
    """

    def __init__(self, family: str, numbers: int, camera: Camera | None = None) -> None:
        self.family, self.numbers, self.camera = family, numbers, camera or small_camera()
        self._rays = sample_rays(self.camera)

    def image(self, condition: Condition, rng: np.random.Generator) -> HardImage:
        """An image with a tag at a random position and rotation."""
        number = int(rng.integers(self.numbers))
        tag = Tag(number, SIZE, Pose.level(np.zeros(3)))
        pose = self._pose(condition, rng)
        canvas = Canvas.blank(self.camera, self._rays, WALL)
        draw_tag(canvas, self.family, tag, Pose.level(np.zeros(3)), pose)
        if condition.motion_px > 0:
            streak = _streak(2.0 * condition.motion_px, rng.uniform(0, np.pi))
            canvas.brightness[:] = cv2.filter2D(canvas.brightness, -1, streak)
        pixels = canvas.pixels()
        if condition.blur_px > 0:
            pixels = np.asarray(cv2.GaussianBlur(pixels, (0, 0), condition.blur_px), np.float32)
        pixels = 132.0 + (pixels - 132.0) * np.float32(condition.contrast / 208.0)
        pixels = pixels + condition.noise * rng.standard_normal(pixels.shape)
        image = np.clip(np.round(pixels), 0, 255).astype(np.uint8)
        return HardImage(image, number, pixels_of(self.camera, pose.apply(tag_corners(tag))))

    def _pose(self, condition: Condition, rng: np.random.Generator) -> Pose:
        distance = float(self.camera.matrix[0, 0]) * SIZE / condition.side_px
        upright = np.diag([1.0, -1.0, -1.0])
        roll = matrix_from_rotation_vector([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        angle = rng.uniform(-np.pi, np.pi)
        axis = np.array([np.cos(angle), np.sin(angle), 0.0])
        lean = matrix_from_rotation_vector(axis * condition.tilt)
        position = np.array([*rng.uniform(-0.1, 0.1, 2) * distance, distance])
        return Pose(position, lean @ upright @ roll)


def _streak(length: float, angle: float) -> NDArray[np.float32]:
    """Blur kernel of a steady motion: a line about the centre, in samples."""
    size = 2 * (int(length) // 2 + 2) + 1
    kernel = np.zeros((size, size), dtype=np.float64)
    middle = size // 2
    for share in np.linspace(-0.5, 0.5, 201):
        x = middle + share * length * np.cos(angle)
        y = middle + share * length * np.sin(angle)
        column, row = int(np.floor(x)), int(np.floor(y))
        right, down = x - column, y - row
        kernel[row, column] += (1 - right) * (1 - down)
        kernel[row, column + 1] += right * (1 - down)
        kernel[row + 1, column] += (1 - right) * down
        kernel[row + 1, column + 1] += right * down
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
