"""Tracking with decoys, occlusion and blur, and the validity of the covariance."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest

from drivers.cameras.live import Frame
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, Tag
from model.scene import Scene
from simulation.camera.camera import Optics, SyntheticCamera
from tests.tracking.tag_images import cropped
from tests.tracking.test_tracker import error_of
from tracking.camera_model import Image, Region, pixels_of
from tracking.detection.detector import TagDetector, region_around
from tracking.detection.tags import tag_corners
from tracking.estimator import PlatformEstimator, find_consensus
from tracking.measurement import NoPose, PoseMeasurement, TrackerSettings, predict, rejection_reason
from tracking.pnp import TagView, solve_pnp
from tracking.rolling_shutter import PlatformMotion, RecentMotion
from tracking.track import NoPlatformSeen, track
from tracking.tracker import Tracker

HERE = Pose.level([0.1, 0.1, 0.4])
FLAT = np.eye(3)


@pytest.fixture(scope="module")
def empty(scene: Scene) -> Scene:
    return replace(scene, obstacles=())


@pytest.fixture(scope="module")
def narrow(camera: Camera) -> Camera:
    """The pixels of the camera that see the platform in the middle half of the workspace."""
    seen = np.array(list(product((-0.3, 0.3), (-0.3, 0.3), (0.0, 0.7))))
    region = region_around(camera, seen, slack=0.0)
    assert region is not None
    return cropped(camera, region)


def with_prints(rig: Rig, *prints: tuple[int, list[float]], size: float = 0.12) -> Rig:
    """The rig with further tags on the floor that are not in its file."""
    more = tuple(Tag(number, size, Pose(np.array(position), FLAT)) for number, position in prints)
    return replace(rig, frame_tags=(*rig.frame_tags, *more))


@pytest.mark.parametrize("number", [301, 302, 305])
def test_another_print_of_a_tag_does_not_move_the_pose(
    rig: Rig, camera: Camera, empty: Scene, number: int
) -> None:
    """Tag 302 faces away from the camera, so only its decoy is visible."""
    real = with_prints(rig, (number, [-0.30, 0.42, 0.0]), size=0.16)
    image = SyntheticCamera(real, empty, camera, seed=4).render(HERE, 0)
    tracker = Tracker(rig, camera)
    found = tracker.observe(image, 0.0)
    assert isinstance(found, PoseMeasurement)
    assert found.pose.distance_to(HERE) < 1e-3
    alone = Tracker(rig, camera).observe(
        SyntheticCamera(rig, empty, camera, seed=4).render(HERE, 0), 0.0
    )
    assert isinstance(alone, PoseMeasurement)
    assert found.tags == alone.tags
    again = tracker.observe(image, 0.1)
    assert isinstance(again, PoseMeasurement)
    assert again.pose.distance_to(HERE) < 1e-3


def test_a_decoy_alone_that_lies_as_no_platform_can_gives_no_pose(
    rig: Rig, camera: Camera, empty: Scene
) -> None:
    real = with_prints(rig, (303, [-0.95, 0.0, 0.0]), size=0.2)
    image = SyntheticCamera(real, empty, camera, seed=4).render(Pose.level([0.0, 0.0, -3.0]), 0)
    found = Tracker(rig, camera).observe(image, 0.0)
    assert isinstance(found, NoPose)


@pytest.mark.parametrize("number", [301, 302, 303, 304, 305, 306])
def test_a_loose_print_on_the_floor_gives_no_pose(
    rig: Rig, narrow: Camera, empty: Scene, number: int
) -> None:
    """The platform is out of view; its pose would be below the floor or rotated by 90° or more."""
    rng = np.random.default_rng(number)
    for yaw in np.radians([0.0, 60.0, 120.0, 200.0][number % 2 :: 2]):
        where = Pose(
            np.append(rng.uniform(-0.25, 0.25, size=2), 0.005),
            matrix_from_rotation_vector(np.array([0.0, 0.0, yaw])),
        )
        real = replace(rig, frame_tags=(*rig.frame_tags, Tag(number, 0.096, where)))
        image = SyntheticCamera(real, empty, narrow, seed=4).render(Pose.level([0.0, 0.0, -3.0]), 0)
        found = Tracker(rig, narrow).observe(image, 0.0)
        assert isinstance(found, NoPose), found
        assert str(number) in found.reason


@pytest.mark.parametrize(("axis", "degrees"), [(0, 85), (1, 120), (2, 120), (2, 180)])
def test_a_platform_rotated_too_far_is_named_with_its_angle_and_the_limit(
    rig: Rig, narrow: Camera, empty: Scene, axis: int, degrees: int
) -> None:
    """Its tags are as the rig file has them; to check those would lead nowhere."""
    turn = matrix_from_rotation_vector(np.radians(degrees) * np.eye(3)[axis])
    pose = Pose(np.array([0.05, 0.1, 0.4]), turn @ rig.home.rotation)
    image = SyntheticCamera(rig, empty, narrow).render(pose, 1)
    found = Tracker(rig, narrow).observe(image, 0.0)
    assert isinstance(found, NoPose)
    assert f"{degrees}° from the home pose, the limit is 80°" in found.reason
    with pytest.raises(NoPlatformSeen) as caught:
        list(track([Frame(0.0, image, "rotated")], Tracker(rig, narrow)))
    assert caught.value.next_step.startswith("rotate the platform back")
    assert "another camera" not in caught.value.next_step
    several = replace(rig, cameras=(narrow, replace(narrow, name="side")))
    with pytest.raises(NoPlatformSeen, match="from the home pose") as caught:
        list(track([Frame(0.0, image, "rotated")], Tracker(several, narrow)))
    assert caught.value.next_step.endswith("the source is not that of another camera")


@pytest.mark.parametrize("height", [0.30, 0.34, 0.37])
def test_a_tag_seen_too_obliquely_is_named_with_its_angle_and_the_limit(
    rig: Rig, camera: Camera, empty: Scene, height: float
) -> None:
    """Only the tag on top, from the side."""
    rig = replace(rig, platform_tags=rig.platform_tags[4:5], frame_tags=())
    (tag,) = rig.platform_tags
    side = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = replace(camera, world_from_camera=Pose(np.array([1.4, 0.0, 0.7]), side))
    truth = Pose.level([0.0, 0.0, height])
    sight = camera.world_from_camera.position - truth.apply(tag.pose.position[None])[0]
    angle = np.degrees(np.arccos(sight[2] / np.linalg.norm(sight)))
    image = SyntheticCamera(rig, empty, camera, seed=4).render(truth, 0)
    found = Tracker(rig, camera).observe(image, 0.0)
    assert isinstance(found, NoPose)
    stated = re.fullmatch(
        rf"tags {tag.id} are seen (\d+)° from their normal, the limit is 76°", found.reason
    )
    assert stated, found.reason
    assert float(stated[1]) == pytest.approx(angle, abs=1.5)


def test_two_prints_of_one_tag_are_ambiguous(rig: Rig, narrow: Camera, empty: Scene) -> None:
    """A platform with a single tag, and the same print within the frame."""
    one = replace(rig, platform_tags=rig.platform_tags[4:5])
    real = with_prints(one, (305, [0.25, -0.1, 0.15]), size=0.096)
    image = SyntheticCamera(real, empty, narrow, seed=4).render(HERE, 0)
    found = Tracker(one, narrow).observe(image, 0.0)
    assert isinstance(found, NoPose)
    assert found.reason == "tag 305 is seen more than once"
    with pytest.raises(NoPlatformSeen) as caught:
        list(track([Frame(0.0, image, "a.png")], Tracker(one, narrow)))
    assert "another print" in caught.value.why
    assert "remove or cover the second print" in caught.value.next_step


def test_tags_in_view_are_not_reported_as_missing(rig: Rig, camera: Camera, empty: Scene) -> None:
    """Two tags that do not fit the rig file, each printed once, beside the tags of the frame."""
    tag = rig.platform_tags[0]
    apart = replace(tag, pose=replace(tag.pose, position=tag.pose.position + 0.08 * FLAT[1]))
    real = replace(rig, platform_tags=(apart, *rig.platform_tags[4:5]))
    wrong = replace(rig, platform_tags=(tag, *rig.platform_tags[4:5]))
    image = SyntheticCamera(real, empty, camera, seed=4).render(HERE, 0)
    with pytest.raises(NoPlatformSeen, match="inconsistent positions") as caught:
        list(track([Frame(0.0, image, "a.png")], Tracker(wrong, camera)))
    assert caught.value.why == "expected tag36h11 tags 301, 305"
    assert "size_mm" in caught.value.next_step


def test_another_print_of_a_frame_tag_does_not_move_the_camera(
    rig: Rig, camera: Camera, empty: Scene
) -> None:
    real = with_prints(rig, (402, [0.25, -0.25, 0.0]), size=0.2)
    image = SyntheticCamera(real, empty, camera, seed=4).render(HERE, 0)
    limit = TrackerSettings(camera_moved_px=0.2)
    assert isinstance(Tracker(rig, camera, limit).observe(image, 0.0), PoseMeasurement)
    shift = np.array([2e-3, 0.0, 0.0])
    moved = tuple(
        replace(tag, pose=replace(tag.pose, position=tag.pose.position + shift))
        for tag in rig.frame_tags
    )
    # The frame tags are checked with the print in view.
    found = Tracker(replace(rig, frame_tags=moved), camera, limit).observe(image, 0.0)
    assert isinstance(found, NoPose)
    assert "camera" in found.reason


def test_no_squares_agree_on_nothing(camera: Camera) -> None:
    nothing: list[TagView] = []
    assert find_consensus(camera, nothing, lambda _: True).views == []


def test_tags_covered_in_part_are_followed(rig: Rig, camera: Camera, empty: Scene) -> None:
    """A bar over each tag hides it from the detector; its free edges are still used."""
    eye, tracker = SyntheticCamera(rig, empty, camera, seed=5), Tracker(rig, camera)
    first = tracker.observe(eye.render(HERE, 0), 0.0)
    assert isinstance(first, PoseMeasurement)
    truth = Pose.level([0.103, 0.1, 0.401])
    image = eye.render(truth, 1)
    middle = np.round(np.array([image.shape[1], image.shape[0]]) / 2).astype(int)
    whole = tracker.observe(image, 0.1)
    assert isinstance(whole, PoseMeasurement)
    covered = image.copy()
    cv2.line(covered, (0, int(middle[1]) - 40), (1279, int(middle[1]) - 200), 90, 14)
    found = tracker.observe(covered, 0.2)
    assert isinstance(found, PoseMeasurement)
    assert found.status == "tracked"
    assert found.pose.distance_to(truth) < 2e-3


def test_motion_is_extrapolated() -> None:
    def at(time: float) -> PoseMeasurement:
        turn = matrix_from_rotation_vector(np.array([0.0, 0.3 * time, 0.0]))
        pose = Pose(np.array([0.1 * time, 0.0, 0.4]), turn)
        return PoseMeasurement(time, pose, np.eye(6), (301,), 0.1, "tracked")

    ahead = predict(at(0.2), at(0.1), 0.4)
    assert ahead.distance_to(at(0.4).pose) < 1e-12
    assert ahead.angle_to(at(0.4).pose) < 1e-6
    long_ago = at(0.2)
    assert predict(long_ago, at(0.1), 9.0) is long_ago.pose
    assert predict(long_ago, None, 0.3) is long_ago.pose


def test_a_fast_platform_is_followed_by_its_speed(rig: Rig, camera: Camera, empty: Scene) -> None:
    """0.15 m/s at 10 images a second are 9 px from image to image, more than a module."""
    eye, tracker = SyntheticCamera(rig, empty, camera, seed=6), Tracker(rig, camera)
    for frame in range(8):
        truth = Pose.level([-0.06 + 0.015 * frame, 0.1, 0.4])
        found = tracker.observe(eye.render(truth, frame), frame * 0.1)
        assert isinstance(found, PoseMeasurement)
        assert found.status == ("tracked" if frame else "found")
        assert found.pose.distance_to(truth) < 1e-3


def test_a_platform_at_the_speed_of_its_rig_is_followed(
    rig: Rig, camera: Camera, empty: Scene
) -> None:
    """60 mm from image to image: each was searched as if it were the first."""
    fast = replace(rig, motion=replace(rig.motion, speed=1.0))
    eye, tracker = SyntheticCamera(rig, empty, camera, seed=6), Tracker(fast, camera)
    for frame, x in enumerate([-0.12, -0.118, -0.06, 0.0]):
        truth = Pose.level([x, 0.1, 0.4])
        found = tracker.observe(eye.render(truth, frame), frame * 0.1)
        assert isinstance(found, PoseMeasurement)
        assert found.status == ("tracked" if frame else "found")


PLAIN = Optics(noise=1.5, blur=0.6)


@pytest.mark.parametrize(
    ("optics", "named"),
    [
        (replace(PLAIN, sharpening=2.0), "the image is sharpened: .*switch off"),
        (replace(PLAIN, light=1.6), "paper is overexposed at 100% of the edges: shorten"),
    ],
)
def test_images_whose_edges_are_not_where_they_seem_are_refused_by_name(
    rig: Rig, narrow: Camera, empty: Scene, optics: Optics, named: str
) -> None:
    """Their intervals contained the truth in one of three images."""
    image = SyntheticCamera(rig, empty, narrow, seed=3, optics=optics).render(HERE, 0)
    found = Tracker(rig, narrow).observe(image, 0.0)
    assert isinstance(found, NoPose)
    assert re.search(named, found.reason)


@pytest.mark.parametrize(
    "optics", [PLAIN, Optics(), replace(PLAIN, sharpening=0.5), replace(PLAIN, jpeg=50)]
)
def test_images_as_cameras_take_them_are_not_refused(
    rig: Rig, narrow: Camera, empty: Scene, optics: Optics
) -> None:
    image = SyntheticCamera(rig, empty, narrow, seed=3, optics=optics).render(HERE, 0)
    assert isinstance(Tracker(rig, narrow).observe(image, 0.0), PoseMeasurement)


def test_a_smear_is_named_with_its_length(rig: Rig, camera: Camera, empty: Scene) -> None:
    exposure, length = 0.01, 7.0
    speed = length * np.linalg.norm(HERE.position - camera.world_from_camera.position)
    speed /= camera.matrix[0, 0] * exposure
    eye = SyntheticCamera(rig, empty, camera, seed=3, optics=replace(PLAIN, exposure=exposure))
    motion = PlatformMotion(speed * camera.world_from_camera.rotation[:, 0], np.zeros(3))
    image = eye.render(HERE, 0, motion)
    limits = replace(TrackerSettings(), position_deviation=1e-6)
    found = Tracker(rig, camera, limits).observe(image, 0.0)
    assert isinstance(found, NoPose)
    smear = re.search(r"blurred by (\d+) px of motion: shorten the exposure", found.reason)
    assert smear is not None
    assert abs(int(smear[1]) - length) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("blur", [0.3, 1.0, 1.5])
def test_the_stated_covariance_is_that_of_the_errors(
    rig: Rig, narrow: Camera, empty: Scene, blur: float
) -> None:
    """Mean NEES over seeds and positions; 6 for an exact covariance."""
    rng, values = np.random.default_rng(12), []
    optics = Optics(noise=1.5, blur=blur)
    for seed in range(4):
        eye = SyntheticCamera(rig, empty, narrow, seed=seed, optics=optics)
        for frame in range(9):
            position = rng.uniform([-0.15, -0.15, 0.3], [0.15, 0.15, 0.55])
            truth = Pose(position, matrix_from_rotation_vector(rng.normal(size=3) * 0.1))
            found = Tracker(rig, narrow).observe(eye.render(truth, frame), 0.0)
            assert isinstance(found, PoseMeasurement)
            error = error_of(found, truth)
            values.append(error @ np.linalg.solve(found.covariance, error))
    assert 4.5 < np.mean(values) < 7.5


@pytest.mark.parametrize("off_mm", [2.0, 4.0, 6.0])
def test_two_tags_that_contradict_each_other_give_no_pose(
    rig: Rig, scene: Scene, off_mm: float
) -> None:
    """One of them is elsewhere than the rig file says; a wrong pose would be stated as certain."""
    two = tuple(tag for tag in rig.platform_tags if tag.id in (301, 303))
    shift = np.array([0.0, off_mm / 1e3, 0.0])
    moved = replace(two[0], pose=Pose(two[0].pose.position + shift, two[0].pose.rotation))
    camera = rig.cameras[0]
    synthetic = SyntheticCamera(replace(rig, platform_tags=two), scene, camera)
    tracker = Tracker(replace(rig, platform_tags=(moved, two[1])), camera)
    found = tracker.observe(synthetic.render(Pose.level([0.045, -0.021, 0.42])), 0.0)
    assert isinstance(found, NoPose)
    assert "contradict each other" in found.reason


def test_the_stated_error_of_tags_widens_the_limit_of_their_residuals(
    rig: Rig, scene: Scene
) -> None:
    """As it does in pixels: in the middle of an image of twice as many pixels, twice as far."""
    draw = np.random.default_rng(2)
    camera = rig.cameras[0]
    middle = np.array([camera.width, camera.height, 0.0]) / 2.0
    matrix = camera.matrix * np.array([[2.0], [2.0], [1.0]])
    matrix[:, 2] -= middle
    camera = replace(camera, matrix=matrix)
    off = tuple(
        replace(tag, pose=Pose(tag.pose.position + draw.normal(0.0, 1e-3, 3), tag.pose.rotation))
        for tag in rig.platform_tags
    )
    image = SyntheticCamera(replace(rig, platform_tags=off), scene, camera).render(HERE)
    unstated = Tracker(replace(rig, tag_error=None), camera).observe(image, 0.0)
    assert isinstance(unstated, NoPose)
    assert "contradict each other" in unstated.reason
    stated = Tracker(replace(rig, tag_error=2e-3), camera).observe(image, 0.0)
    assert isinstance(stated, PoseMeasurement)


def restated(rig: Rig, sizes: dict[int, float]) -> Rig:
    """The rig with other sizes in its file, [m]."""
    tags = (replace(tag, size=sizes.get(tag.id, tag.size)) for tag in rig.platform_tags)
    return replace(rig, platform_tags=tuple(tags))


@pytest.fixture(scope="module")
def sharp(rig: Rig, narrow: Camera, empty: Scene) -> list[tuple[Image, Pose]]:
    """Images of poses at which the camera sees two or three tags; every third has each blur."""
    rng, images = np.random.default_rng(1), []
    for number in range(12):
        turn = matrix_from_rotation_vector(rng.normal(size=3) * 0.1)
        truth = Pose(rng.uniform([-0.2, -0.2, 0.2], [0.2, 0.2, 0.6]), turn)
        optics = Optics(noise=1.5, blur=(0.6, 0.3, 1.0, 1.5)[number % 4])
        eye = SyntheticCamera(rig, empty, narrow, seed=600 + number, optics=optics)
        images.append((eye.render(truth, number), truth))
    return images


@pytest.mark.parametrize("stated_mm", [92, 94, 95, 97, 98, 100, 102])
def test_tags_of_another_size_than_stated_give_no_pose(
    rig: Rig, narrow: Camera, sharp: list[tuple[Image, Pose]], stated_mm: float
) -> None:
    """As prints scaled to the page are; a single tag would be measured at another distance."""
    wrong = restated(rig, {tag.id: stated_mm / 1e3 for tag in rig.platform_tags})
    hardest = abs(stated_mm - 96) == 1
    for image, _ in sharp if hardest else sharp[stated_mm % 3 :: 3]:
        found = Tracker(wrong, narrow).observe(image, 0.0)
        assert isinstance(found, NoPose)
        assert "compare size_mm" in found.reason


@pytest.mark.parametrize("number", [301, 303, 305])
@pytest.mark.parametrize("stated_mm", [93, 97, 100])
def test_one_tag_of_another_size_is_left_out_or_gives_no_pose(
    rig: Rig, narrow: Camera, sharp: list[tuple[Image, Pose]], number: int, stated_mm: float
) -> None:
    wrong = restated(rig, {number: stated_mm / 1e3})
    for image, truth in sharp[number % 3 :: 3]:
        found = Tracker(wrong, narrow).observe(image, 0.0)
        if isinstance(found, PoseMeasurement):
            error = error_of(found, truth)
            assert error @ np.linalg.solve(found.covariance, error) < 35.0  # 6 on average
        else:
            assert "compare size_mm" in found.reason


@pytest.mark.parametrize("swapped", [(301, 303), (301, 305), (303, 305)])
def test_tags_whose_numbers_are_swapped_give_no_pose(
    rig: Rig, narrow: Camera, sharp: list[tuple[Image, Pose]], swapped: tuple[int, int]
) -> None:
    other = dict([swapped, swapped[::-1]])
    tags = tuple(replace(tag, id=other.get(tag.id, tag.id)) for tag in rig.platform_tags)
    for image, _ in sharp[sum(swapped) % 3 :: 3]:
        found = Tracker(replace(rig, platform_tags=tags), narrow).observe(image, 0.0)
        assert isinstance(found, NoPose)
        assert re.search("contradict each other|inconsistent|fits", found.reason)


def near_tag(rig: Rig, camera: Camera) -> tuple[Rig, Camera]:
    """A rig with tag 301 only, and a camera 0.65 m in front of it."""
    one = replace(rig, platform_tags=rig.platform_tags[:1], frame_tags=())
    side = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    there = replace(camera, world_from_camera=Pose(np.array([0.7, 0.0, 0.445]), side))
    return one, cropped(there, Region(400, 120, 880, 600))


@pytest.fixture(scope="module")
def lone(rig: Rig, camera: Camera, empty: Scene) -> list[tuple[Image, Pose]]:
    """Images of tag 301 only, which are measured as they are."""
    (one, close), rng, images = near_tag(rig, camera), np.random.default_rng(2), []
    for number in range(12):
        turn = matrix_from_rotation_vector(np.radians(rng.uniform(-30.0, 30.0, 3)))
        truth = Pose(rng.uniform([-0.03, -0.03, 0.415], [0.03, 0.03, 0.475]), turn)
        image = SyntheticCamera(one, empty, close, seed=number).render(truth, 0)
        image.setflags(write=False)
        assert isinstance(Tracker(one, close).observe(image, 0.0), PoseMeasurement)
        images.append((image, truth))
    return images


def with_bar(image: Image, camera: Camera, pose: Pose, tag: Tag, width: float) -> Image:
    """The image with something as dark as ink along a whole edge of a tag, of a width [m]."""
    first, second, _, before = tag_corners(tag)
    along, outward = (second - first) / tag.size, (first - before) / tag.size
    ends = np.array([first - tag.size / 8.0 * along, second + tag.size / 8.0 * along])
    bar = np.vstack([ends, ends[::-1] + width * outward])
    seen = pixels_of(camera, camera.world_from_camera.inverse().compose(pose).apply(bar))
    dark = int(np.percentile(image, 0.1))
    barred = image.copy()
    cv2.fillConvexPoly(barred, np.round(seen * 16).astype(np.int32), dark, cv2.LINE_AA, 4)
    return barred


@pytest.mark.parametrize("width_mm", [1.5, 2.5, 5.0])
def test_a_bar_along_an_edge_of_a_lone_tag_gives_no_wrong_pose(
    rig: Rig, camera: Camera, lone: list[tuple[Image, Pose]], width_mm: float
) -> None:
    """Three edges fit a pose exactly, so a good one was left out: 30 mm off with 1 mm stated."""
    (one, close), reasons = near_tag(rig, camera), []
    for image, truth in lone:
        barred = with_bar(image, close, truth, one.platform_tags[0], width_mm / 1e3)
        found = Tracker(one, close).observe(barred, 0.0)
        if isinstance(found, PoseMeasurement):
            error = error_of(found, truth)
            assert error @ np.linalg.solve(found.covariance, error) < 30.0
        else:
            reasons.append(found.reason)
    assert not any("compare size_mm" in reason for reason in reasons)  # it is not the cause
    stated = "one of the four edges of tags 301 is wrong|the edges of tag 301 form no square"
    assert any(re.match(stated, reason) for reason in reasons)


def test_three_edges_of_a_lone_tag_give_no_pose(rig: Rig, camera: Camera, empty: Scene) -> None:
    """Any three fit a pose exactly, also if one of them is a bar's."""
    one, close = near_tag(rig, camera)
    truth = Pose.level([0.0, 0.0, 0.445])
    image = SyntheticCamera(one, empty, close, seed=1).render(truth, 0)
    estimator = PlatformEstimator(one, close, TrackerSettings(), RecentMotion(0.0))
    detections = TagDetector(one.tag_family).detect_all(image)
    (view,) = estimator.views(image, detections, {301: one.platform_tags[0]})
    keep = np.repeat([True, True, True, False], 2)
    seen = replace(
        view.seen,
        edges=keep[::2],
        whitening=view.seen.whitening * keep[:, None],
        target=view.seen.target * keep,
    )
    bundle = solve_pnp(close, [TagView(view.tag, seen)])
    assert bundle is not None
    views = [TagView(view.tag, seen)]
    reason = rejection_reason(TrackerSettings(), views, bundle, None, 3, 1.0, [])
    assert reason == "only 3 edges of tags 301 are measured: any three fit a pose exactly"


def test_a_lone_tag_of_an_ordinary_print_is_measured(
    rig: Rig, camera: Camera, lone: list[tuple[Image, Pose]]
) -> None:
    """Without one edge such a print is centimetres off, but its modules are where its edges are."""
    (one, close), rng = near_tag(rig, camera), np.random.default_rng(3)
    surprise = []
    for image, truth in lone:
        corners = close.world_from_camera.inverse().compose(truth)
        drawn = pixels_of(close, corners.apply(tag_corners(one.platform_tags[0])))
        printed = drawn + rng.normal(0.0, 0.1, (4, 2))  # 0.07 mm
        warp = cv2.getPerspectiveTransform(drawn.astype(np.float32), printed.astype(np.float32))
        size = (close.width, close.height)
        shown = cv2.warpPerspective(image, warp, size, borderMode=cv2.BORDER_REPLICATE)
        found = Tracker(one, close).observe(shown, 0.0)
        assert isinstance(found, PoseMeasurement)
        error = error_of(found, truth)
        surprise.append(error @ np.linalg.solve(found.covariance, error))
    assert np.median(surprise) < 16.8
