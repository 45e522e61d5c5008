"""A lab's steps from the printed board to a good verdict, as on the documentation page."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.targets.boards import Chessboard
from model.pose import Pose, matrix_from_rotation_vector
from tests.calibration.board_images import DISTORTION, MATRIX, SIZE, picture_of, with_noise
from tests.calibration.pages import drawn, pages_in
from tests.cli.program import call

BOARD = ("--columns", 9, "--rows", 6, "--square-mm", 25)
PER_MM = 4.0


def print_of(pdf: Path) -> tuple[np.ndarray, np.ndarray]:
    """The printed page as a grey image, and the first inner corner on it, [m]."""
    size, rectangles, _ = pages_in(pdf.read_bytes())[0]
    page = drawn(size, rectangles, PER_MM)
    page = page if page.shape[1] > page.shape[0] else np.ascontiguousarray(np.rot90(page))
    seen = Chessboard(9, 6, 0.025).find(page)
    assert seen is not None
    corners = (seen.corners + 0.5) / PER_MM / 1e3
    across, down = corners[8] - corners[0], corners[-9] - corners[0]
    if across[0] < 0.0 or down[1] < 0.0:  # found rotated by 180°: the same print
        page, corners = np.ascontiguousarray(page[::-1, ::-1]), None
        seen = Chessboard(9, 6, 0.025).find(page)
        assert seen is not None
        corners = (seen.corners + 0.5) / PER_MM / 1e3
    return page, corners.min(axis=0)


def as_the_page_says(count: int) -> list[Pose]:
    """Near the edges and corners and in the middle, tilted up to 40° in every direction."""
    middle = Chessboard(9, 6, 0.025).points().mean(axis=0)
    rng = np.random.default_rng(6)
    positions = [(x, y) for x in (-0.13, 0.0, 0.13) for y in (-0.1, 0.0, 0.1)]
    poses = []
    while len(poses) < count:
        x, y = positions[len(poses) % len(positions)]
        turn = matrix_from_rotation_vector([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.2, 0.2)])
        pose = Pose(np.array([x, y, rng.uniform(0.5, 0.6)]) - turn @ middle, turn)
        points = pose.apply(Chessboard(9, 6, 0.025).points())
        corners = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, DISTORTION)[0]
        inside = (corners > 8.0).all() and (corners < np.array(SIZE) - 8.0).all()
        if inside or rng.uniform() < 0.05:
            poses.append(pose)
    return poses


@pytest.mark.slow
def test_from_the_print_to_a_good_verdict(tmp_path: Path) -> None:
    pdf, folder = tmp_path / "board.pdf", tmp_path / "pictures"
    assert call("calibrate", "print", pdf, *BOARD).code == 0
    page, origin = print_of(pdf)
    folder.mkdir()
    for number, pose in enumerate(as_the_page_says(40)):
        image = with_noise(picture_of(page, 1e-3 / PER_MM, origin, pose), number)
        cv2.imwrite(str(folder / f"{number:02}.png"), image)
    options = (*BOARD, "--name", "front", "-o", tmp_path / "calibration", "--json")
    answer = call("calibrate", "camera", folder, *options)
    assert answer.code == 0, answer
    result = json.loads(answer.out)
    assert result["good_enough"]
    assert result["verdict"].startswith("good enough for")
    for name, truth in (("fx_px", MATRIX[0, 0]), ("fy_px", MATRIX[1, 1])):
        low, high = result["intervals"][name]
        assert low - 0.3 < truth < high + 0.3
    written = sorted(path.suffix for path in (tmp_path / "calibration").iterdir())
    assert written == [".html", ".yaml"]
