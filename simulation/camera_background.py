"""What stands still before the synthetic camera: floor with shadows, frame tags, obstacles."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array, Pose
from cdpr.rig import Camera, Rig, Tag
from cdpr.scene import Scene
from cdpr.shapes import Obstacle
from simulation.camera_canvas import SAMPLES, Canvas, Image32, draw_quad, draw_triangles
from simulation.camera_meshes import Surface, surface_of
from simulation.camera_prints import modules_across, tag_print

#: Direction to the lamp, world frame, and how much light the side away from it gets.
LAMP = np.array([0.35, 0.55, 0.76]) / np.linalg.norm([0.35, 0.55, 0.76])
AMBIENT = 0.62
ROOM, FLOOR, JOINT, EDGE = 96.0, 150.0, 122.0, 90.0
SHADOW = 0.32
#: Floor plate around the outlets, and its texels and joints, [m].
FLOOR_MARGIN, TEXEL, JOINT_PITCH = 0.25, 0.0025, 0.2
OBSTACLE_PAINT = (198.0, 172.0, 184.0, 160.0)


def shade(normals: Array) -> Array:
    """Share of full light on surfaces with unit normals, world frame, shape (..., 3)."""
    facing = np.clip(normals @ LAMP, 0.0, 1.0)
    return np.asarray(AMBIENT + (1.0 - AMBIENT) * facing)


def draw_background(canvas: Canvas, rig: Rig, scene: Scene, camera_from_world: Pose) -> None:
    """Draws all that does not move."""
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
    """Texels for a module's width and height, as wide as samples where the tag is seen.

    Interpolation between them then blurs an edge over one sample, and 2 x 2 samples show its place
    without a bias that would hang on where it lies between the samples.
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
    """Share of the lamp's light that obstacles take from each texel of the floor."""
    covered = np.zeros(shape, dtype=np.uint8)
    for surface in obstacles:
        points = surface.vertices
        on_floor = points - (points[..., 2:] / LAMP[2]) * LAMP
        texels = np.stack([on_floor[..., 0] - low[0], high[1] - on_floor[..., 1]], axis=-1) / TEXEL
        for triangle in np.round(texels).astype(np.int32):
            cv2.fillConvexPoly(covered, triangle, 1)
    return np.asarray(cv2.GaussianBlur(covered.astype(np.float32), (0, 0), 6.0), dtype=np.float32)
