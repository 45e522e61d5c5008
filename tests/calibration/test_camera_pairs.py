"""A camera located by another: both see the platform, or a board, at the same time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibration.extrinsics.camera_pairs import (
    BodyObservation,
    _board_pose,
    locate_by_pairs,
    require_oriented,
)
from calibration.targets.boards import Chessboard, DetectedBoard
from calibration.targets.grids import TagGrid
from model.errors import BadInput
from model.files.documents import PoseDocument
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig, load_rig, rig_from_document
from model.scene import empty_scene
from simulation.camera.camera import SyntheticCamera
from simulation.ground_truth import Optics
from tests.cli.program import call, one_message
from tracking.camera_model import pixels_of

RIG = Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml"
WRONG = np.array([0.03, -0.02, 0.01])


def rotated_about_home(rig: Rig, degrees: float) -> Pose:
    """The first camera's pose, rotated about the vertical through home."""
    turn = matrix_from_rotation_vector(np.array([0.0, 0.0, np.radians(degrees)]))
    own = rig.cameras[0].world_from_camera
    return Pose(turn @ (own.position - rig.home.position) + rig.home.position, turn @ own.rotation)


@pytest.fixture(scope="module")
def two() -> tuple[Rig, Pose]:
    """A rig with a second camera with a wrong pose in the file, and its true pose."""
    rig = load_rig(RIG)
    truth = rotated_about_home(rig, 25.0)
    first = rig.document.cameras[0]
    covariance = np.diag([0.04] * 3 + [1e-4] * 3).tolist()
    front = first.model_copy(update={"pose_covariance": covariance})
    wrong = PoseDocument.of(Pose(truth.position + WRONG, truth.rotation))
    side = first.model_copy(update={"name": "side", "world_from_camera": wrong})
    return rig_from_document(rig.document.model_copy(update={"cameras": [front, side]})), truth


def where_it_goes(rig: Rig, count: int) -> list[Pose]:
    rng = np.random.default_rng(4)
    return [
        Pose(
            rig.home.position + rng.uniform(-0.12, 0.12, 3),
            matrix_from_rotation_vector(rng.uniform(-0.15, 0.15, 3)),
        )
        for _ in range(count)
    ]


@pytest.fixture(scope="module")
def folders(two: tuple[Rig, Pose], tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig, truth = two
    root = tmp_path_factory.mktemp("pairs")
    for camera in (rig.cameras[0], replace(rig.cameras[1], world_from_camera=truth)):
        (root / camera.name).mkdir()
        optics = Optics(noise=1.5, cables=False)
        eye = SyntheticCamera(rig, empty_scene(rig), camera, 7, optics)
        for number, pose in enumerate(where_it_goes(rig, 14)):
            file = root / camera.name / f"{number:02}.png"
            cv2.imwrite(str(file), eye.render(pose, number))
    (root / "side" / "alone.png").write_bytes((root / "side" / "00.png").read_bytes())
    document = rig.document.model_dump(mode="json", exclude_unset=True)
    (root / "rig.yaml").write_text(yaml.safe_dump(document))
    return root


def test_a_second_camera_is_located_by_the_first(two, folders: Path, tmp_path: Path) -> None:
    _, truth = two
    beside = f"front={folders / 'front'}"
    verb = ("calibrate", "extrinsics", folders / "rig.yaml", folders / "side", "--camera", "side")
    answer = call(*verb, "--beside", beside, "-o", tmp_path / "out", "--json", "--wanted-mm", 2)
    assert answer.code == 0, answer
    result = json.loads(answer.out)
    found = PoseDocument.model_validate(result["world_from_camera"]).pose()
    assert found.distance_to(truth) < 1e-3
    assert np.degrees(found.angle_to(truth)) < 0.05
    assert result["by"] == "another camera"
    assert any("alone.png" in name for name in result["unused"])
    for axis, name in enumerate(("x_mm", "y_mm", "z_mm")):
        low, high = result["intervals"][name]
        assert low < truth.position[axis] * 1e3 < high
    # It includes 0.2 mm from the other camera's pose, which do not average out.
    assert np.sqrt(result["pose_covariance"][0][0]) > 0.19
    [file] = (tmp_path / "out").glob("*.yaml")
    new = tmp_path / "new.yaml"
    assert call("calibrate", "apply", folders / "rig.yaml", file, "-o", new).code == 0


def test_mistakes_are_refused_in_one_message(folders: Path) -> None:
    rig, side = folders / "rig.yaml", folders / "side"
    verb = ("calibrate", "extrinsics", rig, side, "--camera", "side", "--beside")
    one_message(call(*verb, f"side={side}"), 2, "cannot be located relative to itself")
    one_message(call(*verb, f"top={side}"), 2, "'top'")
    board = ("--columns", 9, "--rows", 6, "--square-mm", 25)
    one_message(call(*verb, f"front={folders / 'front'}", *board), 2, "rotated by 180")


def test_boards_without_a_unique_orientation_are_refused() -> None:
    require_oriented(TagGrid(4, 3, 0.05, 0.02, "tag36h11"))
    with pytest.raises(BadInput, match="180"):
        require_oriented(Chessboard(9, 6, 0.02))


def test_a_boards_pose_and_its_covariance_are_honest(two) -> None:
    """The squared error of 200 noisy views in units of the covariance is 6 on average."""
    camera = two[0].cameras[0]
    board = TagGrid(4, 3, 0.05, 0.02, "tag36h11")
    points = board.points_of(range(12))
    rng, noise, squares = np.random.default_rng(2), 0.1, []
    pose = Pose(np.array([-0.1, -0.1, 0.9]), matrix_from_rotation_vector([0.4, 0.3, 0.1]))
    for _ in range(200):
        corners = pixels_of(camera, pose.apply(points))
        look = _board_pose(
            DetectedBoard(points, corners + noise * rng.standard_normal(corners.shape)), camera
        )
        assert look is not None
        gap = look.camera_from_body.position - pose.position
        squares.append(gap @ np.linalg.solve(look.covariance[:3, :3], gap))
    assert 2.4 < np.mean(squares) < 3.7


def test_pairs_that_agree_but_for_one_are_not_led_astray(two) -> None:
    rig, truth = two
    front = rig.cameras[0]
    covariance = np.diag([1e-8] * 3 + [1e-8] * 3)
    pairs = {}
    for number, pose in enumerate(where_it_goes(rig, 12)):
        off = 0.05 if number == 3 else 0.0
        body = Pose(pose.position + off, pose.rotation)
        pairs[str(number)] = (
            BodyObservation(truth.inverse().compose(pose), covariance, 0.1),
            BodyObservation(front.world_from_camera.inverse().compose(body), covariance, 0.1),
        )
    found = locate_by_pairs(rig, rig.cameras[1], front, pairs, {}, "sha256:0")
    assert found.world_from_camera.distance_to(truth) < 1e-3
    few = dict(list(pairs.items())[:2])
    with pytest.raises(BadInput, match="2 pairs"):
        locate_by_pairs(rig, rig.cameras[1], front, few, {}, "sha256:0")
