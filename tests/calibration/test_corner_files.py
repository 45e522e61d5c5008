"""Corners detected by another program, read from a CSV file."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calibration.intrinsics.calibrate import calibrate_from_views
from calibration.targets.boards import DetectedBoard, read_corners
from model.errors import BadInput
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


def test_pictures_with_few_corners_are_left_out(tmp_path: Path) -> None:
    file = tmp_path / "corners.csv"
    file.write_text(text_of(views("five", 2)) + "few,1,2,3,4\n")
    assert set(read_corners(file)) == {"0", "1"}


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "no values"),
        ("picture,x_px,y_px,board_x_mm\na,1,2,3\n", "'board_y_mm' is missing"),
        (f"{HEAD}\na,1,2,3\n", "line 2"),
        (f"{HEAD}\na,1,2,3,nan\n", "line 2"),
        (f"{HEAD}\na,1,2,3,4\n", "no image has 8 corners"),
    ],
)
def test_files_that_hold_no_corners_are_refused(tmp_path: Path, text: str, named: str) -> None:
    file = tmp_path / "corners.csv"
    file.write_text(text)
    with pytest.raises(BadInput, match=named):
        read_corners(file)


def test_the_images_size_is_needed_and_checked(tmp_path: Path) -> None:
    file = tmp_path / "corners.csv"
    file.write_text(text_of(views("five", 6)))
    one_message(call("calibrate", "camera", file), 2, "a file of corners needs --size-px")
    small = call("calibrate", "camera", file, "--size-px", 320, 200)
    one_message(small, 2, "within 320 x 200 px")
