"""Encoder poses guide the search for the platform, but do not enter the result."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from model.kinematics import cable_lengths, forward_kinematics
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, Tag
from model.scene import Scene
from simulation.camera.camera import Optics, SyntheticCamera
from tests.tracking.test_tracker import error_of
from tracking.measurement import NoPose, PoseMeasurement
from tracking.tracker import MEMORY, EncoderExtrapolator, EncoderPrior, Tracker

Image = NDArray[np.uint8]

#: Error of the encoder pose, as from small cable length errors.
OFF = Pose(np.array([1.5e-3, -1e-3, 1e-3]), matrix_from_rotation_vector(np.array([5e-3, 0, 3e-3])))

NUMBERS = st.floats(-0.3, 0.3)
POSES = st.builds(
    lambda position, turn: Pose(np.array(position), matrix_from_rotation_vector(np.array(turn))),
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
)


@pytest.fixture(scope="module")
def eye(rig: Rig, camera: Camera, scene: Scene) -> SyntheticCamera:
    return SyntheticCamera(rig, replace(scene, obstacles=()), camera, seed=6, optics=Optics())


def by_drives(truth: Pose, off: Pose = OFF) -> Pose:
    return Pose(truth.position + off.position, off.rotation @ truth.rotation)


def barred(image: Image) -> Image:
    """Bars cross the outline of every tag, so that no detector finds one; edges stay free."""
    covered = image.copy()
    height, width = covered.shape
    for x in range(-height, width, 70):
        cv2.line(covered, (x, 0), (x + height // 2, height), 90, 14)
    return covered


def pose_at(k: int) -> Pose:
    return Pose.level([0.05 + 0.002 * k, 0.05, 0.42])


@given(measured=POSES, drives=POSES, later=POSES)
def test_encoder_motion_continues_from_the_last_camera_pose(
    measured: Pose, drives: Pose, later: Pose
) -> None:
    guidance = EncoderPrior()
    assert guidance.expected(drives).distance_to(drives) < 1e-12
    guidance.learn(measured, drives)
    assert guidance.expected(drives).distance_to(measured) < 1e-12
    assert guidance.expected(drives).angle_to(measured) < 1e-6
    moved = guidance.expected(later).position - measured.position
    assert moved == pytest.approx(later.position - drives.position, abs=1e-12)


@given(
    speed=st.tuples(NUMBERS, NUMBERS, NUMBERS),
    period=st.floats(0.01, MEMORY),
    delay=st.floats(0.001, MEMORY) | st.floats(-MEMORY, -0.001),
)
def test_the_drives_pose_is_that_of_the_pictures_own_time(
    speed: tuple[float, float, float], period: float, delay: float
) -> None:
    def at(time: float) -> Pose:
        return Pose.level(np.array([0.0, 0.0, 0.4]) + time * np.array(speed))

    ahead = EncoderExtrapolator()
    ahead.at(delay, 0.0, at(0.0))
    found = ahead.at(period + delay, period, at(period))
    assert found is not None
    assert found.distance_to(at(period + delay)) < 1e-12


def test_encoder_poses_after_a_long_gap_are_not_extrapolated() -> None:
    ahead, here, there = EncoderExtrapolator(), Pose.level([0, 0, 0.4]), Pose.level([0.1, 0, 0.4])
    assert ahead.at(0.1, 0.0, here) is here
    assert ahead.at(2.1, 2.0, there) is there
    assert ahead.at(2.2, 2.1, None) is None
    assert ahead.at(2.3, 2.2, here) is here


def test_tags_hidden_in_part_are_found_again_after_they_were_lost(
    rig: Rig, camera: Camera, eye: SyntheticCamera
) -> None:
    """The detector misses them: it needs complete outlines."""
    for guided in (False, True):
        tracker = Tracker(rig, camera)

        def observed(
            k: int, image: Image, tracker: Tracker = tracker, guided: bool = guided
        ) -> object:
            return tracker.observe(image, 0.1 * k, by_drives(pose_at(k)) if guided else None)

        assert isinstance(observed(0, eye.render(pose_at(0), 0)), PoseMeasurement)
        dark = np.full_like(eye.render(pose_at(1), 1), 90)
        assert isinstance(observed(1, dark), NoPose)
        again = observed(20, barred(eye.render(pose_at(20), 20)))
        assert isinstance(again, PoseMeasurement if guided else NoPose)
        if isinstance(again, PoseMeasurement):
            assert again.status == "guided"
            error = error_of(again, pose_at(20))
            assert error @ np.linalg.solve(again.covariance, error) < 30.0


@pytest.mark.parametrize("slip_mm", [3.0, 15.0, 60.0])
def test_a_drum_that_slipped_leaves_the_cameras_pose_as_it_is(
    rig: Rig, camera: Camera, eye: SyntheticCamera, slip_mm: float
) -> None:
    """Cable 3 slips on its drum while no tag is visible; the encoders do not show it."""
    tracker, errors, apart = Tracker(rig, camera), [], []
    for k in range(12):
        truth, slipped = pose_at(k), k >= 3
        lengths = cable_lengths(rig, truth)
        lengths[2] += slip_mm * 1e-3 if slipped else 0.0
        encoder = forward_kinematics(rig, lengths, truth).pose
        picture = eye.render(truth, k)
        hidden = k in (2, 3, 6, 7)
        seen = np.full_like(picture, 90) if hidden else picture
        found = tracker.observe(seen, 0.1 * k, encoder)
        assert isinstance(found, NoPose if hidden else PoseMeasurement)
        if isinstance(found, PoseMeasurement) and slipped:
            alone = Tracker(rig, camera).observe(picture, 0.0)
            assert isinstance(alone, PoseMeasurement)
            error = error_of(found, truth)
            errors.append(error @ np.linalg.solve(found.covariance, error))
            apart.append((encoder.distance_to(truth), found.pose.distance_to(alone.pose)))
    assert len(errors) == 6
    assert np.mean(errors) < 14.0, "as far from the truth as it says: 6 on average"
    drives, camera_alone = np.max(apart, axis=0)
    assert drives > 0.3e-3 * slip_mm, "the drives are wrong"
    assert camera_alone < 0.3e-3, "the camera is not"


def test_another_print_where_wrong_drives_put_the_platform_gives_no_pose_of_it(
    rig: Rig, camera: Camera, scene: Scene
) -> None:
    wrong = Pose.level([-0.1, -0.05, 0.35])
    (tag,) = (tag for tag in rig.platform_tags if tag.id == 305)
    decoy = Tag(305, tag.size, wrong.compose(tag.pose))
    real = replace(rig, frame_tags=(*rig.frame_tags, decoy))
    truth = Pose.level([0.12, 0.1, 0.42])
    pictures = SyntheticCamera(real, replace(scene, obstacles=()), camera, seed=6)
    found = Tracker(rig, camera).observe(pictures.render(truth, 0), 0.0, wrong)
    assert isinstance(found, PoseMeasurement)
    assert found.pose.distance_to(truth) < 1e-3
