"""Errors and limits in pixels are those of the image, also where a wide lens stretches them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from calibration.extrinsics.surveyed_tags import Survey, locate_by_frame_tags
from calibration.tag_map.observations import TagObservations, TagViews
from model.cameras import generic_camera
from model.errors import Fault
from model.pose import Array, Pose
from model.rig import Camera, Rig, Tag
from tracking.camera_model import image_slopes, pixels_of, point_slopes, undistort_pixels
from tracking.detection.tags import tag_corners
from tracking.edges.refine import RefinedTag
from tracking.estimator import PlatformEstimator, find_consensus
from tracking.measurement import TrackerSettings, rejection_reason
from tracking.pnp import BundlePose, TagView, solve_pnp
from tracking.rolling_shutter import RecentMotion
from tracking.shared_errors import CameraMoved, check_camera, require_unmoved_camera

FOCAL, NOISE = 300.0, 0.08
ANGLES = (0.0, 60.0, 75.0)


def fisheye() -> Camera:
    """Whose pixels are in proportion to the angle; at the world's origin."""
    matrix = np.array([[FOCAL, 0.0, 479.5], [0.0, FOCAL, 479.5], [0.0, 0.0, 1.0]])
    camera = replace(generic_camera((960, 960)), matrix=matrix, distortion=np.zeros(4))
    return replace(camera, lens="fisheye", world_from_camera=Pose.level([0.0, 0.0, 0.0]))


def facing(angle_deg: float, distance: float) -> Pose:
    """The pose of a tag that faces a camera, ``camera_from_tag``, off its axis by an angle."""
    angle = np.radians(angle_deg)
    sight, down = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([0.0, 1.0, 0.0])
    return Pose(distance * sight, np.column_stack([np.cross(down, -sight), down, -sight]))


def square(camera: Camera, pixels: Array, edges: Sequence[bool] = (True,) * 4) -> RefinedTag:
    """A tag at corners in the image, each coordinate with the deviation `NOISE`."""
    step, inverse = 1e-3, np.zeros((8, 8))
    for k, corner in enumerate(pixels):
        shifted = undistort_pixels(camera, corner + step * np.vstack([np.eye(2), -np.eye(2)]))
        own = slice(2 * k, 2 * k + 2)
        inverse[own, own] = (shifted[:2] - shifted[2:]).T / (2.0 * step)
    measured = np.array(edges, dtype=bool)
    whitening = np.linalg.inv(inverse) / NOISE * np.repeat(measured, 2)[:, None]
    corners = undistort_pixels(camera, pixels)
    return RefinedTag(corners, whitening, whitening @ corners.ravel(), measured)


def body() -> list[Tag]:
    corners = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
    return [
        Tag(id=k, size=0.15, pose=Pose.level([x, y, 0.03 * (k % 2)]))
        for k, (x, y) in enumerate(corners)
    ]


def noisy_views(camera: Camera, pose: Pose, hidden: int | None = None) -> list[TagView]:
    """The body's tags with noise in the image; one of them, if given, with a hidden edge."""
    rng, views = np.random.default_rng(1), []
    for tag in body():
        pixels = pixels_of(camera, pose.apply(tag_corners(tag))) + rng.normal(0.0, NOISE, (4, 2))
        edges = (True, tag.id != hidden, True, True)
        views.append(TagView(tag, square(camera, pixels, edges)))
    return views


def fitted(camera: Camera, angle: float, hidden: int | None = None) -> tuple[BundlePose, list]:
    pose = facing(angle, 1.2)
    views = noisy_views(camera, pose, hidden)
    bundle = solve_pnp(camera, views, pose)
    assert bundle is not None
    return bundle, views


