"""Rolling-shutter cameras: rendered row by row, and measured with correction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, load_rig, rig_from_document
from model.scene import empty_scene
from simulation.camera.camera import SyntheticCamera
from simulation.ground_truth import Optics, camera_as_built
from tracking.camera_model import pixels_of
from tracking.measurement import PoseMeasurement
from tracking.rolling_shutter import PlatformMotion, RecentMotion
from tracking.tracker import Tracker

READOUT, RATE = 0.03, 20.0
FAST = [0.0, 0.0, 0.4]
VELOCITY = {"down": [0.0, 0.0, -0.1], "along": [0.1, 0.0, 0.0]}


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml")


@pytest.fixture(scope="module")
def camera(rig: Rig) -> Camera:
    return replace(rig.cameras[0], readout=READOUT, rate=RATE)


def eye_of(rig: Rig, camera: Camera, exposure: float = 0.0) -> SyntheticCamera:
    optics = Optics(noise=1.0, cables=False, exposure=exposure)
    return SyntheticCamera(rig, empty_scene(rig), camera, 1, optics)


def flown(rig: Rig, camera: Camera, stated: float, velocity: list[float], images: int = 5):
    """Measurements of a steady flight, and the true poses."""
    eye, tracker = eye_of(rig, camera), Tracker(rig, replace(camera, readout=stated))
    motion = PlatformMotion(np.array(velocity), np.array([0.0, 0.0, 0.1]))
    for number in range(images):
        time = number / camera.rate
        pose = motion.moved(rig.home, time - 0.1)
        yield tracker.observe(eye.render(pose, number, motion), time), pose


@pytest.mark.parametrize("readout", [0.03, -0.03])
def test_a_row_shows_the_platform_at_its_own_time(rig: Rig, camera: Camera, readout: float) -> None:
    """Around a tag's corner the image is that of a platform at rest at that time's pose."""
    rolling = replace(camera, readout=readout)
    motion = PlatformMotion(np.array([0.1, 0.05, -0.1]), np.array([0.0, 0.0, 0.3]))
    eye = eye_of(rig, rolling, exposure=0.004)
    image = eye.render(rig.home, 0, motion).astype(float)
    still = eye_of(rig, replace(camera, readout=0.0), exposure=0.004)
    camera_from_world = camera.world_from_camera.inverse()
    for tag in rig.platform_tags:
        pixel = pixels_of(camera, camera_from_world.apply(rig.home.apply(tag.pose.position))[None])[
            0
        ]
        row, column = np.round(pixel).astype(int)[::-1]
        time = float(rolling.row_times(np.array([0.0, row])))
        there = still.render(motion.moved(rig.home, time), 0, motion).astype(float)
        middle = still.render(rig.home, 0, motion).astype(float)
        part = (slice(row - 1, row + 2), slice(column - 70, column + 71))
        near = np.mean(np.abs(image[part] - there[part]))
        assert near < 3.0
        if abs(time) > 0.002:
            assert np.mean(np.abs(middle[part] - there[part])) > near


def test_a_platform_at_rest_looks_the_same_by_any_shutter(rig: Rig, camera: Camera) -> None:
    at_once = eye_of(rig, replace(camera, readout=0.0)).render(rig.home, 0)
    assert np.array_equal(eye_of(rig, camera).render(rig.home, 0), at_once)


@pytest.mark.parametrize("axis", VELOCITY)
def test_a_moving_platform_is_measured_at_the_middle_rows_time(
    rig: Rig, camera: Camera, axis: str
) -> None:
    """From the second image on: for the first the motion is unknown, which it states."""
    found = list(flown(rig, camera, READOUT, VELOCITY[axis]))
    poses = [one for one, _ in found if isinstance(one, PoseMeasurement)]
    assert len(poses) == len(found)
    off = [one.pose.distance_to(truth) for one, truth in found[1:]]
    angles = [one.pose.angle_to(truth) for one, truth in found[1:]]
    assert max(off) < 0.15e-3
    assert np.degrees(max(angles)) < 0.05
    unknown, known = (one.position_deviation.max() for one in poses[:2])
    assert unknown > 2.0 * known


def test_a_fast_motion_from_the_first_image_on_is_named_beside_wrong_tags(rig, camera) -> None:
    """Without a pose the velocity stays unknown, so the rows are not corrected."""
    reasons = [found.reason for found, _ in flown(rig, camera, READOUT, FAST, images=2)]
    assert all("compare size_mm" in reason for reason in reasons)
    assert all("or begin with the platform at rest" in reason for reason in reasons)
    unstated = [found.reason for found, _ in flown(rig, camera, 0.0, FAST, images=2)]
    assert not any("begin with the platform at rest" in reason for reason in unstated)


def test_without_the_readout_the_same_images_measure_a_millimetre_wrong(rig, camera) -> None:
    found = list(flown(rig, camera, 0.0, VELOCITY["down"]))
    off = [one.pose.distance_to(truth) for one, truth in found[1:]]
    assert min(off) > 0.5e-3


def test_a_platform_at_rest_is_measured_as_by_any_camera(rig, camera) -> None:
    image = eye_of(rig, camera).render(rig.home, 0)
    by_rows, at_once = (
        Tracker(rig, replace(camera, readout=readout)) for readout in (READOUT, 0.0)
    )
    for time in (0.0, 0.05, 0.1):
        mine, other = by_rows.observe(image, time), at_once.observe(image, time)
        assert mine.pose.distance_to(other.pose) < 1e-6


def test_the_readout_comes_from_the_rig_file_and_the_true_one_from_its_simulation(rig) -> None:
    plain = rig.document.model_dump(mode="json")
    plain["cameras"][0]["readout_ms"] = 12.5
    plain["simulation"] = {"cameras": [{"name": "front", "readout_ms": 30.0}]}
    document = type(rig.document).model_validate(plain)
    robot = rig_from_document(document)
    assert robot.cameras[0].readout == pytest.approx(0.0125)
    assert camera_as_built(robot, robot.cameras[0])[0].readout == pytest.approx(0.03)


def test_a_motion_turns_and_shifts() -> None:
    before = Pose.level([0.0, 0.0, 0.0])
    after = Pose(np.array([0.1, 0.0, 0.0]), matrix_from_rotation_vector(np.array([0.0, 0.0, 0.2])))
    motion = PlatformMotion.between(before, after, 0.5)
    half = motion.moved(before, 0.25)
    np.testing.assert_allclose(half.position, [0.05, 0.0, 0.0])
    assert half.angle_to(after) == pytest.approx(0.1)


def test_the_motion_of_a_swing_is_found_to_a_hundredth() -> None:
    """Oscillation at 100 mm/s as in the benchmark: its acceleration changes all the time."""
    recent, swing, speed = RecentMotion(READOUT), 0.04, 0.1
    off = []
    for number in range(60):
        time = number / 30.0
        phase = speed / swing * time
        pose = Pose.level([0.0, swing * np.sin(phase), 0.4])
        motion = recent.at(time, pose)
        if number > 6:
            assert motion is not None
            off.append(abs(motion.velocity[1] - speed * np.cos(phase)))
        recent.add(PoseMeasurement(time, pose, np.eye(6) * 1e-9, (301,), 0.03, "tracked"))
    assert max(off) < 0.012 * speed
