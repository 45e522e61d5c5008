"""The synthetic camera: exact positions, correct occlusion, reproducible images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import BadInput
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig
from model.scene import Scene
from model.shapes import (
    Box,
    Capsule,
    Cylinder,
    Obstacle,
    Shape,
    Sphere,
    TriangleMesh,
    convex_hull,
    shape_points,
)
from simulation.camera.camera import Optics, SyntheticCamera, sample_rays
from simulation.camera.rendering import Canvas, draw_triangles, surface_of
from tests.tracking.tag_images import TagPrinter, small_camera
from tracking.camera_model import rays_of

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.1
SHAPES: list[Shape] = [
    Box(np.array([0.1, 0.05, 0.2])),
    Sphere(0.1),
    Cylinder(0.08, 0.3),
    Capsule(0.06, 0.2),
    convex_hull(CORNERS),
    TriangleMesh(CORNERS[:4], np.array([[0, 1, 2], [1, 3, 2]])),
]


def test_the_same_seed_pose_and_frame_give_the_same_picture(
    rig: Rig, scene: Scene, camera: Camera, synthetic: SyntheticCamera
) -> None:
    again = SyntheticCamera(rig, scene, camera, seed=7)
    first = synthetic.render(rig.home, 3)
    np.testing.assert_array_equal(first, again.render(rig.home, 3))
    assert np.any(first != synthetic.render(rig.home, 4))
    assert first.shape == (camera.height, camera.width)
    assert first.dtype == np.uint8


@pytest.mark.parametrize(
    "spoiled",
    [
        Optics(halo=0.5),
        Optics(shadow=0.5),
        Optics(sharpening=1.0),
        Optics(enlarged=2),
        Optics(jpeg=30),
    ],
)
def test_lamps_shadows_and_a_cameras_own_processing_spoil_pictures_as_they_do(
    rig: Rig, scene: Scene, camera: Camera, synthetic: SyntheticCamera, spoiled: Optics
) -> None:
    plain = synthetic.render(rig.home, 0).astype(float)
    picture = SyntheticCamera(rig, scene, camera, seed=7, optics=spoiled).render(rig.home, 0)
    assert picture.shape == plain.shape
    assert picture.dtype == np.uint8
    more, steps = picture - plain, np.abs(np.diff(picture.astype(float), axis=1)).mean()
    usual = np.abs(np.diff(plain, axis=1)).mean()
    if spoiled.halo:
        assert more.mean() > 5.0
        assert more[250:270, 530:550].mean() > more[600:, 1100:].mean() + 30.0
    elif spoiled.shadow:
        assert abs(more[:100, :900].mean()) < 1.0
        below = np.s_[-100:, 400:]
        assert picture[below].mean() == pytest.approx(0.5 * plain[below].mean(), rel=0.05)
    elif spoiled.sharpening:
        assert steps > 1.3 * usual
        assert abs(more.mean()) < 1.0
    else:
        assert steps < 0.9 * usual
        assert abs(more.mean()) < 1.0


def test_an_image_does_not_depend_on_earlier_ones(rig: Rig, synthetic: SyntheticCamera) -> None:
    before = synthetic.render(rig.home, 0)
    synthetic.render(Pose.level([0.2, -0.2, 0.3]), 1)
    np.testing.assert_array_equal(before, synthetic.render(rig.home, 0))


def test_what_is_redrawn_equals_a_picture_drawn_whole(
    rig: Rig, scene: Scene, camera: Camera
) -> None:
    """Only the platform's surroundings are redrawn: none of it may be outside of them."""
    quiet = SyntheticCamera(rig, scene, camera, optics=Optics(noise=0.0))
    pose = Pose(np.array([0.1, 0.05, 0.4]), matrix_from_rotation_vector([0.1, -0.2, 0.4]))
    part = quiet.render(pose)
    quiet._platform_region = lambda _pose: quiet._background.region  # type: ignore[method-assign]
    np.testing.assert_array_equal(part, quiet.render(pose))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_every_shape_is_drawn_where_its_points_are(shape: Shape) -> None:
    camera = small_camera(())
    pose = Pose(np.array([0.05, -0.03, 1.2]), matrix_from_rotation_vector([0.7, 0.4, 0.2]))
    canvas = Canvas.blank(camera, sample_rays(camera))
    vertices = pose.apply(surface_of(shape).vertices)
    draw_triangles(canvas, vertices, np.full(vertices.shape[:2], 200.0))
    inside = np.argwhere(np.isfinite(canvas.depth))[:, ::-1] / 2.0 - 0.25
    radius = getattr(shape, "radius", 0.0)
    points = pose.apply(shape_points(shape))
    pixels = points[:, :2] / points[:, 2:] * 400.0 + [159.5, 119.5]
    slack = radius * 400.0 / (points[:, 2].min() - radius) + 1.0
    assert np.all(inside.min(axis=0) >= pixels.min(axis=0) - slack)
    assert np.all(inside.max(axis=0) <= pixels.max(axis=0) + slack)
    assert np.all(inside.max(axis=0) >= pixels.max(axis=0) + (slack - 1.0) * 0.5 - 2.5)
    assert np.nanmin(canvas.depth) >= points[:, 2].min() - radius - 1e-4


