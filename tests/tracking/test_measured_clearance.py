"""The uncertainty of a clearance follows from the pose's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.clearance import ClearanceModel
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig
from model.scene import Scene, load_scene
from tracking.clearance import ALLOWANCE, DEVIATIONS, MeasuredClearance, clearance_of
from tracking.measurement import PoseMeasurement

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
    predicted = (stated.uncertainties - ALLOWANCE) / DEVIATIONS
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
    assert np.all(found.uncertainties >= ALLOWANCE)


def test_a_scene_without_obstacles_has_no_clearance(rig: Rig, crowded: Scene) -> None:
    empty = ClearanceModel(rig, replace(crowded, obstacles=()))
    assert clearance_of(empty, measurement(rig.home, np.eye(6) * 1e-8)) is None
