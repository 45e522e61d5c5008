"""`cdpr calibrate camera` on typical folders."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from model.pose import Pose, matrix_from_rotation_vector
from tests.calibration.board_images import MATRIX, picture_of, poses_before_the_camera, with_noise
from tests.calibration.exif import rotated_by_exif
from tests.cli.program import call, one_message

BOARD = ("--board", "chessboard", "--columns", "9", "--rows", "6", "--square-mm", "25")
MIDDLE = np.array([0.1, 0.0625, 0.0])


def chessboard_print() -> np.ndarray:
    squares = np.add.outer(np.arange(9), np.arange(12)) % 2
    inner = np.where(squares == 0, 30, 220).astype(np.uint8)
    inner[0], inner[-1], inner[:, 0], inner[:, -1] = 220, 220, 220, 220
    return np.kron(inner, np.ones((50, 50), np.uint8))


def pictures(count: int, spread: float) -> list[np.ndarray]:
    origin = np.full(2, 0.050)
    return [
        with_noise(picture_of(chessboard_print(), 0.0005, origin, pose), k)
        for k, pose in enumerate(poses_before_the_camera(MIDDLE, count, spread=spread))
    ]


def save(path: Path, image: np.ndarray) -> None:
    good, data = cv2.imencode(path.suffix, image)
    assert good
    path.write_bytes(data.tobytes())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fourteen good images in several formats, and unusable files."""
    folder = tmp_path_factory.mktemp("my images")
    for k, image in enumerate(pictures(14, 0.09)):
        if k == 0:
            (folder / "turned.jpg").write_bytes(rotated_by_exif(image))
        elif k == 1:
            save(folder / "colour.png", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        else:
            save(folder / f"view_{k}.png", image)
    save(folder / "wall.png", np.full((480, 640), 128, np.uint8))
    save(folder / "small.png", np.full((240, 320), 128, np.uint8))
    (folder / "broken.jpg").write_bytes(b"not a picture")
    (folder / "notes.txt").write_text("taken on Monday")
    return folder


def test_a_folder_is_calibrated_and_what_is_of_no_use_is_named(folder, tmp_path) -> None:
    answer = call("calibrate", "camera", folder, *BOARD, "--json", "-o", tmp_path / "out")
    found = json.loads(answer.out)
    assert found["pictures_used"] == 14
    assert found["fx_px"] == pytest.approx(MATRIX[0, 0], abs=3.0)
    assert found["fy_px"] == pytest.approx(MATRIX[1, 1], abs=3.0)
    assert found["cx_px"] == pytest.approx(MATRIX[0, 2], abs=3.0)
    assert found["cy_px"] == pytest.approx(MATRIX[1, 2], abs=3.0)
    assert len(found["distortion"]) == 5
    assert found["rms_px"] < 0.2
    low, high = found["intervals"]["fx_px"]
    assert low < found["fx_px"] < high
    assert set(found["unused"]) == {"wall.png", "small.png", "broken.jpg"}
    assert found["verdict"].startswith("good enough for" if answer.code == 0 else "not good enough")
    (saved,) = (tmp_path / "out").glob("calibration_camera_camera_*.yaml")
    assert yaml.safe_load(saved.read_text()) == found
    page = saved.with_suffix(".html").read_text()
    assert "broken.jpg" in page
    assert "<script" not in page


def test_people_read_the_verdict_first(folder) -> None:
    known = ("--wanted-mm", "5", "--distance-m", "0.5")
    answer = call("calibrate", "camera", folder, *BOARD, *known)
    assert answer.code == 0, answer
    assert answer.out.splitlines()[1].split()[:3] == ["verdict", "good", "enough"]
    assert "small.png has 320 x 240 px, most have 640 x 480 px" in answer.out


def test_a_stated_square_size_that_is_too_small_does_not_make_a_result_good(tmp_path) -> None:
    """All millimetres shrink with the squares, pixels do not."""
    rng = np.random.default_rng(3)
    for k, image in enumerate(pictures(12, 0.09)):
        noisy = image + rng.normal(scale=25.0, size=image.shape)
        save(tmp_path / f"{k}.png", np.clip(noisy, 0, 255).astype(np.uint8))
    answer = call("calibrate", "camera", tmp_path, *BOARD, "--wanted-mm", "5", "--square-mm", "2")
    assert answer.code == 3, answer
    assert "1 px is required" in answer.said
    assert "pass --distance-m" in answer.said


def test_a_poor_set_with_small_errors_is_not_good_enough(tmp_path) -> None:
    """Twelve sharp images, all nearly alike: the RMS is small and says nothing."""
    rng = np.random.default_rng(1)
    base = poses_before_the_camera(MIDDLE, 1, spread=0.0)[0]
    for k in range(12):
        turn = matrix_from_rotation_vector(rng.normal(0.0, 0.03, 3)) @ base.rotation
        middle = base.apply(MIDDLE) + rng.normal(0.0, 0.003, 3)
        pose = Pose(middle - turn @ MIDDLE, turn)
        image = picture_of(chessboard_print(), 0.0005, np.full(2, 0.050), pose)
        save(tmp_path / f"{k}.png", with_noise(image, k))
    answer = call("calibrate", "camera", tmp_path, *BOARD, "--json")
    assert answer.code == 3, answer
    found = json.loads(answer.out)
    assert found["rms_px"] < 0.1
    assert found["verdict"].startswith("not good enough")
    assert "tilt the board up to 40° in every direction" in found["next_steps"]
    assert any("edges and corners" in step for step in found["next_steps"])


def test_one_picture_many_times_is_never_good_enough(tmp_path) -> None:
    for k, image in enumerate(pictures(1, 0.0) * 8):
        save(tmp_path / f"{k}.png", image)
    answer = call("calibrate", "camera", tmp_path, *BOARD)
    one_message(answer, 2, "in 8 of 8 images, only 1 of them different", "1.png duplicates 0.png")
    assert "tilt" in answer.said
    assert "dimensions" not in answer.said


def test_a_board_with_another_number_of_corners_is_reported(tmp_path) -> None:
    save(tmp_path / "a.png", pictures(1, 0.0)[0])
    options = ("--columns", "11", "--rows", "7", "--square-mm", "25")
    answer = call("calibrate", "camera", tmp_path, *options)
    one_message(answer, 2, "png shows a chessboard of 9 x 6 inner corners")


def test_a_wrong_size_of_squares_shows_in_the_distance_of_the_boards(folder) -> None:
    """Images alone do not show it: the camera is the same, everything is ten times as far."""
    answer = call("calibrate", "camera", folder, *BOARD[:-1], "250", "--wanted-mm", "10")
    (line,) = (row for row in answer.out.splitlines() if row.split()[:2] == ["board", "distance"])
    near, far = line.split()[2], line.split()[4]
    assert 3.5 < float(near) < float(far) < 7.5  # they were 0.4 to 0.65 m away
    assert "if not, the sizes are wrong" in line


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ((*BOARD, "--name", "front/left"), "--name"),
        (("--square-mm", "25"), "needs --columns and --rows"),
        (("--columns", "9", "--rows", "6"), "needs --square-mm"),
        ((*BOARD, "--tag-mm", "30"), "does not take --tag-mm"),
        (("--columns", "2", "--rows", "5", "--square-mm", "25"), "3 inner corners"),
    ],
)
def test_options_that_cannot_be_are_refused(folder, options, named: str) -> None:
    answer = call("calibrate", "camera", folder, *options)
    assert answer.code == 2
    assert named in answer.err
    assert "Traceback" not in answer.err


def test_three_pictures_are_too_few(tmp_path) -> None:
    for k, image in enumerate(pictures(3, 0.05)):
        save(tmp_path / f"{k}.png", image)
    answer = call("calibrate", "camera", tmp_path, *BOARD)
    assert answer.code == 2
    assert "found in 3 of 3 images; at least 4 are required" in answer.err
