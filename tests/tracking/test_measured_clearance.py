"""The uncertainty of a clearance follows from the pose's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from model.clearance import ClearanceModel
from model.files.rig_file import RigDocument
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, rig_from_document
from model.scene import Scene, load_scene
from simulation.camera.camera import SyntheticCamera
from tracking.clearance import DEVIATIONS, UNSTATED, MeasuredClearance, clearance_of
from tracking.measurement import PoseMeasurement
from tracking.multi_camera import together
from tracking.tracker import Tracker

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def crowded() -> Scene:
    return load_scene(CONFIGS / "environment_3.yaml")


def measurement(pose: Pose, covariance: np.ndarray) -> PoseMeasurement:
    return PoseMeasurement(0.0, pose, covariance, (301, 303), 0.03, "found")


@pytest.mark.parametrize("seed", range(6))
def test_uncertainty_agrees_with_distances_at_scattered_poses(
    rig: Rig, crowded: Scene, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    model = ClearanceModel(rig, crowded)
    turn = matrix_from_rotation_vector(rng.normal(size=3) * 0.05)
    pose = Pose(rng.uniform([-0.05, -0.1, 0.5], [0.15, 0.05, 0.6]), turn)
    root = rng.standard_normal((6, 6)) * np.array([*[2e-5] * 3, *[2e-4] * 3])[:, None]
    covariance = root @ root.T
    stated = clearance_of(model, measurement(pose, covariance))
    assert stated is not None
    steps = rng.multivariate_normal(np.zeros(6), covariance, size=300)
    distances = []
    for step in steps:
        turned = matrix_from_rotation_vector(step[3:]) @ pose.rotation
        near = model.obstacles(Pose(pose.position + step[:3], turned))
        distances.append([n.distance for n in near])
    scatter = np.std(np.array(distances), axis=0)
    predicted = (stated.uncertainties - UNSTATED) / DEVIATIONS
    apart = np.array([n.distance > 0.0 for n in stated.nearest])
    assert apart.sum() >= 2
    np.testing.assert_allclose(predicted[apart], scatter[apart], rtol=0.15)
    assert np.all(predicted > 0.85 * scatter)  # where bodies overlap, the worst direction


def test_the_smallest_distance_counts_the_others_uncertainty_too(rig: Rig, crowded: Scene) -> None:
    near = ClearanceModel(rig, crowded).obstacles(rig.home)
    first, second = replace(near[0], distance=0.010), replace(near[1], distance=0.011)
    measured = MeasuredClearance((first, second), np.array([0.001, 0.004]))
    assert measured.distance == pytest.approx(0.010)
    assert measured.uncertainty == pytest.approx(0.003)  # the second may be as near as 7 mm


def test_touching_bodies_take_the_worst_direction(rig: Rig, crowded: Scene) -> None:
    model = ClearanceModel(rig, crowded)
    covariance = np.diag([1e-8, 4e-8, 1e-8, 0.0, 0.0, 0.0])
    found = clearance_of(model, measurement(Pose.level([0.2, -0.15, 0.2]), covariance))
    assert found is not None
    assert found.distance < 0.0
    assert np.all(np.isfinite(found.uncertainties))
    assert np.all(found.uncertainties >= UNSTATED)


def test_a_scene_without_obstacles_has_no_clearance(rig: Rig, crowded: Scene) -> None:
    empty = ClearanceModel(rig, replace(crowded, obstacles=()))
    assert clearance_of(empty, measurement(rig.home, np.eye(6) * 1e-8)) is None


def looking(rig: Rig, **said: object) -> Camera:
    """The rig's camera, as a rig file with these keys makes it."""
    plain = rig.document.model_dump(mode="json", exclude_unset=True)
    plain["cameras"][0] |= said
    return rig_from_document(RigDocument.model_validate(plain)).cameras[0]


PLACE = np.array([0.8, 0.5, 1.2, 0.06, 0.09, 0.03])
"""Deviations of a camera's place, [mm] and [deg]."""


