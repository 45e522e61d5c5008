"""`cdpr calibrate extrinsics`: cameras at another pose than in the rig file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from model.files.documents import PoseDocument
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import load_rig
from model.scene import load_scene
from simulation.camera.camera import SyntheticCamera
from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import call, nothing_written, one_message

TURNS = ((0.2, 0, 0), (0, 0.25, 0), (0, 0, 0.3), (-0.2, 0.1, 0), (0.1, -0.2, -0.3), (0, 0, -0.3))


def poses() -> list[Pose]:
    """Of the platform, far apart and rotated."""
    positions = [(0, 0, 0.45), (0.15, 0, 0.5), (-0.1, 0.1, 0.4), (0, -0.15, 0.55), (0.1, 0.1, 0.35)]
    return [
        Pose(
            positions[k % 5] + np.array([0, 0, 0.01 * k]), matrix_from_rotation_vector(TURNS[k % 6])
        )
        for k in range(10)
    ]


@pytest.fixture(scope="module")
def truth() -> Pose:
    named = load_rig(RIG).cameras[0].world_from_camera
    turn = matrix_from_rotation_vector([0.02, -0.01, 0.015])
    return Pose(named.position + np.array([0.03, -0.02, 0.01]), turn @ named.rotation)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, truth: Pose) -> Path:
    """Ten images, a file of the platform's poses, and unusable files."""
    folder = tmp_path_factory.mktemp("rig images")
    rig = load_rig(RIG)
    scene = replace(load_scene(CONFIGS / "environment_1.yaml"), obstacles=())
    camera = SyntheticCamera(rig, scene, replace(rig.cameras[0], world_from_camera=truth), seed=5)
    rows = ["picture,x_mm,y_mm,z_mm,qw,qx,qy,qz"]
    for k, pose in enumerate(poses()):
        cv2.imwrite(str(folder / f"{k}.png"), camera.render(pose, k))
        coordinates = ",".join(f"{1e3 * x:.6f}" for x in pose.position)
        rows.append(f"{k}.png,{coordinates}," + ",".join(f"{q:.9f}" for q in pose.quaternion))
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")
    cv2.imwrite(str(folder / "wall.png"), np.full((720, 1280), 128, np.uint8))
    cv2.imwrite(str(folder / "small.png"), np.full((240, 320), 128, np.uint8))
    (folder / "broken.jpg").write_bytes(b"not a picture")
    return folder


def far(found: dict, truth: Pose) -> float:
    """Error of the position found, [mm]."""
    pose = PoseDocument.model_validate(found["world_from_camera"]).pose()
    return pose.distance_to(truth) * 1e3


def test_a_camera_is_found_by_frame_tags_and_the_result_used(folder, truth, tmp_path) -> None:
    out = tmp_path / "out"
    options = ("--survey-mm", "0.1", "--wanted-mm", "2", "-o", out, "--json")
    answer = call("calibrate", "extrinsics", RIG, folder, *options)
    assert answer.code == 0, answer
    found = json.loads(answer.out)
    assert far(found, truth) < 1.0
    assert found["by"] == "frame tags"
    assert found["pictures"] == 10
    assert set(found["unused"]) == {"wall.png", "small.png", "broken.jpg"}
    assert found["unused"]["small.png"] == "has 320 x 240 px, the camera has 1280 x 720 px"
    assert found["verdict"].startswith("good enough for")
    (saved,) = out.glob("calibration_extrinsics_front_*.yaml")
    assert yaml.safe_load(saved.read_text()) == found
    page = saved.with_suffix(".html").read_text()
    assert "good enough for" in page
    assert "broken.jpg" in page
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "0.png").write_bytes((folder / "0.png").read_bytes())
    log = tmp_path / "poses.csv"
    wrong = call("track", RIG, tmp_path / "one", "-o", log)
    one_message(wrong, 2, "take more images: the next one that shows the frame tags decides")
    second = tmp_path / "one" / "1.png"
    second.write_bytes((folder / "1.png").read_bytes())
    wrong = call("track", RIG, tmp_path / "one", "-o", log)
    one_message(wrong, 1, "is not at the pose in the rig file")
    second.unlink()
    answer = call("track", RIG, tmp_path / "one", "-o", log, "--calibration", saved)
    assert answer.code == 0, answer
    x, y, z = (float(v) for v in log.read_text().splitlines()[1].split(",")[3:6])
    assert np.linalg.norm(np.array([x, y, z]) - poses()[0].position * 1e3) < 1.5


