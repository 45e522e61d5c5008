"""Rendering of the synthetic camera: brightness and depth of every sample of the sensor.

Each pixel has 2 × 2 samples (one would move tag corners by 0.09 px), which are averaged at the end.
Every sample has its undistorted viewing ray, so that planes and triangles are intersected exactly,
including lens distortion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from model.files.camera_file import drawn_upside_down
from model.pose import Array, Pose
from model.rig import Camera, Rig, Tag
from model.scene import Scene
from model.shapes import (
    Box,
    Capsule,
    ConvexHull,
    Cylinder,
    Obstacle,
    Shape,
    Sphere,
    TriangleMesh,
    convex_hull,
    shape_points,
)
from tracking.camera_model import pixels_of
from tracking.detection.tags import dictionary, modules_across

#: Samples per pixel along x and along y.
SAMPLES = 2
#: Distance within which surfaces count as touching, so that the one drawn later is visible, [m].
TOUCHING = 5e-4
#: Samples that are drawn at once.
BAND = 32768

Image32 = NDArray[np.float32]
Image8 = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class CanvasRegion:
    """A rectangle of pixels, ends not included."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def empty(self) -> bool:
        """Whether it contains no pixel."""
        return self.right <= self.left or self.bottom <= self.top

    def slices(self, scale: int = 1) -> tuple[slice, slice]:
        """Rows and columns, in samples if ``scale`` is `SAMPLES`."""
        rows = slice(self.top * scale, self.bottom * scale)
        return rows, slice(self.left * scale, self.right * scale)


