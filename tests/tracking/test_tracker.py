"""The tracker on rendered images: accurate, with correct covariance, never mirrored."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
import pytest

from calibration.tag_map.observations import observe_tags
from model.errors import BadInput
from model.pose import (
    Array,
    Pose,
    interpolate,
    matrix_from_rotation_vector,
    rotation_vector_from_matrix,
)
from model.rig import Camera, Rig
from model.scene import Scene
from simulation.camera.camera import Optics, SyntheticCamera
from tracking.camera_model import Image, pixels_of
from tracking.detection.detector import Detection, TagDetector
from tracking.detection.diagnostics import are_mirrored, diagnose_tags
from tracking.detection.tags import alike_in_mirror, dictionary
from tracking.measurement import NoPose, PoseMeasurement, TrackerSettings
from tracking.shared_errors import CameraMoved
from tracking.tracker import Tracker


def along(points: list[list[float]], count: int) -> Iterator[Pose]:
    """Level poses along a polyline."""
    for a, b in pairwise(points):
        for k in range(count):
            yield interpolate(Pose.level(a), Pose.level(b), k / count)


def error_of(found: PoseMeasurement, truth: Pose) -> Array:
    turn = rotation_vector_from_matrix(found.pose.rotation @ truth.rotation.T)
    return np.concatenate([found.pose.position - truth.position, turn])


def test_a_path_is_measured_to_half_a_millimetre(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    tracker = Tracker(rig, camera, TrackerSettings(camera_moved_px=0.1))  # in every check
    waypoints = [[0.18, 0.18, 0.3], [0.1, 0.0, 0.5], [0.0, -0.15, 0.55], [-0.18, -0.18, 0.4]]
    errors, normalised, states = [], [], []
    for frame, truth in enumerate(along(waypoints, count=20)):
        found = tracker.observe(synthetic.render(truth, frame), frame * 0.1)
        assert isinstance(found, PoseMeasurement), found
        error = error_of(found, truth)
        errors.append(error)
        normalised.append(error @ np.linalg.solve(found.covariance, error))
        states.append(found.status)
        assert set(found.tags) <= set(tracker.expected_tags)
    by_pose = np.array(errors)
    position = np.linalg.norm(by_pose[:, :3], axis=1)
    rotation = np.degrees(np.linalg.norm(by_pose[:, 3:], axis=1))
    assert np.sqrt(np.mean(position**2)) < 0.5e-3
    assert np.sqrt(np.mean(rotation**2)) < 0.1
    assert np.mean(normalised) < 8.0  # 6 would be exact
    assert np.all(position < 5e-3)
    assert states[0] == "found"
    assert states.count("tracked") >= len(states) - 3


def test_rotated_poses_are_found_without_a_guess_and_never_mirrored(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    rng, tracker = np.random.default_rng(5), Tracker(rig, camera)
    found_count = 0
    for frame in range(24):
        position = rng.uniform([-0.2, -0.2, 0.2], [0.2, 0.2, 0.6])
        truth = Pose(position, matrix_from_rotation_vector(rng.normal(size=3) * 0.15))
        tracker.forget()
        found = tracker.observe(synthetic.render(truth, frame), float(frame))
        if isinstance(found, NoPose):
            continue  # behind the obstacle
        found_count += 1
        error = error_of(found, truth)
        assert np.linalg.norm(error[:3]) < 3e-3
        assert np.linalg.norm(error[3:]) < np.radians(1.0)
        assert np.all(np.abs(error) < 6.0 * np.sqrt(np.diag(found.covariance)))
    assert found_count >= 21


def test_a_sudden_jump_is_followed_by_searching_the_whole_picture(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    tracker = Tracker(rig, camera)
    first, second = Pose.level([0.1, 0.1, 0.4]), Pose.level([-0.1, 0.1, 0.55])
    tracker.observe(synthetic.render(first, 0), 0.0)
    found = tracker.observe(synthetic.render(second, 1), 0.1)
    assert isinstance(found, PoseMeasurement)
    assert found.status == "found"
    assert found.pose.distance_to(second) < 2e-3


def test_a_platform_behind_an_obstacle_gives_a_reason_and_is_found_again(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    tracker = Tracker(rig, camera)
    seen = synthetic.render(Pose.level([0.1, 0.1, 0.4]), 0)
    covered = seen.copy()
    covered[200:480, 420:860] = 128
    assert isinstance(tracker.observe(seen, 0.0), PoseMeasurement)
    lost = tracker.observe(covered, 0.1)
    assert isinstance(lost, NoPose)
    assert "301, 302" in lost.reason
    again = tracker.observe(seen, 0.2)
    assert isinstance(again, PoseMeasurement)
    assert again.status == "found"


def test_tags_with_broken_outlines_are_still_used(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    """A dark line through the white border hides a tag from the detector, not from the tracker."""
    tracker, truth = Tracker(rig, camera), Pose.level([0.1, 0.1, 0.4])
    picture = synthetic.render(truth, 0)
    whole = tracker.observe(picture, 0.0)
    assert isinstance(whole, PoseMeasurement)
    crossed = picture.copy()
    crossed[:, 582:585] = 30
    found = tracker.observe(crossed, 0.1)
    assert isinstance(found, PoseMeasurement)
    assert set(found.tags) == set(whole.tags)
    assert found.pose.distance_to(truth) < 2e-3


def test_a_moved_camera_is_reported_with_the_distance(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    turn = matrix_from_rotation_vector([0.0, np.radians(0.5), 0.0])
    here = camera.world_from_camera
    moved = Pose(here.position + np.array([0.006, 0.0, 0.0]), turn @ here.rotation)
    real = SyntheticCamera(rig, scene, replace(camera, world_from_camera=moved), seed=1)
    tracker = Tracker(rig, camera)
    first = tracker.observe(real.render(Pose.level([0.0, 0.0, 0.445]), 0), 0.0)
    assert isinstance(first, NoPose)
    assert "the camera moved" in first.reason
    with pytest.raises(CameraMoved) as caught:
        tracker.observe(real.render(Pose.level([0.0, 0.0, 0.445]), 1), 0.1)
    assert caught.value.exit_code == 1
    assert float(caught.value.values["moved_mm"]) == pytest.approx(6.0, abs=1.0)
    assert float(caught.value.values["turned_deg"]) == pytest.approx(0.5, abs=0.05)
    assert "world_from_camera" in caught.value.next_step


@pytest.mark.parametrize(("shift_mm", "turn_deg"), [(0.0, 0.0), (20.0, 1.0), (80.0, 0.0)])
def test_exchanged_sources_of_two_cameras_do_not_look_like_a_moved_camera(
    rig: Rig, camera: Camera, scene: Scene, shift_mm: float, turn_deg: float
) -> None:
    quarter = matrix_from_rotation_vector([0.0, 0.0, np.pi / 2.0])
    here = camera.world_from_camera
    beside = Pose(quarter @ here.position, quarter @ here.rotation)
    side = replace(camera, name="side", world_from_camera=beside)
    turn = matrix_from_rotation_vector([0.0, 0.0, np.radians(turn_deg)])
    off = Pose(beside.position + shift_mm / 1e3 * np.eye(3)[2], turn @ beside.rotation)
    real = SyntheticCamera(rig, scene, replace(side, world_from_camera=off), seed=1)
    tracker = Tracker(replace(rig, cameras=(camera, side)), camera)
    images = [real.render(Pose.level([0.0, 0.0, 0.445]), k) for k in range(2)]
    assert isinstance(tracker.observe(images[0], 0.0), NoPose)
    with pytest.raises(CameraMoved) as caught:
        tracker.observe(images[1], 0.1)
    if shift_mm < 50.0:
        assert "'front' are from the pose of camera 'side'" in caught.value.what
        assert "exchange the sources" in caught.value.next_step
        assert "do not calibrate" in caught.value.next_step
    else:
        assert "calibrate its pose again" in caught.value.next_step


def test_mirrored_images_are_named_where_a_frame_tag_looks_alike_in_a_mirror(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    """Mirrored, tag25h9 22 is read as 22, since it differs from itself in 2 bits only."""
    frame = tuple(replace(tag, id=22 + k) for k, tag in enumerate(rig.frame_tags))
    platform = tuple(replace(tag, id=k) for k, tag in enumerate(rig.platform_tags))
    rig = replace(rig, tag_family="tag25h9", frame_tags=frame, platform_tags=platform)
    real, truth = SyntheticCamera(rig, scene, camera, seed=1), Pose.level([0.0, 0.0, 0.445])
    images = [np.ascontiguousarray(real.render(truth, k)[:, ::-1]) for k in range(2)]
    tracker = Tracker(rig, camera)
    assert isinstance(tracker.observe(images[0], 0.0), NoPose)
    with pytest.raises(CameraMoved, match="the images are mirrored") as caught:
        tracker.observe(images[1], 0.1)
    assert caught.value.values["frame_tags"] == "22"
    assert "turn off mirroring" in caught.value.next_step
    with pytest.raises(BadInput, match=r"the images are mirrored: a\.png shows"):
        observe_tags([("a.png", images[0])], rig, camera, [tag.id for tag in frame])
    assert len(observe_tags([("a.png", real.render(truth, 0))], rig, camera, [22]).squares) == 1


def test_a_tag_that_looks_alike_in_a_mirror_does_not_show_that_images_are_mirrored(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    platform = tuple(replace(tag, id=22 + k) for k, tag in enumerate(rig.platform_tags))
    rig = replace(rig, tag_family="tag25h9", frame_tags=(), platform_tags=platform)
    image = SyntheticCamera(rig, scene, camera, seed=1).render(Pose.level([0.0, 0.0, 0.445]), 0)
    seen = [d.id for d in TagDetector("tag25h9").detect(image)]
    assert 22 in seen
    assert "mirrored" not in diagnose_tags(image, "tag25h9", seen)


def printed(family: str, *numbers: int) -> Image:
    """Tags side by side on white."""
    tags = [cv2.aruco.generateImageMarker(dictionary(family), n, 120) for n in numbers]
    return np.hstack(
        [cv2.copyMakeBorder(tag, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255) for tag in tags]
    )


def test_a_tag_that_is_the_mirror_image_of_an_expected_one_is_not_named_as_mirrored() -> None:
    """4X4_250 124 is 70 mirrored, to the bit: no image shows which of the two it is."""
    family, detector = "4X4_250", TagDetector("4X4_250")
    assert {70, 124} <= alike_in_mirror(family)
    image = printed(family, 124)
    assert diagnose_tags(image, family, [70]).startswith("4X4_250 124")
    assert "mirrored" not in diagnose_tags(image, family, [70])
    clear = [n for n in range(10) if n not in alike_in_mirror(family)]
    mirrored = np.ascontiguousarray(printed(family, 70, clear[0])[:, ::-1])
    assert [d.id for d in detector.detect(mirrored)] == [124]
    assert "the images are mirrored" in diagnose_tags(mirrored, family, [70, clear[0]])


def test_a_tag_of_any_number_in_the_plain_image_shows_that_it_is_not_mirrored() -> None:
    both = [printed("tag36h11", 5), printed("tag36h11", 6, 7)[:, ::-1]]
    image, detector = np.ascontiguousarray(np.hstack(both)), TagDetector("tag36h11")
    assert not are_mirrored(image, detector, [6, 7])
    assert are_mirrored(np.ascontiguousarray(both[1]), detector, [6, 7])


def test_a_tag_that_is_its_own_mirror_image_shows_nothing() -> None:
    """At the limit of detection it is found in the mirrored image alone by chance."""

    class InMirror(TagDetector):
        def detect(self, image: Image) -> list[Detection]:
            return [] if image is plain else super().detect(image)

    plain, detector = printed("4X4_50", 8), InMirror("4X4_50")
    assert [d.id for d in detector.detect(plain[:, ::-1])] == [8]
    assert not are_mirrored(plain, detector, [8])


def test_mirrored_images_are_named_where_the_first_one_shows_nothing_but_such_a_tag(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    frame = tuple(replace(tag, id=22 + k) for k, tag in enumerate(rig.frame_tags))
    alone, truth = frame[:1], Pose.level([0.0, 0.0, 0.445])
    images = []
    for tags in (alone, frame):
        shown = replace(rig, tag_family="tag25h9", frame_tags=tags, platform_tags=())
        image = SyntheticCamera(shown, scene, camera, seed=1).render(truth, len(images))
        images.append((f"{len(images)}.png", np.ascontiguousarray(image[:, ::-1])))
    rig = replace(rig, tag_family="tag25h9", frame_tags=frame, platform_tags=())
    with pytest.raises(BadInput, match=r"the images are mirrored: 1\.png shows"):
        observe_tags(images, rig, camera, [tag.id for tag in frame])


def test_a_camera_moved_during_a_run_is_noticed(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera, scene: Scene
) -> None:
    here = camera.world_from_camera
    turn = matrix_from_rotation_vector([0.0, np.radians(0.2), 0.0])
    moved = replace(camera, world_from_camera=Pose(here.position, turn @ here.rotation))
    later = SyntheticCamera(rig, scene, moved, seed=1)
    tracker = Tracker(rig, camera, TrackerSettings(camera_check_period=2))
    truth = Pose.level([0.0, 0.0, 0.445])
    assert isinstance(tracker.observe(synthetic.render(truth, 0), 0.0), PoseMeasurement)
    with pytest.raises(CameraMoved) as caught:
        list(tracker.observe(later.render(truth, frame), frame * 0.1) for frame in range(1, 4))
    assert caught.value.why.endswith(
        "image 1, at 0.000 s, was the last to pass this check, so poses measured after it are"
        " doubtful"
    )


def test_another_print_of_a_covered_frame_tag_costs_one_pose_and_not_the_camera(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    """The rig has one frame tag; what the camera sees of it lies elsewhere in some images."""
    tag, truth = rig.frame_tags[0], Pose.level([0.0, 0.0, 0.445])
    rig = replace(rig, frame_tags=(tag,))

    @cache
    def with_it_at(shift: float) -> SyntheticCamera:
        pose = replace(tag.pose, position=tag.pose.position + shift * np.eye(3)[1])
        real = replace(rig, frame_tags=(replace(tag, pose=pose),))
        return SyntheticCamera(real, scene, camera, seed=1)

    def seen_with_it_at(shift: float, number: int) -> Image:
        return with_it_at(shift).render(truth, number)

    shifts = [0.0, 0.05, 0.0, 0.0, 0.05, 0.1, 0.0, 0.05]
    tracker = Tracker(rig, camera, TrackerSettings(camera_check_period=1))
    for number, shift in enumerate(shifts):
        found = tracker.observe(seen_with_it_at(shift, number), 0.1 * number, truth)
        assert isinstance(found, NoPose if shift else PoseMeasurement)
    covered = seen_with_it_at(0.0, 8)
    centre = np.round(pixels_of(camera, camera.world_from_camera.inverse().apply(
        tag.pose.position[None]))[0]).astype(int)  # fmt: skip
    covered[centre[1] - 40 : centre[1] + 40, centre[0] - 40 : centre[0] + 40] = 128
    assert isinstance(tracker.observe(covered, 0.8, truth), NoPose)
    with pytest.raises(CameraMoved):
        tracker.observe(seen_with_it_at(0.05, 9), 0.9, truth)


def test_a_single_tag_that_allows_two_poses_gives_none(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    tracker = Tracker(rig, camera, TrackerSettings(single_tag_margin=float("inf")))
    one = replace(rig, platform_tags=rig.platform_tags[2:3])
    synthetic = SyntheticCamera(one, replace(scene, obstacles=()), camera, seed=2)
    found = tracker.observe(synthetic.render(Pose.level([0.1, 0.1, 0.4]), 0), 0.0)
    assert isinstance(found, NoPose)
    assert "two poses" in found.reason


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((480, 640), dtype=np.uint8),
        np.zeros((720, 1280, 3), dtype=np.uint8),
        np.zeros((720, 1280), dtype=np.uint16),
    ],
)
def test_a_picture_of_another_kind_is_refused(rig: Rig, camera: Camera, wrong: np.ndarray) -> None:
    with pytest.raises(BadInput, match="1280 x 720"):
        Tracker(rig, camera).observe(wrong, 0.0)


def test_a_rig_without_tags_cannot_be_tracked(rig: Rig, camera: Camera) -> None:
    bare = replace(rig, platform_tags=())
    with pytest.raises(BadInput, match="no platform tags"):
        Tracker(bare, camera)


def test_strong_noise_and_blur_widen_the_covariance(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera, scene: Scene
) -> None:
    poor = SyntheticCamera(rig, scene, camera, seed=3, optics=Optics(noise=8.0, blur=1.2))
    truth = Pose.level([0.1, 0.1, 0.4])
    clear = Tracker(rig, camera).observe(synthetic.render(truth, 0), 0.0)
    blurred = Tracker(rig, camera).observe(poor.render(truth, 0), 0.0)
    assert isinstance(clear, PoseMeasurement)
    assert isinstance(blurred, PoseMeasurement)
    assert np.trace(blurred.covariance) > 1.5 * np.trace(clear.covariance)
    assert blurred.pose.distance_to(truth) < 2e-3