def test_a_camera_is_found_by_the_rigs_motion(folder, truth) -> None:
    options = ("--poses", folder / "poses.csv", "--wanted-mm", "5", "--json")
    answer = call("calibrate", "extrinsics", RIG, folder, *options)
    assert answer.code == 0, answer
    found = json.loads(answer.out)
    assert found["by"] == "rig motion"
    assert far(found, truth) < 3.0


@pytest.fixture(scope="module")
def run(short_plan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with the synthetic camera."""
    path = tmp_path_factory.mktemp("runs") / "run"
    assert call("run", short_plan, "--rig", RIG, "-o", path, "--fast").code == 0
    return path


def test_a_run_gives_its_poses_from_the_encoders(run: Path) -> None:
    answer = call("calibrate", "extrinsics", RIG, run / "pictures", "--poses", run, "--json")
    assert answer.code == 3, answer  # a short straight path gives little information
    found = json.loads(answer.out)
    assert found["pictures"] >= 8
    named = load_rig(RIG).cameras[0].world_from_camera
    for axis, coordinates in zip("xyz", named.position * 1e3, strict=True):
        low, high = found["intervals"][f"{axis}_mm"]
        assert low <= coordinates <= high


def test_the_pictures_of_another_camera_are_refused(run: Path, tmp_path: Path) -> None:
    two = tmp_path / "two.yaml"
    document = yaml.safe_load(RIG.read_text())
    document["cameras"].append({**document["cameras"][0], "name": "side"})
    two.write_text(yaml.safe_dump(document))
    options = ("--poses", run, "--camera", "side")
    answer = call("calibrate", "extrinsics", two, run / "pictures", *options)
    one_message(answer, 2, "camera 'side' took no images in this run", "front")


@pytest.mark.parametrize("number", ["inf", "nan"])
@pytest.mark.parametrize(
    ("verb", "option"),
    [
        ("extrinsics", "--survey-deg"),
        ("extrinsics", "--survey-mm"),
        ("extrinsics", "--wanted-mm"),
        ("rig", "--stiffness-percent"),
        ("rig", "--length-mm"),
        ("rig", "--tilt-deg"),
    ],
)
def test_numbers_that_are_not_finite_are_refused(folder, verb, option, number: str) -> None:
    answer = call("calibrate", verb, RIG, folder, option, number)
    assert answer.code == 2
    assert option in answer.err


def test_people_read_the_verdict_first(folder) -> None:
    answer = call("calibrate", "extrinsics", RIG, folder, "--survey-mm", "5")
    assert answer.code == 3
    lines = answer.out.splitlines()
    assert lines[0] == "extrinsics front"
    assert lines[1].split()[:4] == ["verdict", "not", "good", "enough:"]
    assert lines[2].split()[0] == "next"
    assert "moved" in answer.out


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--camera", "side"), "unknown camera 'side'"),
        (("--pictures", "2"), "--pictures is for a video or a camera"),
        (("--poses", "missing.csv"), "no such file"),
        (("--calibration", RIG), "not a calibration result"),
        (("--columns", "7", "--rows", "5"), "a board is only for --beside"),
    ],
)
def test_options_that_cannot_be_are_refused(folder, tmp_path, options, named: str) -> None:
    with nothing_written(tmp_path):
        answer = call("calibrate", "extrinsics", RIG, folder, "-o", tmp_path / "out", *options)
    one_message(answer, 2, named)


def test_unusable_folders_are_reported(folder, tmp_path) -> None:
    out = tmp_path / "out"
    answer = call("calibrate", "extrinsics", RIG, tmp_path / "nowhere", "-o", out)
    one_message(answer, 2, "not a folder of images")
    assert not out.exists()
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "a.png").write_bytes((folder / "small.png").read_bytes())
    answer = call("calibrate", "extrinsics", RIG, tmp_path / "small")
    one_message(answer, 2, "none of the 1 images has the camera's 1280 x 720 px", "320 x 240")
    (tmp_path / "walls").mkdir()
    (tmp_path / "walls" / "a.png").write_bytes((folder / "wall.png").read_bytes())
    answer = call("calibrate", "extrinsics", RIG, tmp_path / "walls")
    one_message(answer, 2, "none of the tag36h11 tags 401, 402, 403, 404", "no tag of any known")