@pytest.mark.parametrize(
    ("lens", "focal", "distortion"),
    [
        ("pinhole", 300.0, [-0.12, 0.05, 0.0008, -0.0006, 0.01]),
        ("pinhole", 110.0, [0.42, 0.01, 0.001, -0.001, 0.0, 0.73, 0.07, 0.0]),
        ("fisheye", 90.0, [0.03, -0.02, 0.015, -0.005]),  # wider than the search for rays
    ],
)
def test_every_ray_is_that_of_its_sample(lens: str, focal: float, distortion: list[float]) -> None:
    matrix = np.array([[focal, 0.0, 159.5], [0.0, focal, 119.5], [0.0, 0.0, 1.0]])
    camera = replace(small_camera(()), lens=lens, matrix=matrix, distortion=np.array(distortion))
    coordinates = np.random.default_rng(3).integers(0, [640, 480], (2000, 2))
    exact = rays_of(lens, matrix, camera.distortion, (coordinates + 0.5) / 2.0 - 0.5)
    off = np.abs(sample_rays(camera)[coordinates[:, 1], coordinates[:, 0]] - exact).max(axis=1)
    assert (off < 2e-7 * (1.0 + np.sum(exact**2, axis=1))).all()


@given(st.floats(0.02, 0.3), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
@settings(max_examples=4)
def test_a_ball_is_as_far_as_its_surface_on_every_ray(radius: float, x: float, y: float) -> None:
    """Against the closed form for rays through the ball, to the accuracy of its triangles."""
    matrix = np.array([[80.0, 0, 31.5], [0, 80, 23.5], [0, 0, 1]])
    camera = replace(small_camera(()), width=64, height=48, matrix=matrix)
    rays = sample_rays(camera)
    centre = np.array([x, y, 1.0])
    canvas = Canvas.blank(camera, rays)
    vertices = centre + surface_of(Sphere(radius)).vertices
    draw_triangles(canvas, vertices, np.full(vertices.shape[:2], 200.0))
    d = np.dstack([rays, np.ones(rays.shape[:2])])
    b, a = d @ centre, np.sum(d * d, axis=-1)
    inner = b * b - a * (centre @ centre - (0.93 * radius) ** 2)
    root = np.sqrt(np.maximum(b * b - a * (centre @ centre - radius**2), 0.0))
    exact = (b - root) / a
    surely = inner > 0
    assert np.all(np.isfinite(canvas.depth[surely]))
    assert np.all(np.abs(canvas.depth - exact)[surely] < 0.03 * radius)


def test_the_platform_is_hidden_by_an_obstacle_and_hides_another(
    rig: Rig, scene: Scene, camera: Camera
) -> None:
    toward = camera.world_from_camera.position - rig.home.position
    toward /= np.linalg.norm(toward)
    wall = Box(np.array([0.2, 0.2, 0.2]))
    platform = _disk(camera, rig.home.position, 20)

    def brightness_spread(offset: np.ndarray) -> float:
        obstacle = Obstacle("wall", wall, Pose.level(rig.home.position + offset))
        still = SyntheticCamera(
            rig, replace(scene, obstacles=(obstacle,)), camera, optics=Optics(noise=0.0)
        )
        return float(np.std(still.render(rig.home)[platform]))

    assert brightness_spread(-0.6 * toward) > 40.0  # tags are visible
    assert brightness_spread(0.6 * toward) < 25.0  # the wall covers them


def _disk(camera: Camera, point: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    at = camera.world_from_camera.inverse().apply(point)
    x, y = at[:2] / at[2] * camera.matrix[0, 0] + camera.matrix[:2, 2]
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    near = rows**2 + columns**2 <= radius**2
    return (rows[near] + round(y), columns[near] + round(x))


def test_tags_lie_where_dense_sampling_puts_them() -> None:
    """The mean brightness of the image equals that of an image with 6 x 6 samples a pixel."""
    camera = small_camera(())
    printer = TagPrinter(camera)
    rng = np.random.default_rng(3)
    pose = Pose(np.array([0.02, -0.01, 0.6]), matrix_from_rotation_vector([np.pi, 0.3, 0.2]))
    picture = printer.image(pose, rng, noise=0.0)
    dense = _sampled(camera, pose, picture.tag.id, 6)
    inside = np.isfinite(dense)
    gap = picture.image[inside].astype(float) - dense[inside]
    ink = np.unique(picture.image[110:130, 150:170]).min()
    assert abs(gap.mean()) < 1.0
    assert np.quantile(np.abs(gap), 0.95) < 0.2 * (240 - float(ink))


def _sampled(camera: Camera, pose: Pose, number: int, samples: int) -> np.ndarray:
    """A tag's image by plain sampling; NaN outside of the black square's inside."""
    from simulation.camera.rendering import INK, PAPER, shade
    from tests.tracking.tag_images import FAMILY, SIZE
    from tracking.detection.tags import official_modules

    modules = official_modules(FAMILY, number)
    light = float(shade(pose.rotation[:, 2]))
    coordinates = (np.arange(camera.width * samples) + 0.5) / samples - 0.5
    heights = (np.arange(camera.height * samples) + 0.5) / samples - 0.5
    x = (coordinates - camera.matrix[0, 2]) / camera.matrix[0, 0]
    y = (heights - camera.matrix[1, 2]) / camera.matrix[1, 1]
    rays = np.dstack([*np.meshgrid(x, y), np.ones((len(y), len(x)))]) @ pose.rotation
    origin = -pose.rotation.T @ pose.position
    share = -origin[2] / rays[..., 2]
    u = (origin[0] + share * rays[..., 0]) / SIZE + 0.5
    v = 0.5 - (origin[1] + share * rays[..., 1]) / SIZE
    inside = (u > 0) & (u < 1) & (v > 0) & (v < 1)
    column = np.clip((u * 8).astype(int), 0, 7)
    row = np.clip((v * 8).astype(int), 0, 7)
    values = np.where(inside, np.where(modules[row, column], PAPER, INK) * light, np.nan)
    blocks = values.reshape(camera.height, samples, camera.width, samples)
    return np.asarray(blocks.mean(axis=(1, 3)))


def test_a_platform_out_of_view_is_no_trouble(rig: Rig, synthetic: SyntheticCamera) -> None:
    behind = synthetic.camera.world_from_camera.apply([0.0, 0.0, -1.0])
    picture = synthetic.render(Pose.level(behind), 0)
    assert picture.shape == (720, 1280)


def test_a_rig_without_tags_is_refused(rig: Rig, scene: Scene, camera: Camera) -> None:
    with pytest.raises(BadInput, match="no tags"):
        SyntheticCamera(replace(rig, tag_family=""), scene, camera)
