"""The synthetic camera: images of the rig with an exactly known pose.

Tags, platform and obstacles are intersected with the undistorted ray of every sample, 2 × 2 samples
per pixel. The background is drawn once; each image redraws the platform's region and the cables.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.kinematics import cables_at
from model.pose import Array, Pose
from model.rig import Camera, Rig
from model.scene import Scene
from simulation.camera.cables import draw_cables
from simulation.camera.rendering import (
    ROOM,
    SAMPLES,
    Canvas,
    CanvasRegion,
    Image8,
    Image32,
    draw_background,
    draw_quad,
    draw_tag,
    region_of,
    shade,
)
from simulation.ground_truth import Optics
from tracking.camera_model import encoded, pixels_of, rays_of
from tracking.rolling_shutter import PlatformMotion

# Effects of lamps, shadows and the camera's image processing.
#
# A lamp's halo and a shadow are light, so they precede the sensor's noise. Sharpening, enlarging
# and JPEG compression follow it, as in cameras and drivers.


LAMP = (0.42, 0.36)
"""Position of the lamp's image, fractions of width and height."""
HALO_REACH = 0.12
"""Distance at which its halo falls to 1/e, fraction of the width."""
SHADOW_ANGLE, PENUMBRA = 0.5, 2.5
"""Angle of the shadow's edge to the rows [rad], and its width [px]."""
SHARP_RADIUS = 1.2
"""Standard deviation of the blur in unsharp masking, [px]."""


def halo_of(camera: Camera, optics: Optics) -> Image32:
    """Brightness that the lamp's halo adds to each pixel."""
    if optics.halo == 0.0:
        return np.zeros((camera.height, camera.width), np.float32)
    down, across = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    away = np.hypot(across - LAMP[0] * camera.width, down - LAMP[1] * camera.height)
    halo = 255.0 * optics.halo * np.exp(-away / (HALO_REACH * camera.width))
    return np.asarray(halo, dtype=np.float32)


def light_of(camera: Camera, optics: Optics) -> Image32:
    """Fraction of light at each pixel: lamp, vignetting, and a shadow across the middle."""
    x = (np.arange(camera.width) - (camera.width - 1) / 2.0) / (camera.width / 2.0)
    y = (np.arange(camera.height) - (camera.height - 1) / 2.0) / (camera.width / 2.0)
    radius = x[None, :] ** 2 + y[:, None] ** 2
    light = optics.light * (1.0 - optics.vignetting * radius / radius.max())
    if optics.shadow > 0.0:
        beyond = x[None, :] * np.sin(SHADOW_ANGLE) + y[:, None] * np.cos(SHADOW_ANGLE)
        share = np.clip(beyond * camera.width / 2.0 / PENUMBRA + 0.5, 0.0, 1.0)
        light = light * (1.0 - optics.shadow * share)
    return np.asarray(light, dtype=np.float32)


