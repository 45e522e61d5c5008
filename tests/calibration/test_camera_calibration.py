"""Intrinsics from a chessboard: recovered from exact corners and from rendered images."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from calibration.intrinsics.calibrate import (
    CameraCalibration,
    calibrate_from_views,
    fit_camera,
)
from calibration.intrinsics.quality import is_below, judge_camera
from calibration.intrinsics.result import camera_page, camera_result
from calibration.result_files import load_result
from calibration.results import write_result
from calibration.statistics import covariance_of, student_factor
from calibration.targets.boards import Chessboard, DetectedBoard
from model.cameras import Z_95
from model.errors import BadInput
from model.files.camera_file import LensCovariance
from model.pose import Array, Pose, matrix_from_rotation_vector
from tests.calibration.board_images import DISTORTION, MATRIX, SIZE, picture_of

BOARD = Chessboard(9, 6, 0.025)


def board_poses(count: int) -> list[Pose]:
    rng = np.random.default_rng(4)
    poses = []
    for _ in range(count):
        turn = matrix_from_rotation_vector(rng.uniform(-0.6, 0.6, 3))
        middle = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.4, 0.6)])
        poses.append(Pose(middle - turn @ BOARD.points().mean(axis=0), turn))
    return poses


def corners_at(pose: Pose) -> Array:
    points = pose.apply(BOARD.points())
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, MATRIX, DISTORTION)[0].reshape(-1, 2)


def views(count: int, noise: float, seed: int = 5) -> dict[str, DetectedBoard]:
    rng = np.random.default_rng(seed)
    found = {}
    for k, pose in enumerate(board_poses(count)):
        corners = corners_at(pose)
        noisy = corners + noise * rng.standard_normal(corners.shape)
        found[f"view {k}"] = DetectedBoard(BOARD.points(), noisy)
    return found


def board_picture(pose: Pose) -> np.ndarray:
    """The board with a border of one square, black at its outer corner."""
    squares = np.add.outer(np.arange(BOARD.rows + 1), np.arange(BOARD.columns + 1)) % 2
    print_ = np.pad(np.where(squares == 0, 30, 220).astype(np.uint8), 1, constant_values=220)
    sheet = np.kron(print_, np.ones((50, 50), np.uint8))
    return picture_of(sheet, BOARD.square / 50, np.full(2, 2.0 * BOARD.square), pose)


def check_values(found: CameraCalibration, pixels: float) -> None:
    assert np.abs(found.matrix - MATRIX).max() < pixels
    assert np.abs(found.distortion[0] - DISTORTION[0]) < 0.03


def test_exact_corners_give_the_exact_camera() -> None:
    found = calibrate_from_views(views(8, 0.0), SIZE)
    np.testing.assert_allclose(found.matrix, MATRIX, atol=0.02)
    np.testing.assert_allclose(found.distortion, DISTORTION, atol=2e-3)
    assert found.error < 1e-3


TRUTH = np.array([600.0, 603.0, 322.0, 238.0, *DISTORTION])


def test_noisy_corners_stay_within_the_stated_intervals() -> None:
    inside = []
    for seed in range(30):
        found = calibrate_from_views(views(14, 0.1, seed), SIZE)
        assert 0.05 < found.error < 0.25
        bounds = np.array([interval.bounds for interval in found.intervals.values()])
        inside.append((bounds[:, 0] <= TRUTH) & (bounds[:, 1] >= TRUTH))
    shares = np.mean(inside, axis=0)
    assert (shares[:4] >= 0.85).all()
    assert shares.mean() >= 0.9


def test_correlated_corner_errors_widen_the_intervals() -> None:
    """As with a bent board: by scatter alone the intervals would not change."""
    straight, bent = views(14, 0.02), {}
    for k, (name, seen) in enumerate(straight.items()):
        shift = 0.4 * np.array([np.sin(2.0 * k), np.cos(3.0 * k)])
        wave = np.sin(np.arange(len(seen.corners)) / 5.0 + k)[:, None]
        bent[name] = DetectedBoard(seen.points, seen.corners + shift * wave)
    sure = calibrate_from_views(straight, SIZE).uncertainty.half_widths
    unsure = calibrate_from_views(bent, SIZE).uncertainty.half_widths
    assert (unsure[:4] > 3.0 * sure[:4]).all()


@pytest.mark.parametrize("count", [4, 5, 6, 8])
def test_intervals_from_few_images_cover_correlated_errors(count: int) -> None:
    """Smooth shifts of 0.2 px in each image: by scatter alone, half of the intervals hold."""
    x, y = (BOARD.points()[:, :2] - BOARD.points()[:, :2].mean(axis=0)).T / 0.1
    shapes = np.column_stack([x**2, x * y, y**2, x**3, y**3, x**2 * y, x * y**2])
    inside, wider = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        shifted = {}
        for name, seen in views(count, 0.05, seed).items():
            wave = shapes @ rng.standard_normal((7, 2))
            wave *= 0.2 / np.sqrt(np.mean(wave**2))
            shifted[name] = DetectedBoard(seen.points, seen.corners + wave)
        found = calibrate_from_views(shifted, SIZE)
        off = np.array([interval.value for interval in found.intervals.values()]) - TRUTH
        inside.append(np.abs(off) <= found.uncertainty.half_widths)
        stated, scatter = found.uncertainty.stated_covariance, found.uncertainty.covariance
        wider.append(stated[0, 0] / scatter[0, 0] / (student_factor(count - 1) / Z_95) ** 2)
    assert np.mean(inside) >= 0.9
    assert np.median(wider) > 2.0


def test_the_change_without_an_image_is_that_of_a_fit_without_it() -> None:
    all_views = views(12, 0.1)
    found = calibrate_from_views(all_views, SIZE)
    for k, name in enumerate(list(all_views)[:4]):
        rest = {other: seen for other, seen in all_views.items() if other != name}
        change = calibrate_from_views(rest, SIZE).matrix[0, 0] - found.matrix[0, 0]
        assert found.uncertainty.without[k, 0] == pytest.approx(change, abs=0.25)


@given(st.integers(0, 2**32 - 1), st.integers(4, 12), st.floats(0.0, 12.5))
def test_covariances_are_symmetric_and_positive_down_to_what_is_singular(
    seed: int, size: int, apart: float
) -> None:
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.standard_normal((size, size)))[0]
    units = 10.0 ** random.uniform(-3.0, 3.0, size)
    information = (turn * np.logspace(0.0, -apart, size)) @ turn.T * np.outer(units, units)
    information = (information + information.T) / 2.0
    covariance = covariance_of(information)
    if covariance is None:
        assert apart > 10.0
        return
    TypeAdapter(LensCovariance).validate_python(covariance.tolist())
    np.testing.assert_array_equal(covariance, covariance.T)
    alike = covariance @ information
    assert np.abs(alike / np.outer(1.0 / units, units) - np.eye(size)).max() < 10.0 ** (apart - 13)
    assert covariance_of(np.zeros((size, size))) is None


def test_an_image_with_wrong_corners_is_left_out_by_name() -> None:
    all_views = views(9, 0.05)
    wrong = all_views["view 3"]
    rolled = np.roll(wrong.corners, 1, axis=0)
    all_views["view 3"] = DetectedBoard(wrong.points, rolled)
    found = calibrate_from_views(all_views, SIZE)
    assert list(found.unused) == ["view 3"]
    assert "px" in found.unused["view 3"]
    assert np.abs(found.matrix - MATRIX).max() < 4.0


def test_rendered_pictures_are_calibrated_and_useless_ones_named() -> None:
    pictures = [(f"{k}.png", board_picture(pose)) for k, pose in enumerate(board_poses(8))]
    pictures.append(("wall.png", np.full((SIZE[1], SIZE[0]), 128, np.uint8)))
    found = fit_camera(pictures, BOARD)
    check_values(found, pixels=4.0)
    assert found.unused == {"wall.png": "no board was found in it"}
    assert set(found.view_errors) == {f"{k}.png" for k in range(8)}
    assert found.error < 0.2


def test_markers_that_are_seen_twice_are_not_counted_as_images() -> None:
    """Such as of a rig's tag with a number of the board, visible in every image."""
    seen = {name: replace(view, twice=(7,)) for name, view in views(6, 0.05).items()}
    found = calibrate_from_views(seen, SIZE)
    quality = judge_camera(found, 1e-3)
    assert "6 images used, 0 not" in camera_page(found, quality, "camera", "2026-01-02")
    unused = camera_result(found, quality, "camera", date(2026, 1, 2)).unused
    assert unused == {f"{name}, 7": "is detected more than once" for name in seen}


