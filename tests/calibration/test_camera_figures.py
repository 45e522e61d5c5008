"""The figures of a camera's report agree with the calibration."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from calibration.intrinsics.calibrate import CameraCalibration, calibrate_from_views, fit_camera
from calibration.intrinsics.quality import image_grid, judge_camera, pixel_uncertainty
from calibration.intrinsics.result import (
    camera_page,
    radial_pattern,
    residual_arrows,
    uncertainty_figure,
    worst_image,
)
from calibration.targets.boards import Chessboard
from tests.calibration.board_images import picture_of, poses_before_the_camera, with_noise
from tests.calibration.test_lens_models import SIZE, TRUTH, views

BOARD = Chessboard(9, 6, 0.02)


@pytest.fixture(scope="module")
def found() -> CameraCalibration:
    return calibrate_from_views(views("five"), SIZE, lens="five")


@pytest.fixture(scope="module")
def photographed() -> CameraCalibration:
    """Six rendered images of a chessboard."""
    mm = 4
    squares = np.indices((7, 10)).sum(axis=0) % 2 == 0
    black = np.kron(squares, np.ones((20 * mm, 20 * mm), dtype=bool))
    print_ = np.full((180 * mm, 240 * mm), 235, np.uint8)
    print_[20 * mm : 160 * mm, 20 * mm : 220 * mm][black] = 20
    middle = BOARD.points().mean(axis=0)
    poses = poses_before_the_camera(middle, 6)
    pictures = [
        (f"{k}.png", with_noise(picture_of(print_, 1e-3 / mm, np.array([0.04, 0.04]), pose), k))
        for k, pose in enumerate(poses)
    ]
    return fit_camera(pictures, BOARD, lens="five")


def test_the_map_of_uncertainty_makes_up_the_verdicts_error(found) -> None:
    quality = judge_camera(found, 1e-3, 1.0)
    focal = np.sqrt(found.matrix[0, 0] * found.matrix[1, 1])
    each = pixel_uncertainty(found, image_grid(SIZE))
    whole = np.sqrt(np.mean(each**2)) / focal
    assert each.shape == (81,)
    # Per pixel the larger of both covariances counts, for the mean that of the mean.
    assert quality.verdict.error <= whole <= 1.4 * quality.verdict.error


def test_the_map_is_darkest_where_no_board_was_seen() -> None:
    """Images of the left half: the right edge is unknown."""
    left = {
        name: seen for name, seen in views("five", 90).items() if seen.corners[:, 0].max() < 520
    }
    found = calibrate_from_views(left, SIZE, lens="five")
    seen, unseen = pixel_uncertainty(found, np.array([[200.0, 300.0], [940.0, 300.0]]))
    assert unseen > 1.5 * seen
    text = uncertainty_figure(found, judge_camera(found, 1e-3, 1.0))
    shades = [float(x) for x in re.findall(r'fill-opacity="([0-9.]+)"', text)]
    by_cell = np.array(shades).reshape(10, 16)
    assert by_cell[:, -1].mean() > 1.2 * by_cell[:, :8].mean()


def test_arrows_are_the_errors_of_corners(found) -> None:
    text = residual_arrows(found)
    lines = re.findall(
        r'<line x1="([-.0-9]+)" y1="([-.0-9]+)" x2="([-.0-9]+)" y2="([-.0-9]+)"', text
    )
    ends = np.array(lines, dtype=float)
    assert len(ends) <= 1500
    lengths = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    assert np.median(lengths) == pytest.approx(0.04 * 560.0, rel=0.1)


@pytest.mark.parametrize("lens", ["five", "fisheye"])
def test_a_radial_pattern_is_seen_where_the_model_is_wrong(lens: str) -> None:
    found = calibrate_from_views(views("fisheye"), SIZE, lens=lens)
    text = radial_pattern(found)
    middles = [float(y) for y in re.findall(r'cy="([-.0-9]+)"', text)]
    bars = re.findall(
        r'y1="([-.0-9]+)" x2="[-.0-9]+" y2="([-.0-9]+)" stroke="var\(--muted\)"/><c', text
    )
    halves = np.array([(float(b) - float(a)) / 2.0 for a, b in bars])
    beyond = np.abs(np.array(middles) - 110.0) > halves
    assert len(middles) == len(halves) == 12
    assert (beyond.sum() >= 8) if lens == "five" else (beyond.sum() <= 3)


def test_the_worst_image_is_on_the_page_with_its_board(photographed) -> None:
    [shown] = worst_image(photographed)
    name = max(photographed.view_errors, key=lambda key: photographed.view_errors[key])
    assert name in shown.note
    data = re.search(r"data:image/jpeg;base64,([^\"]+)", shown.body)
    assert data is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), 0)
    reference = photographed.previews[name]
    assert image.shape == reference.shape
    assert np.mean(np.abs(image.astype(float) - reference)) < 4.0
    # 9 x 6 corners have 8 x 6 + 9 x 5 neighbours; each corner has its error.
    assert shown.body.count("<line") == 8 * 6 + 9 * 5 + 54


def test_a_page_from_corners_alone_has_no_picture(found, photographed) -> None:
    for calibration, pictures in ((found, 0), (photographed, 1)):
        page = camera_page(calibration, judge_camera(calibration, 1e-3), "front", "2026-03-01")
        assert page.count("<image ") == pictures
        for heading in ("Uncertainty of pixels", "Errors of corners", "Radial errors"):
            assert heading in page


def test_all_lenses_have_figures() -> None:
    for name in TRUTH:
        found = calibrate_from_views(views(name), SIZE, lens=name)
        page = camera_page(found, judge_camera(found, 1e-3), name, "2026-03-01")
        assert "nan" not in page