def reduced_to_sensor(picture: Image8, optics: Optics) -> Image8:
    """The image reduced to the sensor's pixels, before it is enlarged again."""
    if optics.enlarged == 1:
        return picture
    height, width = picture.shape
    size = (width // optics.enlarged, height // optics.enlarged)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def apply_processing(picture: Image8, size: tuple[int, int], optics: Optics) -> Image8:
    """The image after the camera's processing.

    Args:
        picture: From the sensor, with noise.
        size: Output width and height, [px].
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


# Viewing ray of every sample of the sensor.
#: Samples between exactly undistorted rays; the others are interpolated, as a lens is smooth.
RAY_STEP = 8
#: Every how many rays one is checked, and largest accepted error, [rad].
RAYS_CHECKED, RAY_TOLERANCE = 97, 1e-7


def sample_rays(camera: Camera) -> Image32:
    """Viewing ray (x, y, 1) of every sample, camera frame; shape (2 height, 2 width, 2).

    Cameras with the same lens and size share the array, which is read-only.
    """
    matrix, distortion = (tuple(a.ravel().tolist()) for a in (camera.matrix, camera.distortion))
    return _rays(camera.width, camera.height, camera.lens, matrix, distortion)


@lru_cache(maxsize=2)
def _rays(
    width: int, height: int, lens: str, matrix: tuple[float, ...], distortion: tuple[float, ...]
) -> Image32:
    """Rays by cubic interpolation of a coarse grid, or exact ones if that is inaccurate."""

    def exact(points: Array) -> Array:
        return rays_of(lens, np.array(matrix).reshape(3, 3), np.array(distortion), points)

    columns, rows = (_nodes(SAMPLES * size) for size in (width, height))
    coarse = exact(np.stack(np.meshgrid(columns, rows), axis=-1)).reshape(len(rows), -1, 2)
    rays = np.empty((SAMPLES * height, SAMPLES * width, 2), dtype=np.float32)
    for axis in (0, 1):
        down = _between(coarse[..., axis].T, SAMPLES * height)
        rays[..., axis] = _between(down.T, SAMPLES * width)
    y, x = np.divmod(np.arange(0, rays.size // 2, RAYS_CHECKED), SAMPLES * width)
    checked = exact((np.column_stack([x, y]) + 0.5) / SAMPLES - 0.5)
    off = np.abs(rays[y, x] - checked).max(axis=1) / (1.0 + np.sum(checked**2, axis=1))
    if not off.max() < RAY_TOLERANCE:
        every = np.stack(np.meshgrid(np.arange(SAMPLES * width), np.arange(SAMPLES * height)), -1)
        rays[:] = exact((every + 0.5) / SAMPLES - 0.5).reshape(rays.shape)
    rays.flags.writeable = False
    return rays


def _nodes(count: int) -> Array:
    """Position of every `RAY_STEP`-th of ``count`` samples, extending beyond both ends, [px]."""
    return (np.arange(-1, -(-count // RAY_STEP) + 2) * RAY_STEP + 0.5) / SAMPLES - 0.5


def _between(values: Array, count: int) -> Array:
    """Values at ``count`` samples, shape (n, count), from those at `_nodes`, shape (n, k)."""
    u = np.arange(RAY_STEP) / RAY_STEP
    weights = np.array(
        [
            -u * (u - 1.0) * (u - 2.0) / 6.0,
            (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
            -(u + 1.0) * u * (u - 2.0) / 2.0,
            (u + 1.0) * u * (u - 1.0) / 6.0,
        ]
    )
    around = np.stack([values[:, k : values.shape[1] - 3 + k] for k in range(4)], axis=-1)
    return np.asarray((around @ weights).reshape(len(values), -1)[:, :count])


# Image sequences.


class ImageSequence:
    """Images of one camera, each with motion blur from the motion since the previous one.

    The first is sharp. Between images the platform moves uniformly.
    """

    def __init__(self, camera: SyntheticCamera) -> None:
        self._camera = camera
        self._before: tuple[float, Pose] | None = None

    def image(self, time: float, pose: Pose, frame: int) -> Image8:
        """The next image.

        Args:
            time: At the middle of its exposure, [s].
            pose: Of the platform there, ``world_from_platform``.
            frame: Number of the image, which selects the noise.

        Returns:
            Grey image, shape (height, width).
        """
        motion = None
        if self._before is not None and time > self._before[0]:
            motion = PlatformMotion.between(self._before[1], pose, time - self._before[0])
        self._before = time, pose
        return self._camera.render(pose, frame, motion)


#: Brightness of the platform's faces in full light.
PLATFORM = 168.0
#: Distance to the lens below which the platform is not drawn or not blurred, [m].
NEAREST = 0.02
#: Distance of the poses that make up motion blur, [px], and their largest number.
SMEAR_STEP, MOST_POSES = 0.5, 64
#: Times within an exposure over which a row of a rolling shutter is averaged.
_SUB_TIMES = 8
#: Shorter motion blur is invisible, [px].
LEAST_SMEAR = 0.02
#: Margin of the precomputed noise, from which each image takes a different part, [px].
NOISE_SLACK = 96


class SyntheticCamera:
    """Renders images of a simulated rig.

    Args:
        rig: Platform, tags and cables.
        scene: Obstacles.
        camera: One of the rig's cameras, or another.
        seed: Of the noise; the same seed, pose and frame give the same image.
        optics: Imperfections of lens and sensor.

    Raises:
        BadInput: The rig has no tags.
    """

    def __init__(
        self, rig: Rig, scene: Scene, camera: Camera, seed: int = 0, optics: Optics | None = None
    ) -> None:
        if not rig.tag_family:
            raise BadInput(
                "the rig has no tags, so a camera cannot measure it",
                where=f"rig {rig.name}",
                next_step="add a `tags` section to the rig file",
            )
        self.rig, self.camera, self.seed = rig, camera, seed
        self.optics = optics or Optics()
        self._camera_from_world = camera.world_from_camera.inverse()
        self._background = _background(rig, scene, camera)
        self._light, self._halo = light_of(camera, self.optics), halo_of(camera, self.optics)
        self._still = self._exposed(self._background, self._light, self._halo)
        self._depth = self._background.depth[1::SAMPLES, 1::SAMPLES].copy()
        self._noise = _noise(camera, self.optics.noise, seed)

    def render(self, pose: Pose, frame: int = 0, motion: PlatformMotion | None = None) -> Image8:
        """The image with the platform at ``pose`` (``world_from_platform``).

        Args:
            pose: True pose in the middle of the exposure.
            frame: Number of the image, which selects the noise.
            motion: Of the platform during the exposure (default: at rest).

        Returns:
            Grey image, shape (height, width).
        """
        if self.camera.readout != 0.0 and motion is not None:
            light = self._row_by_row(pose, motion)
        else:
            poses = self._while_exposed(pose, motion)
            if len(poses) == 1:
                return self._taken(self._at(pose), frame)
            light = np.zeros(self._still.shape, np.float32)
            for one in poses:
                light += self._at(one)
            light /= len(poses)
        # Stochastic rounding: the mean of two values is a tie half the time, and any rule for ties
        # would make edges brighter or darker.
        chance = np.random.default_rng([self.seed, frame, 0x5EA2]).random(light.shape, np.float32)
        mean = np.floor(light + chance)
        return self._taken(np.asarray(np.minimum(mean, 255.0), dtype=np.uint8), frame)

    def _while_exposed(self, pose: Pose, motion: PlatformMotion | None) -> list[Pose]:
        """Poses at the midpoints of equal parts of the exposure, close enough for smooth blur."""
        time = self.optics.exposure
        if motion is None or time <= 0.0:
            return [pose]
        smear = self._smear(pose, motion, (-0.5 * time, 0.5 * time))
        count = 1 if smear < LEAST_SMEAR else min(MOST_POSES, 1 + math.ceil(smear / SMEAR_STEP))
        return [motion.moved(pose, ((k + 0.5) / count - 0.5) * time) for k in range(count)]

    def _smear(self, pose: Pose, motion: PlatformMotion, times: tuple[float, float]) -> float:
        """Largest displacement of the platform's corners, [px]; 0 too close to the lens."""
        ends = (motion.moved(pose, time) for time in times)
        seen = [self._camera_from_world.apply(p.apply(self.rig.platform_corners)) for p in ends]
        if min(float(corners[:, 2].min()) for corners in seen) < NEAREST:
            return 0.0
        first, last = (pixels_of(self.camera, corners) for corners in seen)
        return float(np.linalg.norm(last - first, axis=1).max())

    def _row_by_row(self, pose: Pose, motion: PlatformMotion) -> Image32:
        """Light of a platform with rows exposed one after the other, in the image's shape.

        Each row blends the images of the poses before and after; as these are closer than
        `SMEAR_STEP`, edges are in the right position.
        """
        rows = np.zeros((self.camera.height, 2))
        rows[:, 1] = np.arange(self.camera.height)
        half = self.optics.exposure / 2.0
        of_rows = self.camera.row_times(rows)
        first, last = float(of_rows.min()), float(of_rows.max())
        regions = [self._platform_region(motion.moved(pose, time)) for time in (first, last)]
        seen = [region for region in regions if not region.empty]
        if seen:  # only rows that show the platform need poses
            top = max(0, min(region.slices()[0].start for region in seen) - 1)
            bottom = min(len(rows), max(region.slices()[0].stop for region in seen) + 1)
            first, last = sorted((float(of_rows[top]), float(of_rows[bottom - 1])))
        ends = (first - half, last + half)
        count = min(MOST_POSES, 2 + math.ceil(self._smear(pose, motion, ends) / SMEAR_STEP))
        times = np.linspace(*ends, count)
        within = (np.arange(_SUB_TIMES) + 0.5) / _SUB_TIMES - 0.5 if half > 0.0 else np.zeros(1)
        exposed = np.clip(of_rows[:, None] + 2.0 * half * within, *ends)
        index = (exposed - ends[0]) / (ends[1] - ends[0]) * (count - 1)
        light = np.zeros(self._still.shape, np.float32)
        for k, time in enumerate(times):
            share = np.maximum(0.0, 1.0 - np.abs(index - k)).mean(axis=1)
            light += share[:, None].astype(np.float32) * self._at(motion.moved(pose, float(time)))
        return light

    def _at(self, pose: Pose) -> Image8:
        """The image of a platform at rest, without noise."""
        picture, depth = self._still.copy(), self._depth
        region = self._platform_region(pose)
        if not region.empty:
            canvas = self._background.part(region).copy()
            self._draw_platform(canvas, pose)
            rows, columns = region.slices()
            parts = self._light[rows, columns], self._halo[rows, columns]
            picture[rows, columns] = self._exposed(canvas, *parts)
            depth = depth.copy()
            depth[rows, columns] = canvas.depth[1::SAMPLES, 1::SAMPLES]
        if self.optics.cables:
            cables, radius = cables_at(self.rig, pose), self.rig.cable_radius
            draw_cables(picture, depth, self.camera, cables, self._camera_from_world, radius)
        return picture

    def _platform_region(self, pose: Pose) -> CanvasRegion:
        corners = self._camera_from_world.apply(pose.apply(self.rig.platform_corners))
        if np.all(corners[:, 2] < NEAREST):
            return CanvasRegion(0, 0, 0, 0)
        return region_of(self.camera, corners, margin=8)

    def _draw_platform(self, canvas: Canvas, pose: Pose) -> None:
        for face, half_size in _faces(self.rig):
            world_from_face = pose.compose(face)
            light = np.float32(PLATFORM * shade(world_from_face.rotation[:, 2]))
            texture = np.full((32, 32), light, dtype=np.float32)
            texture[[0, -1]] *= np.float32(0.8)
            texture[:, [0, -1]] *= np.float32(0.8)
            draw_quad(canvas, self._camera_from_world.compose(world_from_face), half_size, texture)
        for tag in self.rig.platform_tags:
            draw_tag(canvas, self.rig.tag_family, tag, self._camera_from_world, pose)

    def _exposed(self, canvas: Canvas, light: Image32, halo: Image32) -> Image8:
        pixels = canvas.pixels()
        if self.optics.blur > 0:
            pixels = np.asarray(cv2.GaussianBlur(pixels, (0, 0), self.optics.blur), np.float32)
        return np.asarray(np.clip(pixels * light + halo + 0.5, 0, 255), dtype=np.uint8)

    def _taken(self, picture: Image8, frame: int) -> Image8:
        """The image after sensor noise and processing."""
        size = (self.camera.width, self.camera.height)
        noisy = self._with_noise(reduced_to_sensor(picture, self.optics), frame)
        return apply_processing(encoded(self.camera, noisy), size, self.optics)

    def _with_noise(self, picture: Image8, frame: int) -> Image8:
        if self.optics.noise <= 0:
            return picture
        down, right = np.random.default_rng([self.seed, frame]).integers(0, NOISE_SLACK, 2)
        height, width = picture.shape
        noise = np.ascontiguousarray(self._noise[down : down + height, right : right + width])
        noisy = np.asarray(cv2.add(picture, noise, dtype=cv2.CV_8U), dtype=np.uint8)
        np.copyto(noisy, 255, where=picture == 255)  # a saturated pixel stays white
        return noisy


@lru_cache(maxsize=2)
def _background(rig: Rig, scene: Scene, camera: Camera) -> Canvas:
    """Everything but the platform; cameras of other optics or noise share it, read-only."""
    canvas = Canvas.blank(camera, sample_rays(camera), ROOM)
    draw_background(canvas, rig, scene, camera.world_from_camera.inverse())
    canvas.brightness.flags.writeable = canvas.depth.flags.writeable = False
    return canvas


def _faces(rig: Rig) -> list[tuple[Pose, tuple[float, float]]]:
    """``platform_from_face`` (z outward) and half width and height of the box's faces, [m]."""
    faces = []
    for axis in range(3):
        across, up = (axis + 1) % 3, (axis + 2) % 3
        for sign in (1.0, -1.0):
            rotation = np.zeros((3, 3))
            rotation[across, 0], rotation[up, 1], rotation[axis, 2] = sign, 1.0, sign
            centre = rotation[:, 2] * rig.half_size[axis]
            half = (float(rig.half_size[across]), float(rig.half_size[up]))
            faces.append((Pose(centre, rotation), half))
    return faces


def _noise(camera: Camera, deviation: float, seed: int) -> NDArray[np.int16]:
    """Noise larger than an image by `NOISE_SLACK`."""
    shape = (camera.height + NOISE_SLACK, camera.width + NOISE_SLACK)
    values = np.random.default_rng([seed, 0xCA3E]).standard_normal(shape, dtype=np.float32)
    return np.round(values * np.float32(deviation)).astype(np.int16)
