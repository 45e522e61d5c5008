"""A camera located by another: both see the platform, or a board, at the same time."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date
from itertools import permutations
from pathlib import Path
from typing import Any

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
from calibration.extrinsics.result import (
    ExtrinsicsResult,
    extrinsics_result,
    judge_extrinsics,
)
from calibration.targets.boards import Chessboard, DetectedBoard
from calibration.targets.grids import TagGrid
from model.errors import BadInput
from model.files.documents import PoseDocument
from model.pose import (
    Pose,
    matrix_from_rotation_vector,
    moved,
    rotation_vector_from_matrix,
    step_between,
)
from model.rig import Camera, Rig, load_rig, rig_from_document
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
    one_message(call(*verb, "front=1"), 2, "camera front: images of a live camera cannot be paired")
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
    with pytest.raises(BadInput, match="2 of 4 required"):
        locate_by_pairs(rig, rig.cameras[1], front, few, {}, "sha256:0")


@pytest.mark.parametrize("times", [1.0, 3.0, 10.0])
def test_intervals_hold_the_truth_whatever_noise_is_stated(two, times: float) -> None:
    """Errors of the tags' layout and print are not in the covariance of an observation."""
    rig, truth = two
    reference, rng = replace(rig.cameras[0], pose_covariance=None), np.random.default_rng(8)
    deviations = np.repeat([2e-4, 1e-3], 3)
    inside = []
    for _ in range(5):
        pairs = {}
        for k, pose in enumerate(where_it_goes(rig, 12)):
            there = (one.inverse().compose(pose) for one in (truth, reference.world_from_camera))
            pairs[str(k)] = tuple(
                BodyObservation(
                    moved(body, times * deviations * rng.standard_normal(6)),
                    np.diag(deviations**2),
                    0.1,
                )
                for body in there
            )
        found = locate_by_pairs(rig, rig.cameras[1], reference, pairs, {}, "sha256:0")
        gap = step_between(found.world_from_camera, truth)
        inside.append(np.abs(gap) <= found.half_widths)
    assert np.mean(inside) >= 0.92


def test_pairs_of_a_body_at_rest_count_once(two) -> None:
    """Their errors are common: 20 of them would make the interval too narrow by 4.5."""
    rig, truth = two
    board = TagGrid(4, 3, 0.05, 0.02, "tag36h11")
    points, rng = board.points_of(range(12)), np.random.default_rng(5)
    cameras = (replace(rig.cameras[1], world_from_camera=truth), rig.cameras[0])

    def seen(camera: Camera, pose: Pose) -> BodyObservation:
        exact = pixels_of(camera, camera.world_from_camera.inverse().compose(pose).apply(points))
        body = _board_pose(
            DetectedBoard(points, exact + 0.02 * rng.standard_normal(exact.shape)), camera
        )
        assert body is not None
        return body

    poses = where_it_goes(rig, 5)
    moving = {
        f"{k}": tuple(seen(camera, pose) for camera in cameras) for k, pose in enumerate(poses)
    }
    resting = {f"rest {k}": tuple(seen(camera, poses[0]) for camera in cameras) for k in range(20)}
    found = locate_by_pairs(rig, *cameras, moving | resting, {}, "sha256:0")
    once = locate_by_pairs(rig, *cameras, moving, {}, "sha256:0")
    assert found.pictures == 5
    assert list(found.unused) == [f"side: rest {k}" for k in range(20)]
    np.testing.assert_array_equal(found.half_widths, once.half_widths)
    with pytest.raises(BadInput, match="1 of 4 required") as caught:
        locate_by_pairs(rig, *cameras, resting, {}, "sha256:0")
    assert "duplicates rest 0: nothing moved" in caught.value.why


def by_lenses_off(two: tuple[Rig, Pose], own: np.ndarray, other: np.ndarray, scale: float):
    """The pose of the side camera if the lenses are off by fx, fy, cx, cy [px].

    Args:
        two: The rig and the camera's true pose.
        own: Of the side camera.
        other: Of the front camera.
        scale: Of the lenses' stated errors; they have deviations ``own`` and ``other``.
    """
    rig, truth = two
    board = TagGrid(4, 3, 0.05, 0.02, "tag36h11")
    points, rng = board.points_of(range(12)), np.random.default_rng(5)
    stated, images = [], []
    for camera, change in zip((rig.cameras[1], rig.cameras[0]), (own, other), strict=True):
        matrix = np.array(camera.matrix)
        matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += change
        off = np.concatenate([change, np.zeros(camera.distortion.size)])
        by_lens = np.zeros((6, len(off)))
        lens = {"lens_covariance": scale**2 * np.outer(off, off), "pose_by_lens": by_lens}
        stated.append(replace(camera, **lens))
        there = truth if camera.name == "side" else camera.world_from_camera
        images.append((replace(camera, matrix=matrix), there))
    pairs = {}
    for k, pose in enumerate(where_it_goes(rig, 6)):
        bodies = []
        for assumed, (camera, there) in zip(stated, images, strict=True):
            exact = pixels_of(camera, there.inverse().compose(pose).apply(points))
            noisy = exact + 0.01 * rng.standard_normal(exact.shape)
            bodies.append(_board_pose(DetectedBoard(points, noisy), assumed))
        pairs[str(k)] = tuple(bodies)
    return locate_by_pairs(rig, *stated, pairs, {}, "sha256:0")