def test_errors_of_the_cameras_place_are_carried_to_the_clearance(rig: Rig, crowded: Scene) -> None:
    """Cameras that are off by chance as stated put the platform where the clearance differs."""
    rng = np.random.default_rng(5)
    camera = looking(rig, pose_covariance=np.diag(PLACE**2).tolist())
    model = ClearanceModel(rig, crowded)
    pose = Pose(np.array([0.05, -0.03, 0.55]), matrix_from_rotation_vector([0.02, -0.01, 0.03]))
    seen = camera.world_from_camera.inverse().compose(pose)
    sure = replace(
        measurement(pose, np.zeros((6, 6))),
        shared=camera.shared_covariance(pose),
        unstated=False,
    )
    stated = clearance_of(model, sure)
    assert stated is not None
    distances = []
    for step in rng.normal(size=(300, 6)) * PLACE:
        turn = matrix_from_rotation_vector(np.radians(step[3:]))
        place = camera.world_from_camera
        moved = Pose(place.position + step[:3] / 1e3, turn @ place.rotation)
        distances.append([n.distance for n in model.obstacles(moved.compose(seen))])
    scatter = np.std(np.array(distances), axis=0)
    apart = np.array([n.distance > 0.005 for n in stated.nearest])
    assert apart.sum() >= 2
    np.testing.assert_allclose(stated.uncertainties[apart] / DEVIATIONS, scatter[apart], rtol=0.2)
    assert stated.uncertainties.max() > 2e-3  # where 0.5 mm were stated before, whatever was known


def test_one_number_of_the_operator_stands_for_all_that_is_shared(rig: Rig, crowded: Scene) -> None:
    camera = looking(rig, error_mm=1.96)
    assert camera.whole_error
    pose = Pose(np.array([0.05, -0.03, 0.55]), np.eye(3))
    np.testing.assert_allclose(
        camera.shared_covariance(pose), np.diag([1e-6] * 3 + [0.0] * 3), atol=1e-15
    )
    assert not looking(rig, error_mm=1.96, pose_covariance=np.eye(6).tolist()).whole_error


@pytest.mark.parametrize(
    "rows", [np.eye(5), np.triu(np.ones((6, 6))), -np.eye(6), np.eye(6)[:, :5]]
)
def test_what_is_no_covariance_of_a_pose_is_refused(rig: Rig, rows: np.ndarray) -> None:
    with pytest.raises(ValidationError, match="covariance"):
        looking(rig, pose_covariance=rows.tolist())


def test_a_mean_over_pictures_makes_no_shared_error_smaller(rig: Rig) -> None:
    """Two cameras of one survey err alike: both together are no surer than one."""
    place = np.diag(PLACE**2).tolist()
    camera = looking(rig, pose_covariance=place)
    pose = Pose(np.array([0.05, -0.03, 0.55]), np.eye(3))
    shared = camera.shared_covariance(pose)
    one = replace(measurement(pose, np.eye(6) * 1e-8), shared=shared, unstated=False)
    both = together({"a": one, "b": one})
    assert isinstance(both, PoseMeasurement)
    np.testing.assert_allclose(both.shared, shared, rtol=1e-9)
    assert not both.unstated
    half = together({"a": one, "b": replace(one, unstated=True)})
    assert isinstance(half, PoseMeasurement)
    assert half.unstated


@pytest.mark.parametrize(
    ("camera_says", "tags_say", "unstated"),
    [
        ({}, None, True),
        ({}, 0.1, True),
        ({"pose_covariance": np.eye(6).tolist()}, None, True),
        ({"pose_covariance": np.eye(6).tolist()}, 0.1, False),
        ({"error_mm": 0.8}, None, False),
    ],
)
def test_half_a_millimetre_is_added_only_where_something_is_unstated(
    rig: Rig, crowded: Scene, camera_says: dict, tags_say: float | None, unstated: bool
) -> None:
    plain = rig.document.model_dump(mode="json", exclude_unset=True)
    plain["cameras"][0] |= camera_says
    plain["tags"]["error_mm"] = tags_say
    said = rig_from_document(RigDocument.model_validate(plain))
    picture = SyntheticCamera(said, crowded, said.cameras[0], 3).render(said.home, 0)
    found = Tracker(said, said.cameras[0]).observe(picture, 0.0)
    assert isinstance(found, PoseMeasurement)
    assert found.unstated is unstated
    known = bool(camera_says) or tags_say is not None
    assert bool(np.trace(found.shared[:3, :3]) > 0.0) is known
    stated = clearance_of(ClearanceModel(said, crowded), found)
    assert stated is not None
    assert (stated.uncertainties.min() >= UNSTATED) or not unstated