def test_too_few_pictures_are_refused() -> None:
    wall = np.full((SIZE[1], SIZE[0]), 128, np.uint8)
    with pytest.raises(BadInput, match="in 0 of 2 images"):
        fit_camera([("a", wall), ("b", wall)], BOARD)


def test_pictures_of_two_sizes_are_refused_by_name() -> None:
    with pytest.raises(BadInput, match="64 x 48 px, others 640 x 480"):
        fit_camera(
            [("a", np.zeros((480, 640), np.uint8)), ("b", np.zeros((48, 64), np.uint8))], BOARD
        )


def test_the_result_file_is_dated_and_has_the_keys_of_the_rig_file(tmp_path: Path) -> None:
    found = calibrate_from_views(views(8, 0.05), SIZE)
    result = camera_result(found, judge_camera(found, 1e-3), "front", date(2026, 3, 1))
    path = write_result(tmp_path, result)
    assert path.name == "calibration_camera_front_2026-03-01.yaml"
    assert load_result(path) == result.sealed()
    read = yaml.safe_load(path.read_text())
    assert read["date"] == "2026-03-01"
    assert read["fx_px"] == pytest.approx(found.matrix[0, 0])
    assert len(read["distortion"]) == 5
    assert read["data_sha256"] == found.data_hash
    low, high = read["intervals"]["fx_px"]
    assert low < read["fx_px"] < high
    assert read["verdict"].startswith("not good enough: 8 images show the board")
    assert read["view_errors_px"].keys() == {f"view {k}" for k in range(8)}


