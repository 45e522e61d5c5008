"""The synthetic camera's exposure: moving objects are blurred, resting ones are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.pose import Array, Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, load_rig
from model.scene import Scene, empty_scene
from simulation.camera.camera import ImageSequence, SyntheticCamera
from simulation.ground_truth import Optics, camera_as_built
from tracking.rolling_shutter import PlatformMotion

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
DISTANCE, FOCAL = 0.4, 900.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


@pytest.fixture(scope="module")
def scene(rig: Rig) -> Scene:
    return empty_scene(rig)


@pytest.fixture(scope="module")
def facing(rig: Rig) -> Camera:
    """A small camera that looks straight at the first tag, its image upright."""
    tag = rig.home.compose(rig.platform_tags[0].pose)
    right, up, out = tag.rotation.T
    matrix = np.array([[FOCAL, 0.0, 319.5], [0.0, FOCAL, 239.5], [0.0, 0.0, 1.0]])
    return replace(
        rig.cameras[0],
        width=640,
        height=480,
        matrix=matrix,
        distortion=np.zeros(5),
        world_from_camera=Pose(tag.position + DISTANCE * out, np.column_stack([right, -up, -out])),
    )


def edge_profile(picture: Array, rig: Rig) -> tuple[Array, Array]:
    """Columns around the tag's left edge, and how fast brightness falls there."""
    module = FOCAL * rig.platform_tags[0].size / 8.0 / DISTANCE
    column = 319.5 - 4.0 * module
    window = slice(round(column - 0.8 * module), round(column + 0.8 * module) + 1)
    light = picture[235:245].astype(np.float64).mean(axis=0)
    slope = np.maximum(-np.diff(light[window]), 0.0)
    return np.arange(window.start, window.stop - 1) + 0.5, slope / slope.sum()


def variance(columns: Array, share: Array) -> float:
    return float(share @ (columns - share @ columns) ** 2)


@pytest.mark.parametrize(("speed", "exposure"), [(0.5, 0.008), (0.25, 0.012), (-1.0, 0.006)])
def test_a_smear_is_as_long_as_the_motion_during_exposure(
    rig: Rig, scene: Scene, facing: Camera, speed: float, exposure: float
) -> None:
    """An edge smeared over L pixels is a ramp, whose slope has the variance L² / 12 more."""
    optics = Optics(noise=0.0, vignetting=0.0, exposure=exposure, cables=False)
    camera = SyntheticCamera(rig, scene, facing, optics=optics)
    right = facing.world_from_camera.rotation[:, 0]
    sharp = edge_profile(camera.render(rig.home), rig)
    smeared = edge_profile(
        camera.render(rig.home, motion=PlatformMotion(speed * right, np.zeros(3))), rig
    )
    length = np.sqrt(12.0 * (variance(*smeared) - variance(*sharp)))
    assert length == pytest.approx(abs(speed) * exposure * FOCAL / DISTANCE, rel=0.05)
    middle = smeared[0] @ smeared[1] - sharp[0] @ sharp[1]
    assert middle == pytest.approx(0.0, abs=0.1)  # the pose is that of the middle of the exposure


def test_turning_smears_and_no_exposure_or_no_motion_does_not(
    rig: Rig, scene: Scene, facing: Camera
) -> None:
    out = facing.world_from_camera.rotation[:, 2]
    still, turning = (
        PlatformMotion(np.zeros(3), np.zeros(3)),
        PlatformMotion(np.zeros(3), 2.0 * out),
    )
    quick, slow = (
        SyntheticCamera(rig, scene, facing, optics=Optics(noise=0.0, exposure=time))
        for time in (0.0, 0.02)
    )
    sharp = quick.render(rig.home)
    assert np.array_equal(quick.render(rig.home, 0, turning), sharp)
    assert np.array_equal(slow.render(rig.home), sharp)
    assert np.array_equal(slow.render(rig.home, 0, still), sharp)
    smeared = slow.render(rig.home, 0, turning).astype(int)
    changed = np.abs(smeared - sharp)
    assert changed.max() > 30
    assert changed[235:245, 315:325].max() < changed.max() / 2  # it turns about the image's middle


def test_a_film_smears_by_the_velocity_since_the_picture_before(
    rig: Rig, scene: Scene, facing: Camera
) -> None:
    camera = SyntheticCamera(rig, scene, facing, optics=Optics(noise=0.0, exposure=0.01))
    before = Pose(rig.home.position - [0.02, 0.0, 0.01], matrix_from_rotation_vector([0, 0, -0.05]))
    film = ImageSequence(camera)
    assert np.array_equal(film.image(0.0, before, 0), camera.render(before, 0))
    motion = PlatformMotion(np.array([0.2, 0.0, 0.1]), np.array([0.0, 0.0, 0.5]))
    assert np.array_equal(film.image(0.1, rig.home, 1), camera.render(rig.home, 1, motion))
    again = film.image(0.1, before, 2)  # at the same time: the pose is restated, not moved
    assert np.array_equal(again, camera.render(before, 2))


def test_the_exposure_comes_from_the_rig_file(rig: Rig) -> None:
    simulation = {"cameras": [{"name": "front", "exposure_ms": 8.0}]}
    document = type(rig.document).model_validate(
        {**rig.document.model_dump(mode="json"), "simulation": simulation}
    )
    robot = replace(rig, document=document)
    assert camera_as_built(robot, rig.cameras[0])[1].exposure == pytest.approx(0.008)


def test_a_short_smear_is_as_bright_as_what_it_is_the_mean_of(
    rig: Rig, scene: Scene, facing: Camera
) -> None:
    """The mean of two images lies between two grey levels half the time."""
    exposure = 0.005
    camera = SyntheticCamera(rig, scene, facing, optics=Optics(noise=0.0, exposure=exposure))
    motion = PlatformMotion(np.array([0.02, 0.0, 0.0]), np.zeros(3))
    parts = [
        camera.render(motion.moved(rig.home, share * exposure)).astype(float)
        for share in (-0.25, 0.25)
    ]
    mean = (parts[0] + parts[1]) / 2.0
    between = mean % 1.0 != 0.0
    assert between.sum() > 200
    smeared = camera.render(rig.home, 0, motion).astype(float)
    assert abs((smeared - mean)[between].mean()) < 0.05
