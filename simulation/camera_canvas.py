"""What the synthetic camera draws on: brightness and depth behind every sample of the sensor.

Each pixel is sampled 2 × 2 times (drawing once a pixel moves tag corners by 0.09 px); the samples
are averaged at the end. Every sample's viewing ray is undistorted once, so that planes and
triangles are met exactly, lens distortion included.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array, Pose
from cdpr.rig import Camera

#: Samples a pixel along x and along y.
SAMPLES = 2
#: Surfaces nearer to each other than this count as touching: the later drawn one is seen, [m].
TOUCHING = 5e-4

Image32 = NDArray[np.float32]
Image8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of pixels, ends not included."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def empty(self) -> bool:
        """Whether it holds no pixel."""
        return self.right <= self.left or self.bottom <= self.top

    def slices(self, scale: int = 1) -> tuple[slice, slice]:
        """Rows and columns, in samples when ``scale`` is `SAMPLES`."""
        rows = slice(self.top * scale, self.bottom * scale)
        return rows, slice(self.left * scale, self.right * scale)


def sample_rays(camera: Camera) -> Image32:
    """Viewing ray (x, y, 1) of every sample, camera frame; shape (2 height, 2 width, 2)."""
    columns = (np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES - 0.5
    rows = (np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES - 0.5
    points = np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float32)
    straight = cv2.undistortPoints(points.reshape(-1, 1, 2), camera.matrix, camera.distortion)
    return np.asarray(straight, dtype=np.float32).reshape(points.shape)


def pixels_of(camera: Camera, points_in_camera: Array) -> Array:
    """Distorted pixels of points in front of the camera, shape (n, 3), [m]; shape (n, 2)."""
    zero = np.zeros(3)
    points = np.ascontiguousarray(points_in_camera, dtype=np.float64)
    pixels = cv2.projectPoints(points, zero, zero, camera.matrix, camera.distortion)[0]
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def region_of(camera: Camera, points_in_camera: Array, margin: int = 2) -> Region:
    """Pixels that the hull of points, shape (n, 3), [m], can cover; all if it is partly behind."""
    if np.any(points_in_camera[:, 2] < 0.02):
        return Region(0, 0, camera.width, camera.height)
    pixels = pixels_of(camera, points_in_camera)
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - margin, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + margin + 1, 0, size).astype(int)
    return Region(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """Brightness (0..255) and depth along the camera's z axis [m] of the samples of a region.

    Attributes:
        camera: Whose samples they are.
        region: The pixels it covers.
        rays: Shape (2 h, 2 w, 2).
        brightness: Shape (2 h, 2 w).
        depth: Shape (2 h, 2 w), [m].
    """

    camera: Camera
    region: Region
    rays: Image32
    brightness: Image32
    depth: Image32

    @classmethod
    def blank(cls, camera: Camera, rays: Image32, brightness: float = 0.0) -> Canvas:
        """A whole picture with nothing in it."""
        shape = rays.shape[:2]
        whole = Region(0, 0, camera.width, camera.height)
        light = np.full(shape, brightness, dtype=np.float32)
        return cls(camera, whole, rays, light, np.full(shape, np.inf, dtype=np.float32))

    def part(self, region: Region) -> Canvas:
        """The same canvas within a region of it: a view, not a copy."""
        rows, columns = region.slices(SAMPLES)
        above, left = self.region.top * SAMPLES, self.region.left * SAMPLES
        where = (
            slice(rows.start - above, rows.stop - above),
            slice(columns.start - left, columns.stop - left),
        )
        views = (a[where] for a in (self.rays, self.brightness, self.depth))
        return Canvas(self.camera, region, *views)

    def copy(self) -> Canvas:
        """A canvas that can be drawn on without changing this one."""
        light, depth = self.brightness.copy(), self.depth.copy()
        return Canvas(self.camera, self.region, self.rays, light, depth)

    def pixels(self) -> Image32:
        """Brightness of the pixels: the mean of their samples; shape (h, w)."""
        size = (self.region.right - self.region.left, self.region.bottom - self.region.top)
        return np.asarray(
            cv2.resize(self.brightness, size, interpolation=cv2.INTER_AREA), dtype=np.float32
        )

    def within(self, points_in_camera: Array) -> Canvas | None:
        """The part that the hull of points can cover, or None."""
        inner = region_of(self.camera, points_in_camera)
        mine = self.region
        common = Region(
            max(inner.left, mine.left),
            max(inner.top, mine.top),
            min(inner.right, mine.right),
            min(inner.bottom, mine.bottom),
        )
        return None if common.empty else self.part(common)

    def paint(self, depth: Image32, brightness: Image32, mask: NDArray[np.bool_]) -> None:
        """Puts a surface on the canvas where it is in front of what is there."""
        seen = mask & (depth < self.depth + np.float32(TOUCHING))
        np.copyto(self.brightness, brightness, where=seen)
        np.copyto(self.depth, depth, where=seen)


def draw_quad(
    canvas: Canvas, camera_from_quad: Pose, half_size: tuple[float, float], texture: Image32
) -> None:
    """Draws a flat picture, seen from its front (+z) only.

    Args:
        canvas: What to draw on.
        camera_from_quad: x to the right of the picture, y up, z out of it.
        half_size: Half width and half height, [m].
        texture: Brightness 0..255, shape (rows, columns).
    """
    centre, rotation = camera_from_quad.position, camera_from_quad.rotation
    if rotation[:, 2] @ centre >= 0.0:  # seen from behind
        return
    right, down = rotation[:, 0] * half_size[0], -rotation[:, 1] * half_size[1]
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    part = canvas.within(centre + signs @ np.array([right, down]))
    if part is None:
        return
    # ray · t = centre + u right + v down, so (u, v, 1) / t = inverse · ray.
    inverse = np.linalg.inv(np.column_stack([right, down, centre]))
    height, width = texture.shape
    to_texels = np.array([[width / 2, 0, width / 2 - 0.5], [0, height / 2, height / 2 - 0.5]])
    rows = np.vstack([to_texels @ inverse, inverse[2]]).astype(np.float32)
    met = cv2.transform(part.rays, rows)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.asarray(1.0 / met[..., 2], dtype=np.float32)
        column = met[..., 0] * depth
        row = met[..., 1] * depth
    mask = (met[..., 2] > 0) & (column >= -0.5) & (column < width - 0.5)
    mask &= (row >= -0.5) & (row < height - 0.5)
    light = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    part.paint(depth, np.asarray(light, dtype=np.float32), mask)


def draw_triangles(canvas: Canvas, vertices: Array, brightness: Array) -> None:
    """Draws triangles, both sides seen, brightness blended between their corners.

    Args:
        canvas: What to draw on.
        vertices: Camera frame, shape (n, 3, 3), [m].
        brightness: Of each corner, 0..255, shape (n, 3).
    """
    for corners, light in zip(vertices, brightness, strict=True):
        part = canvas.within(corners)
        columns = corners.T
        if part is None or abs(np.linalg.det(columns)) < 1e-12:  # out of view, or seen edge-on
            continue
        # ray · t = Σ weight · corner with Σ weight = 1, so weight / t = inverse · ray.
        inverse = np.linalg.inv(columns)
        rows = np.vstack([inverse, inverse.sum(axis=0), light @ inverse]).astype(np.float32)
        met = [cv2.transform(part.rays, row[None]) for row in rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.asarray(1.0 / met[3], dtype=np.float32)
            value = np.asarray(met[4] * depth, dtype=np.float32)
        least = met[3] * np.float32(-1e-5)  # rounding must not open cracks between triangles
        mask = (met[0] >= least) & (met[1] >= least) & (met[2] >= least) & (met[3] > 0)
        part.paint(depth, value, np.asarray(mask))