def test_other_data_have_another_hash() -> None:
    first = calibrate_from_views(views(8, 0.0), SIZE, lens="five")
    second = calibrate_from_views(views(8, 0.01), SIZE, lens="five")
    assert first.data_hash != second.data_hash
    assert first.data_hash.startswith("sha256:")


def test_a_bowed_board_is_named_with_its_bow() -> None:
    """200 mm by 125 mm, with its centre 1 mm above its corners."""
    flat = views(14, 0.05)
    poses = calibrate_from_views(flat, SIZE).boards
    bent = {}
    for name, seen in flat.items():
        middle = seen.points.mean(axis=0)
        share = (seen.points - middle)[:, :2] / (np.ptp(seen.points[:, :2], axis=0) / 2.0)
        high = seen.points + np.outer(1e-3 * (1.0 - 0.5 * (share**2).sum(axis=1)), [0, 0, 1.0])
        turn = cv2.Rodrigues(poses[name].rotation)[0]
        there = cv2.projectPoints(high, turn, poses[name].position, MATRIX, DISTORTION)[0]
        noise = np.random.default_rng(len(bent)).normal(scale=0.05, size=seen.corners.shape)
        bent[name] = DetectedBoard(seen.points, there.reshape(-1, 2) + noise)
    quality = judge_camera(calibrate_from_views(bent, SIZE), 1e-3)
    assert quality.bow == pytest.approx(1e-3, rel=0.3)
    assert any("the board is not flat" in reason for reason in quality.verdict.reasons)
    assert any("glass" in step for step in quality.verdict.next_steps)
    straight = judge_camera(calibrate_from_views(flat, SIZE), 1e-3)
    assert not any("flat" in reason for reason in straight.verdict.reasons)


def test_no_advice_contradicts_what_is_there_already() -> None:
    """Neither more images if there are enough, nor 90 % coverage if it is 90 %."""
    many = views(42, 2.0)
    verdict = judge_camera(calibrate_from_views(many, SIZE, lens="five"), 1e-4).verdict
    assert not verdict.good
    assert not any("40 are good" in step for step in verdict.next_steps)
    few = judge_camera(calibrate_from_views(views(13, 2.0), SIZE, lens="five"), 1e-4).verdict
    assert "take more images: 40 are recommended" in few.next_steps
    assert not is_below(0.896, 0.9)
    assert is_below(0.894, 0.9)