def region_of(camera: Camera, points_in_camera: Array, margin: int = 2) -> CanvasRegion:
    """Pixels that the hull of points, shape (n, 3), [m], may cover; all if partly behind."""
    if np.any(points_in_camera[:, 2] < 0.02):
        return CanvasRegion(0, 0, camera.width, camera.height)
    pixels = pixels_of(camera, points_in_camera)
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - margin, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + margin + 1, 0, size).astype(int)
    return CanvasRegion(int(low[0]), int(low[1]), int(high[0]), int(high[1]))


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """Brightness (0..255) and depth along the camera's z axis [m] of a region's samples.

    Attributes:
        camera: Owner of the samples.
        region: The pixels covered.
        rays: Shape (2 h, 2 w, 2).
        brightness: Shape (2 h, 2 w).
        depth: Shape (2 h, 2 w), [m].
    """

    camera: Camera
    region: CanvasRegion
    rays: Image32
    brightness: Image32
    depth: Image32

    @classmethod
    def blank(cls, camera: Camera, rays: Image32, brightness: float = 0.0) -> Canvas:
        """An empty canvas of a whole image."""
        shape = rays.shape[:2]
        whole = CanvasRegion(0, 0, camera.width, camera.height)
        light = np.full(shape, brightness, dtype=np.float32)
        return cls(camera, whole, rays, light, np.full(shape, np.inf, dtype=np.float32))

    def part(self, region: CanvasRegion) -> Canvas:
        """A view of a region of this canvas."""
        rows, columns = region.slices(SAMPLES)
        above, left = self.region.top * SAMPLES, self.region.left * SAMPLES
        where = (
            slice(rows.start - above, rows.stop - above),
            slice(columns.start - left, columns.stop - left),
        )
        views = (a[where] for a in (self.rays, self.brightness, self.depth))
        return Canvas(self.camera, region, *views)

    def copy(self) -> Canvas:
        """An independent copy."""
        light, depth = self.brightness.copy(), self.depth.copy()
        return Canvas(self.camera, self.region, self.rays, light, depth)

    def pixels(self) -> Image32:
        """Brightness of the pixels, as means of their samples, shape (h, w)."""
        size = (self.region.right - self.region.left, self.region.bottom - self.region.top)
        return np.asarray(
            cv2.resize(self.brightness, size, interpolation=cv2.INTER_AREA), dtype=np.float32
        )

    def within(self, points_in_camera: Array) -> Canvas | None:
        """The part that the hull of points may cover, or None."""
        inner = region_of(self.camera, points_in_camera)
        own = self.region
        common = CanvasRegion(
            max(inner.left, own.left),
            max(inner.top, own.top),
            min(inner.right, own.right),
            min(inner.bottom, own.bottom),
        )
        return None if common.empty else self.part(common)

    def bands(self) -> Iterator[Canvas]:
        """Views of a few rows each, small enough for a processor's cache."""
        left, top, right, bottom = astuple(self.region)
        height = max(1, BAND // (SAMPLES**2 * (right - left)))
        for first in range(top, bottom, height):
            yield self.part(CanvasRegion(left, first, right, min(first + height, bottom)))

    def paint(self, depth: Image32, brightness: Image32, mask: NDArray[np.bool_]) -> None:
        """Draws a surface where it is in front of the present content."""
        seen = mask & (depth < self.depth + np.float32(TOUCHING))
        np.copyto(self.brightness, brightness, where=seen)
        np.copyto(self.depth, depth, where=seen)


def draw_quad(
    canvas: Canvas, camera_from_quad: Pose, half_size: tuple[float, float], texture: Image32
) -> None:
    """Draws a flat image, visible only from its front (+z).

    Args:
        camera_from_quad: Pose with x to the right of the image, y up, z out of it.
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
    for band in part.bands():
        met = cv2.transform(band.rays, rows)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.asarray(1.0 / met[..., 2], dtype=np.float32)
            column = met[..., 0] * depth
            row = met[..., 1] * depth
        mask = (met[..., 2] > 0) & (column >= -0.5) & (column < width - 0.5)
        mask &= (row >= -0.5) & (row < height - 0.5)
        light = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        band.paint(depth, np.asarray(light, dtype=np.float32), mask)


def draw_triangles(canvas: Canvas, vertices: Array, brightness: Array) -> None:
    """Draws triangles visible from both sides, with interpolated brightness.

    Args:
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


# Obstacle shapes as triangles, for the synthetic camera.


#: Corners around a round shape.
AROUND = 40


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles of a shape in its own frame.

    Attributes:
        vertices: Shape (n, 3, 3), [m].
        normals: Outward unit normals at the vertices, shape (n, 3, 3).
    """

    vertices: Array
    normals: Array


def surface_of(shape: Shape) -> Surface:
    """The surface of an obstacle shape; round ones are accurate to 0.4 % of their radius."""
    match shape:
        case Box():
            hull = convex_hull(shape_points(shape))
            return _faceted(hull.vertices[hull.triangles])
        case ConvexHull(vertices=vertices, triangles=triangles):
            return _faceted(vertices[triangles])
        case TriangleMesh(vertices=vertices, triangles=triangles):
            return _faceted(vertices[triangles])
        case Sphere(radius=radius):
            return _revolved(*_arc(radius, 0.0, -np.pi / 2, np.pi / 2))
        case Capsule(radius=radius, length=length):
            low = _arc(radius, -length / 2, -np.pi / 2, 0.0)
            high = _arc(radius, length / 2, 0.0, np.pi / 2)
            return _revolved(np.vstack([low[0], high[0]]), np.vstack([low[1], high[1]]))
        case Cylinder(radius=radius, length=length):
            h = length / 2
            outline = [(0, -h), (radius, -h), (radius, -h), (radius, h), (radius, h), (0, h)]
            normals = [(0, -1), (0, -1), (1, 0), (1, 0), (0, 1), (0, 1)]
            return _revolved(np.array(outline, dtype=float), np.array(normals, dtype=float))


def _faceted(vertices: Array) -> Surface:
    """Flat triangles, with one normal for all three corners."""
    normal = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(length, 1e-15)
    return Surface(vertices, np.repeat(normal[:, None, :], 3, axis=1))


def _arc(radius: float, height: float, start: float, end: float) -> tuple[Array, Array]:
    """Part of a circle about (0, height) in the (r, z) plane, and its normals."""
    angles = np.linspace(start, end, max(2, int(AROUND * (end - start) / (2 * np.pi)) + 1))
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    return radius * normals + np.array([0.0, height]), normals


def _revolved(outline: Array, normals: Array) -> Surface:
    """Surface of revolution about z of an outline in the (r, z) plane, shape (k, 2)."""
    angles = np.linspace(0.0, 2 * np.pi, AROUND + 1)
    turn = np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def swept(profile: Array) -> Array:
        around = profile[:, None, :1] * turn
        along = np.broadcast_to(profile[:, None, 1:], (*around.shape[:2], 1))
        return np.concatenate([around, along], axis=-1)

    return Surface(_strips(swept(outline)), _strips(swept(normals)))


def _strips(grid: Array) -> Array:
    """The triangles of a grid of points, shape (k, l, 3); shape (n, 3, 3)."""
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    first, second = np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)
    return np.concatenate([first.reshape(-1, 3, 3), second.reshape(-1, 3, 3)])


# Printed tags for the synthetic camera: official images with their white border.


#: Brightness of ink and paper in full light.
INK, PAPER = 28.0, 236.0


@lru_cache(maxsize=256)
def tag_print(family: str, number: int, across: int, down: int) -> Image32:
    """A tag with one white module around it, upright as in its own project.

    Args:
        family: Such as ``tag36h11``.
        number: Number in the family.
        across: Texels along the upper side of a module.
        down: Texels along its left side.
    """
    modules = modules_across(family)
    picture = np.asarray(cv2.aruco.generateImageMarker(dictionary(family), number, modules))
    upright = picture[::-1, ::-1] if drawn_upside_down(family) else picture
    upright = np.pad(upright, 1, constant_values=255)
    print_: Image32 = np.where(upright > 127, PAPER, INK).astype(np.float32)
    return print_.repeat(down, axis=0).repeat(across, axis=1)


# Background of the synthetic camera: floor with shadows, frame tags, obstacles.
#: Direction to the lamp, world frame, and fraction of light on surfaces facing away.
LAMP = np.array([0.35, 0.55, 0.76]) / np.linalg.norm([0.35, 0.55, 0.76])
AMBIENT = 0.62
ROOM, FLOOR, JOINT, EDGE = 96.0, 150.0, 122.0, 90.0
SHADOW = 0.32
#: Floor plate around the outlets, and its texels and joints, [m].
FLOOR_MARGIN, TEXEL, JOINT_PITCH = 0.25, 0.0025, 0.2
OBSTACLE_PAINT = (198.0, 172.0, 184.0, 160.0)


def shade(normals: Array) -> Array:
    """Fraction of full light on surfaces with unit normals, world frame, shape (..., 3)."""
    facing = np.clip(normals @ LAMP, 0.0, 1.0)
    return np.asarray(AMBIENT + (1.0 - AMBIENT) * facing)


def draw_background(canvas: Canvas, rig: Rig, scene: Scene, camera_from_world: Pose) -> None:
    """Draws everything that does not move."""
    surfaces = [surface_of(obstacle.shape) for obstacle in scene.obstacles]
    in_world = [_placed(s, o) for s, o in zip(surfaces, scene.obstacles, strict=True)]
    _draw_floor(canvas, rig, in_world, camera_from_world)
    for tag in rig.frame_tags:
        draw_tag(canvas, rig.tag_family, tag, camera_from_world, Pose.level(np.zeros(3)))
    for index, surface in enumerate(in_world):
        light = OBSTACLE_PAINT[index % len(OBSTACLE_PAINT)] * shade(surface.normals)
        draw_triangles(canvas, camera_from_world.apply(surface.vertices), light)


def draw_tag(
    canvas: Canvas, family: str, tag: Tag, camera_from_world: Pose, world_from_carrier: Pose
) -> None:
    """Draws one printed tag on the floor or on the platform."""
    world_from_tag = world_from_carrier.compose(tag.pose)
    camera_from_tag = camera_from_world.compose(world_from_tag)
    modules = modules_across(family)
    across, down = _texels(canvas.camera, camera_from_tag, tag.size / modules)
    light = np.float32(shade(world_from_tag.rotation[:, 2]))
    half = tag.size * (modules + 2) / modules / 2.0
    draw_quad(
        canvas, camera_from_tag, (half, half), light * tag_print(family, tag.id, across, down)
    )


def _texels(camera: Camera, camera_from_tag: Pose, module: float) -> tuple[int, int]:
    """Texels per module width and height, about one per sample at the tag's distance.

    Interpolation then blurs an edge over one sample, so that 2 x 2 samples show its position
    without a bias that depends on its position between the samples.
    """
    centre, rotation = camera_from_tag.position, camera_from_tag.rotation
    depth = max(0.05, float(centre[2]))
    focal = camera.matrix[[0, 1], [0, 1]] * SAMPLES * module / depth
    right, up = ((rotation[:2, i] - centre[:2] / depth * rotation[2, i]) * focal for i in (0, 1))
    area = abs(float(right[0] * up[1] - right[1] * up[0]))
    width = area / max(1e-9, float(np.linalg.norm(up)))  # across the module's upright edges
    height = area / max(1e-9, float(np.linalg.norm(right)))
    return int(np.clip(round(width), 1, 64)), int(np.clip(round(height), 1, 64))


def _placed(surface: Surface, obstacle: Obstacle) -> Surface:
    normals = surface.normals @ obstacle.pose.rotation.T
    return Surface(obstacle.pose.apply(surface.vertices), normals)


def _draw_floor(
    canvas: Canvas, rig: Rig, obstacles: list[Surface], camera_from_world: Pose
) -> None:
    low = rig.outlets[:, :2].min(axis=0) - FLOOR_MARGIN
    high = rig.outlets[:, :2].max(axis=0) + FLOOR_MARGIN
    texture = _floor_texture(low, high)
    texture *= 1.0 - SHADOW * _shadow(texture.shape, low, high, obstacles)
    centre = np.array([*(low + high) / 2.0, 0.0])
    half = (high - low) / 2.0
    camera_from_floor = camera_from_world.compose(Pose.level(centre))
    draw_quad(canvas, camera_from_floor, (float(half[0]), float(half[1])), texture)


def _floor_texture(low: Array, high: Array) -> Image32:
    """Plates with joints and a slight stain, rows from +y to −y."""
    columns, rows = (int(n) for n in np.ceil((high - low) / TEXEL))
    stain = np.random.default_rng(20).standard_normal((rows // 24 + 2, columns // 24 + 2))
    smooth = cv2.resize(stain.astype(np.float32), (columns, rows), interpolation=cv2.INTER_CUBIC)
    texture = np.float32(FLOOR) + np.float32(4.0) * smooth
    x = low[0] + (np.arange(columns) + 0.5) * TEXEL
    y = high[1] - (np.arange(rows) + 0.5) * TEXEL
    texture[:, np.abs(x - JOINT_PITCH * np.round(x / JOINT_PITCH)) < TEXEL] = JOINT
    texture[np.abs(y - JOINT_PITCH * np.round(y / JOINT_PITCH)) < TEXEL] = JOINT
    texture[:4] = texture[-4:] = EDGE
    texture[:, :4] = texture[:, -4:] = EDGE
    return np.asarray(texture, dtype=np.float32)


def _shadow(
    shape: tuple[int, ...], low: Array, high: Array, obstacles: list[Surface]
) -> NDArray[np.float32]:
    """Fraction of the lamp's light that obstacles block at each texel of the floor."""
    covered = np.zeros(shape, dtype=np.uint8)
    for surface in obstacles:
        points = surface.vertices
        on_floor = points - (points[..., 2:] / LAMP[2]) * LAMP
        texels = np.stack([on_floor[..., 0] - low[0], high[1] - on_floor[..., 1]], axis=-1) / TEXEL
        for triangle in np.round(texels).astype(np.int32):
            cv2.fillConvexPoly(covered, triangle, 1)
    return np.asarray(cv2.GaussianBlur(covered.astype(np.float32), (0, 0), 6.0), dtype=np.float32)
