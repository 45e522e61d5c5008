"""The camera's place from surveyed tags on the frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.extrinsics import locate_camera
from cdpr.errors import BadInput
from cdpr.poses import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from cdpr.rig import Rig, load_rig
from cdpr.scene import load_scene
from simulation.camera import SyntheticCamera

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


@pytest.fixture(scope="module")
def pictures(rig: Rig) -> tuple[Pose, list[np.ndarray]]:
    """Pictures of a camera that stands elsewhere than the rig file says, and its true place."""
    scene = replace(load_scene(CONFIGS / "environment_1.yaml"), obstacles=())
    named = rig.cameras[0].world_from_camera
    turn = matrix_from_rotation_vector([0.02, -0.01, 0.015])
    truth = Pose(named.position + np.array([0.03, -0.02, 0.01]), turn @ named.rotation)
    camera = SyntheticCamera(rig, scene, replace(rig.cameras[0], world_from_camera=truth), seed=2)
    return truth, [camera.render(Pose.level([0.0, 0.0, 0.55]), k) for k in range(3)]


def test_a_camera_is_located_to_half_a_millimetre(
    rig: Rig, pictures: tuple[Pose, list[np.ndarray]]
) -> None:
    truth, images = pictures
    found = locate_camera(rig, rig.cameras[0], images)
    pose = found.world_from_camera
    assert pose.distance_to(truth) < 0.5e-3
    assert np.degrees(pose.angle_to(truth)) < 0.02
    turn = rotation_vector_from_matrix(pose.rotation @ truth.rotation.T)
    error = np.concatenate([pose.position - truth.position, turn])
    # The same picture apart from noise, so the error of drawing does not average out.
    assert np.all(np.abs(error) < 8.0 * np.sqrt(np.diag(found.covariance)))
    assert found.pictures == 3
    assert set(found.tag_errors) <= {401, 402, 403, 404}
    assert len(found.tag_errors) >= 3
    assert max(found.tag_errors.values()) < 0.1


def test_the_covariance_is_that_of_the_world_pose(
    rig: Rig, pictures: tuple[Pose, list[np.ndarray]]
) -> None:
    """Against numeric propagation of the pose in the camera's frame."""
    from tracking.bundle import TagView, moved, solve_bundle
    from tracking.detector import TagDetector
    from tracking.edges import refine

    camera, tags = rig.cameras[0], {tag.id: tag for tag in rig.frame_tags}
    image = pictures[1][0]
    mine = [d for d in TagDetector(rig.tag_family).detect(image) if d.id in tags]
    squares = refine(image, camera, np.array([d.corners for d in mine]), 8)
    views = [
        TagView(tags[d.id], s)
        for d, s in zip(mine, squares, strict=True)
        if s is not None and s.whole
    ]
    bundle = solve_bundle(camera, views)
    assert bundle is not None
    base = bundle.camera_from_body
    change = np.zeros((6, 6))
    for k in range(6):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[k] = sign * 1e-6
            ends.append(moved(base, step).inverse())
        turn = rotation_vector_from_matrix(ends[0].rotation @ ends[1].rotation.T)
        change[:, k] = np.concatenate([ends[0].position - ends[1].position, turn]) / 2e-6
    expected = change @ bundle.covariance @ change.T
    found = locate_camera(rig, camera, [image])
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-2, atol=1e-12)


def test_a_picture_without_frame_tags_is_refused(rig: Rig) -> None:
    blank = np.full((720, 1280), 100, np.uint8)
    with pytest.raises(BadInput, match="none of the frame tags 401, 402, 403, 404"):
        locate_camera(rig, rig.cameras[0], [blank])


def test_a_rig_without_frame_tags_is_refused(rig: Rig) -> None:
    with pytest.raises(BadInput, match="no frame tags"):
        locate_camera(replace(rig, frame_tags=()), rig.cameras[0], [])
