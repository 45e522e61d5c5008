"""Corners detected by another program, read from a CSV file."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.intrinsics.calibrate import calibrate_from_views
from calibration.targets.boards import Chessboard, DetectedBoard, read_corners
from model.errors import BadInput
from model.pose import matrix_from_rotation_vector
from tests.calibration.test_lens_models import SIZE, views
from tests.cli.program import call, one_message

HEAD = "picture,x_px,y_px,board_x_mm,board_y_mm"


def text_of(seen: dict[str, DetectedBoard]) -> str:
    lines = [
        f"{name},{x:.9f},{y:.9f},{p[0] * 1e3:.6f},{p[1] * 1e3:.6f}"
        for name, view in seen.items()
        for (x, y), p in zip(view.corners, view.points, strict=True)
    ]
    return "\n".join([HEAD, *lines]) + "\n"


def test_corners_of_a_file_calibrate_as_those_that_were_found(tmp_path: Path) -> None:
    seen = views("five", 14)
    file = tmp_path / "corners.csv"
    file.write_text(text_of(seen))
    direct = calibrate_from_views(seen, SIZE, lens="five")
    answer = call("calibrate", "camera", file, "--size-px", *SIZE, "--lens", "five", "--json")
    assert answer.code in (0, 3), answer
    result = json.loads(answer.out)
    assert result["fx_px"] == pytest.approx(direct.matrix[0, 0], abs=0.01)
    assert result["pictures_used"] == 14


def test_pictures_with_few_corners_and_copies_are_left_out_by_name(tmp_path: Path) -> None:
    """Copies with noise, and with other corners than the first, add nothing."""
    seen, rng = views("five", 6), np.random.default_rng(2)
    copies = {
        f"copy {k}{name}": DetectedBoard(
            view.points[k:], (view.corners + 0.03 * rng.standard_normal(view.corners.shape))[k:]
        )
        for k in range(3)
        for name, view in seen.items()
    }
    results = []
    for text in (text_of(seen), text_of(seen | copies) + "few,1,2,3,4\n"):
        file = tmp_path / "corners.csv"
        file.write_text(text)
        answer = call("calibrate", "camera", file, "--size-px", *SIZE, "--json")
        assert answer.code in (0, 3), answer
        results.append(json.loads(answer.out))
    plain, found = results
    assert found["pictures_used"] == 6
    assert found["intervals"] == plain["intervals"]
    reasons = {name: f"duplicates {name[6:]}: nothing moved in between" for name in copies}
    assert found["unused"] == {"few": "has fewer than 8 corners"} | reasons


@pytest.mark.parametrize("kept", [slice(0, 9), slice(0, 54, 9), [0] * 9])
def test_an_image_with_corners_in_one_line_is_left_out_by_name(
    tmp_path: Path, kept: slice | list[int]
) -> None:
    seen, board = views("five", 4), Chessboard(9, 6, 0.025).points()[kept]
    row = DetectedBoard(np.resize(board, (9, 3)), np.arange(18.0).reshape(9, 2))
    file = tmp_path / "corners.csv"
    file.write_text(text_of(seen | {"row": row}))
    found, unused = read_corners(file)
    assert set(found) == set(seen)
    assert unused == {"row": "has corners in one line only"}


def test_copies_do_not_make_up_for_too_few_pictures(tmp_path: Path) -> None:
    seen = views("five", 3)
    file = tmp_path / "corners.csv"
    file.write_text(text_of(seen | {f"copy {name}": view for name, view in seen.items()}))
    answer = call("calibrate", "camera", file, "--size-px", *SIZE)
    one_message(answer, 2, "3 images have corners", "copy 0 duplicates 0: nothing moved")


@pytest.mark.parametrize("seed", [0, 2])
def test_a_lens_that_reaches_only_the_middle_is_refused(tmp_path: Path, seed: int) -> None:
    """The board stays in the middle of the image, too far away for so many coefficients."""
    rng, size = np.random.default_rng(seed), (1280, 960)
    matrix = np.array([[1000.0, 0.0, 650.0], [0.0, 1005.0, 470.0], [0.0, 0.0, 1.0]])
    distortion = np.array([-0.25, 0.08, 0.0005, -0.0003, 0.0])
    board, seen = Chessboard(9, 6, 0.025).points(), {}
    for k in range(14):
        turn, far = np.radians(35.0) * rng.uniform(-1, 1, 3), 1.5 * rng.uniform(0.8, 1.3)
        middle = np.array([*(0.5 * far * rng.uniform(-0.1, 0.1) for _ in "xy"), far])
        shift = middle - matrix_from_rotation_vector(turn) @ board.mean(axis=0)
        corners = cv2.projectPoints(board, turn, shift, matrix, distortion)[0].reshape(-1, 2)
        noisy = corners + 0.3 * rng.standard_normal(corners.shape)
        seen[f"{k}"] = DetectedBoard(board, noisy)
    file = tmp_path / "corners.csv"
    file.write_text(text_of(seen))
    answer = call("calibrate", "camera", file, "--size-px", *size, "--lens", "thin-prism")
    one_message(answer, 2, "no ray through a part of the image", "--lens five")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "no values"),
        ("picture,x_px,y_px,board_x_mm\na,1,2,3\n", "'board_y_mm' is missing"),
        (f"{HEAD}\na,1,2,3\n", "line 2"),
        (f"{HEAD}\na,1,2,3,nan\n", "line 2"),
        (f"{HEAD}\na,1,2,3,4\n", "no image has 8 corners that are not in one line"),
    ],
)
def test_files_that_hold_no_corners_are_refused(tmp_path: Path, text: str, named: str) -> None:
    file = tmp_path / "corners.csv"
    file.write_text(text)
    with pytest.raises(BadInput, match=named):
        read_corners(file)


@pytest.mark.parametrize("options", [("--square-mm", 25), ("--pictures", 20)])
def test_options_that_do_not_apply_to_corners_are_refused(
    tmp_path: Path, options: tuple[str, int]
) -> None:
    """As where the positions are in squares, and their side is given beside them."""
    file = tmp_path / "corners.csv"
    file.write_text(text_of(views("five", 4)))
    answer = call("calibrate", "camera", file, "--size-px", *SIZE, *options)
    one_message(answer, 2, "takes no board and no --pictures", "in mm")


def test_the_images_size_is_needed_and_checked(tmp_path: Path) -> None:
    file = tmp_path / "corners.csv"
    file.write_text(text_of(views("five", 6)))
    one_message(call("calibrate", "camera", file), 2, "a file of corners needs --size-px")
    small = call("calibrate", "camera", file, "--size-px", 320, 200)
    one_message(small, 2, "within 320 x 200 px")
