"""Poses selected for measuring: more informative than others, feasible and free."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from calibration.geometry.pose_selection import (
    PoseRequirements,
    _d_optimal,
    _short_tour,
    choose_poses,
    measurement_poses,
)
from model.clearance import ClearanceModel
from model.errors import BadInput, NoSolution
from model.files.rig_file import RigDocument
from model.files.scene_file import Payload
from model.pose import Pose
from model.rig import Rig, load_rig, rig_from_document
from model.scene import Scene, empty_scene, load_scene
from model.statics.gravity import working_tensions
from model.statics.tension_distribution import TensionInfeasible

ROOT = Path(__file__).resolve().parents[2]
WISH = PoseRequirements(
    12, np.radians(15.0), np.radians(15.0), 60, 4.0, 0.1e-3, (0.3e-3,) * 3 + (1e-3,) * 3
)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(ROOT / "configs/gachon_8_6_rehearsal.yaml")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(ROOT / "configs/turn.yaml")


@pytest.fixture(scope="module")
def poses(rig: Rig, scene: Scene) -> list[Pose]:
    return choose_poses(rig, scene, WISH, Parameters.of(rig, DEFAULT_DEVIATIONS), seed=1)


def test_every_pose_can_be_held_and_is_free(rig: Rig, scene: Scene, poses: list[Pose]) -> None:
    model = ClearanceModel(rig, scene)
    assert len(poses) == 12
    for pose in poses:
        tensions = working_tensions(rig, pose).tensions
        assert tensions.min() >= rig.min_tension + 4.0
        near = model.smallest(pose)
        assert near is not None
        assert near.distance > scene.obstacle_clearance
        assert model.self_clearance(pose).distance > scene.self_clearance


def test_poses_that_only_the_payload_makes_possible_can_be_chosen(rig: Rig) -> None:
    """Below the lower outlets all cables pull up: the platform's own weight is too small."""
    box = {"lower_mm": [-150.0, -150.0, -60.0], "upper_mm": [150.0, 150.0, 450.0]}
    low = rig_from_document(
        RigDocument.model_validate(rig.document.model_dump() | {"workspace": box})
    )
    scene = empty_scene(low).changed(payload=Payload(4.0, (0.0, 0.0, 0.0)))
    chosen = choose_poses(
        low, scene, replace(WISH, reserve=0.5), Parameters.of(low, DEFAULT_DEVIATIONS), 1
    )
    heights = [pose.position[2] for pose in chosen]
    assert min(heights) < 0.0 < max(heights)
    lowest = chosen[int(np.argmin(heights))]
    with pytest.raises(TensionInfeasible):
        working_tensions(low, lowest)


def test_the_platform_is_rotated_no_further_than_its_cables_allow(
    rig: Rig, poses: list[Pose]
) -> None:
    """From 12° on, cables of this rig are apart again, but have passed through each other."""
    angles = np.degrees([pose.angle_to(rig.home) for pose in poses])
    assert 4.0 < angles.max() < 11.0


def test_the_same_seed_chooses_the_same_poses(rig: Rig, scene: Scene, poses: list[Pose]) -> None:
    again = choose_poses(rig, scene, WISH, Parameters.of(rig, DEFAULT_DEVIATIONS), seed=1)
    assert all(a.distance_to(b) == 0.0 for a, b in zip(poses, again, strict=True))


def test_selected_poses_are_more_informative_than_random_ones() -> None:
    random = np.random.default_rng(3)
    rows = random.normal(size=(80, 4, 10)) * random.uniform(0.1, 3.0, (80, 1, 1))

    def log_determinant(chosen: list[int]) -> float:
        information = np.eye(10) + sum(rows[k].T @ rows[k] for k in chosen)
        return float(np.linalg.slogdet(information)[1])

    chosen = _d_optimal(rows, 15)
    assert len(set(chosen)) == 15
    others = [log_determinant(random.choice(80, 15, replace=False).tolist()) for _ in range(50)]
    assert log_determinant(chosen) > max(others)
    first = max(range(80), key=lambda k: log_determinant([k]))
    assert chosen[0] == first


def test_the_tour_through_all_poses_has_no_detour() -> None:
    line = [Pose.level([x, 0.0, 0.0]) for x in (0.3, 0.1, 0.5, 0.2, 0.4)]
    ordered = _short_tour(line, Pose.level([0.0, 0.0, 0.0]), 0.1)
    assert [round(float(p.position[0]), 1) for p in ordered] == [0.1, 0.2, 0.3, 0.4, 0.5]


def test_a_scene_without_room_is_refused(rig: Rig, scene: Scene) -> None:
    narrow = replace(scene, self_clearance=0.05)
    with pytest.raises(NoSolution, match="tried poses are feasible and free"):
        choose_poses(
            rig, narrow, replace(WISH, candidates=15), Parameters.of(rig, {"offsets": 1e-3}), 0
        )


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_that_no_plan_can_have_is_refused_at_once(rig: Rig, scene: Scene, seed: int) -> None:
    with pytest.raises(BadInput, match="seed must be a whole number"):
        measurement_poses(rig, scene, seed=seed)