@pytest.mark.parametrize("angle", [*ANGLES, 80.0])
def test_a_survey_error_is_as_large_off_the_axis_as_on_it(rig: Rig, angle: float) -> None:
    camera, pose = fisheye(), facing(angle, 2.0)
    tag, shift = Tag(id=1, size=0.15, pose=pose), 5e-4 * pose.rotation[:, 0]
    expected, seen = (pixels_of(camera, tag_corners(tag) + off) for off in (0.0, shift))
    views = [TagView(tag, square(camera, seen))]
    check = check_camera(camera, views)
    assert check.error == pytest.approx(np.sqrt(np.mean(np.sum((seen - expected) ** 2, axis=1))))
    assert check.error == pytest.approx(0.075, rel=0.05)
    assert check.distance == pytest.approx(5e-4, rel=0.02)
    limit = TrackerSettings().camera_moved_px
    require_unmoved_camera(camera, views, limit, check, rig)


@pytest.mark.parametrize("angle", ANGLES)
def test_a_moved_camera_is_reported_with_its_error_in_the_image(rig: Rig, angle: float) -> None:
    camera, pose = fisheye(), facing(angle, 2.0)
    tag, shift = Tag(id=1, size=0.15, pose=pose), 0.02 * pose.rotation[:, 0]
    views = [TagView(tag, square(camera, pixels_of(camera, tag_corners(tag) + shift)))]
    with pytest.raises(CameraMoved) as caught:
        require_unmoved_camera(camera, views, 1.0, check_camera(camera, views), rig)
    assert isinstance(caught.value, Fault)
    assert caught.value.values["error_px"] == pytest.approx(3.0, rel=0.02)
    assert caught.value.values["error_mm"] == pytest.approx(20.0, rel=0.02)


@pytest.mark.parametrize("hidden", [None, 2])
@pytest.mark.parametrize("angle", ANGLES)
def test_good_tags_are_used_wherever_they_are_in_the_image(
    angle: float, hidden: int | None
) -> None:
    bundle, views = fitted(fisheye(), angle, hidden)
    assert bundle.reprojection == pytest.approx(NOISE * np.sqrt(2.0), rel=0.4)
    np.testing.assert_allclose(bundle.certainties, NOISE**-2, rtol=0.02)
    edges = sum(int(view.seen.edges.sum()) for view in views)
    reason = rejection_reason(TrackerSettings(), views, bundle, None, edges, 1.0, [])
    assert "reprojection" not in reason


def test_without_distortion_both_kinds_of_pixels_are_the_same() -> None:
    plain = replace(fisheye(), lens="pinhole", distortion=np.zeros(0))
    bundle, views = fitted(plain, 30.0)
    points = [bundle.camera_from_body.apply(tag_corners(view.tag)) for view in views]
    gaps = [pixels_of(plain, p) - v.seen.corners for p, v in zip(points, views, strict=True)]
    errors = np.mean(np.sum(np.array(gaps) ** 2, axis=2), axis=1)
    np.testing.assert_allclose(bundle.reprojection, np.sqrt(errors.mean()), rtol=1e-9)
    rows = [1.0 / np.mean(1.0 / np.sum(v.seen.whitening**2, axis=1)) for v in views]
    np.testing.assert_allclose(bundle.certainties, rows, rtol=1e-9)
    points = np.array(points)
    np.testing.assert_allclose(image_slopes(plain, points), point_slopes(plain, points), atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_a_stated_error_of_the_tags_is_as_likely_off_the_axis_as_on_it(
    rig: Rig, angle: float
) -> None:
    bundle, _ = fitted(fisheye(), angle)
    stated = replace(rig, tag_error=1e-3)
    estimator = PlatformEstimator(stated, fisheye(), TrackerSettings(), RecentMotion(0.0))
    pixels = 1e-3 / 1.96 * FOCAL / 1.2
    expected = 1.0 + (pixels / NOISE) ** 2
    assert estimator._expected_error(bundle) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("angle", ANGLES)
def test_small_tags_agree_within_pixels_of_the_image(angle: float) -> None:
    """Of tags 12 px wide, one is 2 px off: near enough on the axis, so off the axis as well."""
    camera = fisheye()
    pose = facing(angle, 1.0)
    tags = [Tag(id=k, size=0.04, pose=Pose.level([0.0, 0.1 * k, 0.0])) for k in range(2)]
    pixels = [pixels_of(camera, pose.apply(tag_corners(tag))) for tag in tags]
    off = np.array([2.0, 0.0])
    views = [
        TagView(tags[0], square(camera, pixels[0])),
        TagView(tags[1], square(camera, pixels[1] + off)),
    ]
    found = find_consensus(camera, views, lambda _: True)
    assert [view.tag.id for view in found.views] == [0, 1]


def around(angle: float, distance: float) -> list[Tag]:
    """Tags that face the camera, all around its axis."""
    tags = []
    for k, turn in enumerate(np.radians([0.0, 60.0, 120.0, 180.0, 240.0, 300.0])):
        cos, sin = np.cos(turn), np.sin(turn)
        about = Pose(np.zeros(3), np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]))
        tags.append(Tag(id=k, size=0.15, pose=about.compose(facing(angle, distance))))
    return tags