@pytest.mark.parametrize("which", ["own", "other"])
@pytest.mark.parametrize("off", [[2.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.5]])
def test_a_lens_that_is_off_is_in_the_interval_of_the_pose(two, which: str, off: list) -> None:
    """The lenses of both cameras count; neither shows in the scatter of the pairs."""
    nothing = np.zeros(4)
    wrong = (np.array(off), nothing) if which == "own" else (nothing, np.array(off))
    true, found = by_lenses_off(two, nothing, nothing, 1.0), by_lenses_off(two, *wrong, 1.0)
    without = by_lenses_off(two, *wrong, 0.0)
    pose, right = found.world_from_camera, true.world_from_camera
    turn = rotation_vector_from_matrix(pose.rotation @ right.rotation.T)
    moved = np.concatenate([pose.position - right.position, turn])
    stated = found.covariance - without.covariance
    np.testing.assert_allclose(stated, np.outer(moved, moved), atol=0.1 * np.sum(moved**2))
    assert not (np.abs(moved) <= without.half_widths).all()
    assert (np.abs(moved) <= found.half_widths).all()
    if which == "own":
        change = np.array([*off, *np.zeros(found.by_lens.shape[1] - 4)])
        np.testing.assert_allclose(
            -found.by_lens @ change, moved, atol=0.05 * float(np.linalg.norm(moved))
        )


def by_exact_pairs(
    rig: Rig, camera: str, other: str, truths: dict[str, Pose], **changed: Any
) -> ExtrinsicsResult:
    """The result of a camera at its true pose, located by another at its pose in the rig."""
    covariance = 1e-8 * np.eye(6)
    reference = rig.camera(other)
    there = (truths[camera], reference.world_from_camera)
    pairs = {
        str(k): tuple(
            BodyObservation(one.inverse().compose(pose), covariance, 0.1) for one in there
        )
        for k, pose in enumerate(where_it_goes(rig, 12))
    }
    found = locate_by_pairs(rig, rig.camera(camera), reference, pairs, {}, "sha256:0")
    found = replace(found, **changed)
    verdict = judge_extrinsics(found, 1e-3)
    return extrinsics_result(found, verdict, rig.document, date(2026, 3, 2))


@pytest.mark.parametrize("rights_reference", ["front", "left"])
def test_results_of_three_cameras_can_be_applied_together_in_any_order(
    two, rights_reference: str
) -> None:
    """The front camera's own result, to which the others' belong, is among them."""
    first = two[0].document.cameras[0]
    cameras = [first.model_copy(update={"name": name}) for name in ("front", "left", "right")]
    rig = rig_from_document(two[0].document.model_copy(update={"cameras": cameras}))
    truths = {
        name: rotated_about_home(rig, degrees)
        for name, degrees in (("front", 1.0), ("left", 25.0), ("right", -25.0))
    }
    alone = {"by": "frame tags", "reference_camera": None}
    front = by_exact_pairs(rig, "front", "right", truths, **alone)
    located = rig.with_calibration(front)
    left = by_exact_pairs(located, "left", "front", truths)
    if rights_reference == "left":
        located = located.with_calibration(left)
    right = by_exact_pairs(located, "right", rights_reference, truths)
    for results in permutations((front, left, right)):
        together = rig.with_calibration(*results)
        for name, truth in truths.items():
            assert together.camera(name).world_from_camera.distance_to(truth) < 1e-6
    for one in (left, right):
        with pytest.raises(BadInput, match="was made with"):
            rig.with_calibration(one)


def test_cameras_located_by_each_other_are_refused(two) -> None:
    rig, truth = two
    truths = {"side": truth, "front": rotated_about_home(rig, 1.0)}
    results = [
        by_exact_pairs(rig, *names, truths) for names in (("side", "front"), ("front", "side"))
    ]
    for both in permutations(results):
        with pytest.raises(BadInput, match="was made with"):
            rig.with_calibration(*both)


def test_a_result_that_does_not_name_the_other_camera_is_refused(two) -> None:
    rig, truth = two
    made = by_exact_pairs(rig, "side", "front", {"side": truth})
    with pytest.raises(BadInput, match="was made with parameters of the camera or another camera"):
        rig.with_calibration(made.model_copy(update={"reference_camera": None}))
