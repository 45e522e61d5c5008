"""What lamps, shadows and a camera's own processing do to images.

A lamp's halo and a shadow are light: they come before the sensor's noise. Sharpening, enlarging and
JPEG are done by cameras and drivers to what the sensor gave, noise included.
"""

from __future__ import annotations

import cv2
import numpy as np

from model.rig import Camera
from simulation.camera.rendering import Image8, Image32
from simulation.ground_truth import Optics

LAMP = (0.42, 0.36)
"""Where the lamp's image is, shares of width and height."""
HALO_REACH = 0.12
"""How far its halo falls to a third, share of the width."""
SHADOW_ANGLE, PENUMBRA = 0.5, 2.5
"""Of the shadow's edge against the rows [rad], and how wide it is [px]."""
SHARP_RADIUS = 1.2
"""Of the blur that sharpening takes off, [px]."""


def veil_of(camera: Camera, optics: Optics) -> Image32:
    """Brightness that the lamp's halo adds to each pixel."""
    if optics.halo == 0.0:
        return np.zeros((camera.height, camera.width), np.float32)
    down, across = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    away = np.hypot(across - LAMP[0] * camera.width, down - LAMP[1] * camera.height)
    veil = 255.0 * optics.halo * np.exp(-away / (HALO_REACH * camera.width))
    return np.asarray(veil, dtype=np.float32)


def light_of(camera: Camera, optics: Optics) -> Image32:
    """Share of light that reaches each pixel: lamp, vignetting, and a shadow across the middle."""
    x = (np.arange(camera.width) - (camera.width - 1) / 2.0) / (camera.width / 2.0)
    y = (np.arange(camera.height) - (camera.height - 1) / 2.0) / (camera.width / 2.0)
    radius = x[None, :] ** 2 + y[:, None] ** 2
    light = optics.light * (1.0 - optics.vignetting * radius / radius.max())
    if optics.shadow > 0.0:
        beyond = x[None, :] * np.sin(SHADOW_ANGLE) + y[:, None] * np.cos(SHADOW_ANGLE)
        share = np.clip(beyond * camera.width / 2.0 / PENUMBRA + 0.5, 0.0, 1.0)
        light = light * (1.0 - optics.shadow * share)
    return np.asarray(light, dtype=np.float32)


def before_the_sensor(picture: Image8, optics: Optics) -> Image8:
    """The picture on a sensor of as many times fewer pixels as it is enlarged later."""
    if optics.enlarged == 1:
        return picture
    height, width = picture.shape
    size = (width // optics.enlarged, height // optics.enlarged)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def processed(picture: Image8, size: tuple[int, int], optics: Optics) -> Image8:
    """What the camera makes of what its sensor gave.

    Args:
        picture: Noise included.
        size: Width and height that it gives, [px].
        optics: How.
    """
    if optics.enlarged > 1:
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    if optics.sharpening > 0.0:
        soft = cv2.GaussianBlur(picture, (0, 0), SHARP_RADIUS)
        more = 1.0 + optics.sharpening
        picture = np.asarray(cv2.addWeighted(picture, more, soft, 1.0 - more, 0.0), np.uint8)
    if optics.jpeg < 100:
        _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, optics.jpeg])
        picture = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)
    return picture