def noisy_images(camera: Camera, tags: Sequence[Tag], count: int) -> TagObservations:
    rng = np.random.default_rng(3)
    images: dict[str, dict[int, RefinedTag]] = {f"{k}.png": {} for k in range(count)}
    for image in images.values():
        for tag in tags:
            pixels = pixels_of(camera, tag_corners(tag)) + rng.normal(0.0, NOISE, (4, 2))
            image[tag.id] = square(camera, pixels)
    return TagObservations(images, {})


@pytest.mark.parametrize("angle", ANGLES[1:])
def test_a_camera_at_rest_did_not_move_between_its_images(rig: Rig, angle: float) -> None:
    camera, tags = fisheye(), around(angle, 1.5)
    seen = replace(rig, frame_tags=tuple(tags))
    found = locate_by_frame_tags(seen, camera, noisy_images(camera, tags, 5), Survey(1e-4))
    assert not found.unused
    assert found.camera.world_from_camera.distance_to(camera.world_from_camera) < 1e-3
    assert max(found.tag_errors.values()) < 2.0 * NOISE


def test_a_tag_that_was_surveyed_wrongly_is_reported_in_millimetres(rig: Rig) -> None:
    camera, tags = fisheye(), around(75.0, 1.5)
    images = noisy_images(camera, tags, 5)
    own = tags[2].pose
    wrong = replace(tags[2], pose=Pose(own.position + 0.03 * own.rotation[:, 0], own.rotation))
    seen = replace(rig, frame_tags=(*tags[:2], wrong, *tags[3:]))
    found = locate_by_frame_tags(seen, camera, images, Survey(1e-4))
    (reason,) = found.unused.values()
    assert reason.startswith("is measured at least 30.")


@pytest.mark.parametrize("angle", ANGLES)
def test_errors_of_a_tag_layout_are_in_the_image(angle: float) -> None:
    camera, tags, pose = fisheye(), body(), facing(angle, 1.2)
    squares = {view.tag.id: view.seen for view in noisy_views(camera, pose)}
    views = TagViews.of(camera, TagObservations({"a.png": squares}, {}), tags)
    (error,) = views.image_errors([pose], tags)
    assert error == pytest.approx(NOISE * np.sqrt(2.0), rel=0.3)


def test_two_images_of_a_scene_at_rest_are_duplicates_off_the_axis_too() -> None:
    camera = fisheye()
    images = {
        name: {
            tag.id: square(camera, pixels_of(camera, tag_corners(tag)) + shift)
            for tag in around(75.0, 1.5)
        }
        for name, shift in (("a", 0.0), ("b", 0.03))
    }
    once = TagObservations(images, {}).without_duplicates(camera)
    assert once.unused == {"b": "duplicates a: nothing moved in between"}
