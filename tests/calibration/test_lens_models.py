"""Lens models: fitted with uncertainty, selected by held-out images, used consistently."""

from __future__ import annotations

import math
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from calibration.intrinsics.calibrate import CameraCalibration, calibrate_from_views
from calibration.intrinsics.exchange import FORMATS, write_rig_with_camera
from calibration.intrinsics.lens import LENSES, RADIAL, LensFit, error_of, fit_lens, radial_share
from calibration.intrinsics.quality import (
    _slopes,
    _without_rotation,
    image_grid,
    judge_camera,
)
from calibration.intrinsics.result import with_camera
from calibration.targets.boards import Chessboard, DetectedBoard
from model.cameras import camera_from
from model.errors import BadInput
from model.files.camera_file import CameraDocument
from model.pose import Pose, matrix_from_rotation_vector, read_only
from model.rig import Camera, Rig, load_rig, rig_from_document
from model.scene import load_scene
from simulation.camera.camera import SyntheticCamera
from tests.calibration.imports import imported_camera
from tests.cli.program import call, one_message
from tracking.camera_model import (
    WIDEST,
    distort_pixels,
    pixels_of,
    project,
    ray_slopes,
    rays_of,
    undistort_pixels,
)
from tracking.measurement import PoseMeasurement
from tracking.shared_errors import CameraMoved
from tracking.tracker import Tracker

CONFIGS = Path(__file__).parents[2] / "configs"
BOARD = Chessboard(9, 6, 0.025)
SIZE = (960, 600)
TRUTH = {
    "five": (600.0, [-0.12, 0.05, 0.0008, -0.0006, 0.01]),
    "rational": (330.0, [0.42, 0.01, 0.001, -0.001, 0.0, 0.73, 0.07, 0.0]),
    "fisheye": (300.0, [0.03, -0.02, 0.015, -0.005]),
}


def matrix_of(focal: float) -> np.ndarray:
    return np.array([[focal, 0.0, 470.0], [0.0, focal * 1.002, 305.0], [0.0, 0.0, 1.0]])


def views(
    name: str, count: int = 30, noise: float = 0.08, seed: int = 3
) -> dict[str, DetectedBoard]:
    """A board all over the image, also near its corners."""
    rng, found = np.random.default_rng(seed), {}
    focal, lens = TRUTH[name]
    middle, tries = BOARD.points().mean(axis=0), 0
    while len(found) < count and (tries := tries + 1) < 5000:
        turn = matrix_from_rotation_vector(rng.uniform(-0.6, 0.6, 3))
        away = rng.uniform(0.15, 0.35) * focal / 300.0
        side = np.array([*(rng.uniform(-1.6, 1.6, 2) * [0.5, 0.32] * SIZE[0] / focal), 1.0])
        pose = Pose(side * away - turn @ middle, turn)
        points = pose.apply(BOARD.points())
        if points[:, 2].min() < 0.03:
            continue
        corners = project(LENSES[name].kind, matrix_of(focal), np.array(lens), points)
        if (corners < 2.0).any() or (corners > np.array(SIZE) - 2.0).any():
            continue
        noisy = corners + noise * rng.standard_normal(corners.shape)
        found[f"{len(found)}"] = DetectedBoard(BOARD.points(), noisy)
    assert len(found) == count
    return found


@cache
def chosen(name: str) -> CameraCalibration:
    """The automatically selected model."""
    return calibrate_from_views(views(name, 14), SIZE)


@pytest.mark.parametrize("name", TRUTH)
def test_a_lens_comes_back_within_its_intervals(name: str) -> None:
    """At least 90 % of the parameters in three trials are within their 95 % intervals."""
    focal, lens = TRUTH[name]
    m = matrix_of(focal)
    truth = np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *lens])
    inside = []
    for seed in range(3):
        found = calibrate_from_views(views(name, 20, seed=seed), SIZE, lens=name)
        assert found.error == pytest.approx(0.08 * math.sqrt(2.0), rel=0.1)
        assert list(found.intervals) == list(LENSES[name].names)
        inside.append(np.abs([i.value for i in found.intervals.values()] - truth)
                      <= found.uncertainty.half_widths)  # fmt: skip
    assert np.mean(inside) >= 0.85


@pytest.mark.parametrize(
    ("true", "accepted"),
    [("five", {"five"}), ("rational", {"rational"}), ("fisheye", {"fisheye", "rational"})],
)
def test_the_model_is_chosen_by_pictures_held_out(true: str, accepted: set[str]) -> None:
    found = chosen(true)
    assert found.lens.name in accepted
    assert found.error < 0.13
    fit = LensFit(found.lens, found.matrix, found.distortion, {}, {})
    others = [error_of(fit, seen) for seen in views(true, seed=9).values()]
    assert np.sqrt(np.mean(others)) < 0.13


@pytest.mark.parametrize("true", ["rational", "fisheye"])
def test_the_advice_names_the_lens_where_errors_run_along_the_radius(true: str) -> None:
    result = judge_camera(calibrate_from_views(views(true), SIZE, lens="five"), 1e-3)
    assert result.radial > 0.02
    assert any("the lens model" in reason for reason in result.verdict.reasons)
    assert any("--lens" in step and "fisheye" in step for step in result.verdict.next_steps)
    right = judge_camera(chosen(true), 1e-3)
    assert not any("lens" in reason for reason in right.verdict.reasons)


def test_the_radial_share_is_nothing_for_noise_and_all_for_a_pure_pattern() -> None:
    rng = np.random.default_rng(1)
    corners = rng.uniform(0.0, 600.0, (2000, 2))
    m = matrix_of(300.0)
    assert radial_share(corners, rng.normal(size=(2000, 2)), m) < 0.015
    away = corners - m[:2, 2]
    pattern = away * (np.linalg.norm(away, axis=1, keepdims=True) / 300.0 - 0.5)
    assert radial_share(corners, pattern, m) > 0.9


def test_a_few_bad_pictures_do_not_hide_a_radial_pattern() -> None:
    """As real sets have: a shaken board, equally bad for every model."""
    rng = np.random.default_rng(1)
    corners = rng.uniform(0.0, 600.0, (2000, 2))
    m = matrix_of(300.0)
    away = corners - m[:2, 2]
    errors = 0.3 * away * (np.linalg.norm(away, axis=1, keepdims=True) / 300.0 - 0.5) / 150.0
    errors += rng.normal(0.0, 0.08, errors.shape)
    shaken = np.arange(2000) < 200
    errors[shaken] += rng.normal(0.0, 15.0, (200, 2))
    assert radial_share(corners, errors, m) > 2.0 * RADIAL


def apart_without_rotation(found: CameraCalibration, true: str) -> float:
    """RMS distance of points 1 m away by both cameras, rotated for the best agreement, [m]."""
    focal, lens = TRUTH[true]
    pixels = image_grid(SIZE)
    kind = LENSES[true].kind
    rays = [
        np.column_stack([rays_of(*model, pixels), np.ones(len(pixels))])
        for model in (
            (kind, matrix_of(focal), np.array(lens)),
            (found.lens.kind, found.matrix, found.distortion),
        )
    ]
    units = [part / np.linalg.norm(part, axis=1, keepdims=True) for part in rays]
    turn = Rotation.align_vectors(*units)[0].as_matrix()
    rotated = rays[1] @ turn.T
    gaps = rotated[:, :2] / rotated[:, 2:] - rays[0][:, :2]
    return float(np.sqrt(np.mean(np.sum(gaps**2, axis=1))))


def test_a_clean_camera_is_good_and_the_truth_within_what_is_stated() -> None:
    """The rotation that the extrinsics compensate does not count: cx alone is 0.5 mm off."""
    good, inside, ratios = 0, 0, []
    for seed in range(12):
        found = calibrate_from_views(views("five", 40, 0.05, seed), SIZE)
        quality = judge_camera(found, 1e-3, 1.0)
        off = apart_without_rotation(found, "five")
        ratios.append(off / quality.verdict.error)
        good += quality.verdict.good
        inside += ratios[-1] < 1.0
    assert good == 12
    assert inside >= 11
    assert np.median(ratios) > 0.15  # and the intervals are not too wide


def test_a_rotation_of_the_camera_is_no_error_of_it() -> None:
    found = calibrate_from_views(views("fisheye"), SIZE, lens="fisheye")
    slopes, turns = _slopes(found, image_grid(SIZE))
    assert np.abs(_without_rotation(turns, turns)).max() < 1e-9 * np.abs(turns).max()
    freed = _without_rotation(slopes, turns)
    assert (np.linalg.norm(freed, axis=(0, 1)) <= np.linalg.norm(slopes, axis=(0, 1))).all()
    shift = found.lens.names.index("cx_px")
    assert np.linalg.norm(freed[..., shift]) < 0.6 * np.linalg.norm(slopes[..., shift])


def some_camera(name: str) -> Camera:
    focal, lens = TRUTH[name]
    kind = LENSES[name].kind
    level = Pose.level([0.0, 0.0, 0.0])
    return Camera("c", *SIZE, matrix_of(focal), read_only(lens), level, 10.0, kind)


@pytest.mark.parametrize("name", TRUTH)
def test_pixels_come_back_from_ideal_ones(name: str) -> None:
    camera = some_camera(name)
    across = np.stack(np.meshgrid(np.linspace(120, 820, 9), np.linspace(60, 540, 7)), axis=-1)
    ideal = undistort_pixels(camera, across)
    np.testing.assert_allclose(distort_pixels(camera, ideal), across, atol=1e-5)


def test_rays_beside_and_behind_a_fisheye_are_put_at_its_rim() -> None:
    """Not on the other side of the image, where OpenCV's iteration puts them."""
    camera = some_camera("fisheye")
    corners = np.array([[5.0, 5.0], [955.0, 5.0], [5.0, 595.0], [955.0, 595.0]])
    ideal = undistort_pixels(camera, corners) - camera.matrix[:2, 2]
    assert (np.sign(ideal) == np.sign(corners - camera.matrix[:2, 2])).all()
    reach = np.linalg.norm(ideal / [camera.matrix[0, 0], camera.matrix[1, 1]], axis=1)
    np.testing.assert_allclose(np.arctan(reach), WIDEST, atol=1e-3)


TURNING = [0.3660, 1.1433, -3.0081, -3.1187]
"""Coefficients of a camera of 640 x 480 px by Kalibr: the radius decreases from 37° on."""
GRID = np.stack(np.meshgrid(np.linspace(0, 639, 21), np.linspace(0, 479, 16)), axis=-1)


def small_fisheye(lens: list[float]) -> Camera:
    m = np.array([[633.0, 0.0, 320.0], [0.0, 633.0, 240.0], [0.0, 0.0, 1.0]])
    return Camera("c", 640, 480, m, read_only(lens), Pose.level([0.0, 0.0, 0.0]), 10.0, "fisheye")


@given(st.tuples(*(st.floats(-limit, limit) for limit in (1, 2, 4, 4))).map(list))
@example(TURNING)
@settings(max_examples=100, deadline=None)
def test_all_pixels_of_a_fisheye_come_back_wherever_its_radius_ends(lens: list[float]) -> None:
    """The radius increases over the image, and does beyond it whatever it likes."""
    angles = np.linspace(0.0, 1.49, 1000)
    radii = angles * (1.0 + sum(k * angles ** (2 * n + 2) for n, k in enumerate(lens)))
    slopes = np.diff(radii) / np.diff(angles)
    to_corner = np.argmax(radii > np.hypot(320, 240) / 633.0)
    assume(to_corner and (slopes[: to_corner + 1] > 0.05).all())
    camera = small_fisheye(lens)
    ideal = undistort_pixels(camera, GRID)
    np.testing.assert_allclose(distort_pixels(camera, ideal), GRID, atol=1e-6)
    assert ((ideal - [320, 240]) * (GRID - [320, 240]) >= 0.0).all()


def test_pixels_where_no_ray_of_a_fisheye_arrives_are_put_at_its_rim() -> None:
    camera = small_fisheye(TURNING)
    beyond = np.array([320.0, 240.0]) + 633.0 * np.array([[0.7, 0.0], [0.0, 2.0], [-3.0, 0.0]])
    away = undistort_pixels(camera, beyond) - [320.0, 240.0]
    angles = np.arctan(np.linalg.norm(away, axis=1) / 633.0)
    np.testing.assert_allclose(angles, 0.6501, atol=2e-3)
    assert (away * (beyond - [320.0, 240.0]) >= 0.0).all()
    assert np.isfinite(ray_slopes(camera, away / 633.0)).all()


@given(
    angle=st.floats(0.05, 1.3),
    around=st.floats(0.0, 6.28),
    lens=st.lists(st.floats(-0.02, 0.02), min_size=4, max_size=4),
)
@settings(max_examples=60, deadline=None)
def test_the_fisheye_is_kannala_and_brandt(angle: float, around: float, lens: list[float]) -> None:
    """θ (1 + k₁θ² + k₂θ⁴ + k₃θ⁶ + k₄θ⁸) is the radius, written out here."""
    point = np.array([[math.sin(angle) * math.cos(around), math.sin(angle) * math.sin(around),
                       math.cos(angle)]])  # fmt: skip
    m = matrix_of(300.0)
    seen = project("fisheye", m, np.array(lens), point)[0]
    radius = angle * (1.0 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(lens)))
    expected = radius * np.array([math.cos(around), math.sin(around)])
    np.testing.assert_allclose((seen - m[:2, 2]) / [m[0, 0], m[1, 1]], expected, atol=1e-9)


@given(
    angle=st.floats(0.0, 2.6),
    around=st.floats(0.0, 6.28),
    lens=st.lists(st.floats(-0.01, 0.01), min_size=4, max_size=4),
)
@example(angle=0.0, around=0.0, lens=[0.01] * 4)
@example(angle=math.pi / 2.0, around=1.0, lens=[0.01] * 4)
@settings(max_examples=40, deadline=None)
def test_a_fisheye_is_fitted_by_the_angle_also_behind_the_image_plane(
    angle: float, around: float, lens: list[float]
) -> None:
    """Pixels by the radius written out here; derivatives by finite differences."""
    toward = np.array([math.sin(angle) * math.cos(around), math.sin(angle) * math.sin(around),
                       math.cos(angle)])  # fmt: skip
    turn, shift = np.array([0.3, -0.2, 0.5]), np.array([0.02, -0.01, 0.03])
    rotation = matrix_from_rotation_vector(turn)
    point = rotation.T @ (0.4 * toward - shift)
    behind = rotation.T @ (np.array([0.1, 0.05, -0.02]) - shift)  # so that OpenCV's is not used
    points = np.array([point, behind])

    def seen(x: np.ndarray) -> np.ndarray:
        matrix = np.array([[x[0], 0.0, x[2]], [0.0, x[1], x[3]], [0.0, 0.0, 1.0]])
        return LENSES["fisheye"].slopes(points, x[8:11], x[11:], matrix, x[4:8])[0]

    x = np.array([300.0, 301.0, 640.0, 400.0, *lens, *turn, *shift])
    radius = angle * (1.0 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(lens)))
    expected = radius * np.array([300.0 * math.cos(around), 301.0 * math.sin(around)])
    np.testing.assert_allclose(seen(x)[0] - [640.0, 400.0], expected, atol=1e-6)
    matrix = np.array([[300.0, 0.0, 640.0], [0.0, 301.0, 400.0], [0.0, 0.0, 1.0]])
    _, by_pose, by_camera = LENSES["fisheye"].slopes(points, turn, shift, matrix, np.array(lens))
    by = np.column_stack([(seen(x + d) - seen(x - d)).ravel() / 2e-6 for d in 1e-6 * np.eye(14)])
    np.testing.assert_allclose(np.hstack([by_camera, by_pose]), by, rtol=1e-4, atol=2e-3)


WIDE = np.array([300.0, 301.0, 640.0, 400.0, 0.01, -0.005, 0.002, -0.0005])
"""A fisheye of 200° over 1280 x 800 px."""


def wide_views(count: int, noise: float, seed: int) -> dict[str, DetectedBoard]:
    """A board up to 100° off the axis, projected by Kannala and Brandt's formula."""
    rng, found = np.random.default_rng(seed), {}
    while len(found) < count:
        off, around = rng.uniform(0.0, 1.6), rng.uniform(0.0, 2.0 * math.pi)
        facing = Rotation.from_rotvec([0.0, 0.0, around]) * Rotation.from_rotvec([0.0, off, 0.0])
        tilt = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3))
        points = (facing * tilt).apply(BOARD.points() - BOARD.points().mean(axis=0))
        points += rng.uniform(0.25, 0.5) * facing.apply([0.0, 0.0, 1.0])
        across = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(across, points[:, 2])
        radius = angle * (1.0 + (angle[:, None] ** [2, 4, 6, 8]) @ WIDE[4:])
        corners = (radius / across)[:, None] * points[:, :2] * WIDE[:2] + WIDE[2:4]
        corners += noise * rng.standard_normal(corners.shape)
        shown = ((corners > 0.0) & (corners < [1279.0, 799.0])).all(axis=1) & (angle < 1.75)
        if shown.sum() >= 8:
            found[f"{len(found)}"] = DetectedBoard(BOARD.points()[shown], corners[shown])
    return found


@pytest.mark.parametrize(("lens", "count", "seed"), [("fisheye", 20, 8), ("auto", 8, 5)])
def test_corners_more_than_90_degrees_off_the_axis_do_not_bend_the_lens(
    lens: str, count: int, seed: int
) -> None:
    """OpenCV projects such a corner to the opposite side of the image."""
    found = calibrate_from_views(wide_views(count, 0.1, seed), (1280, 800), lens=lens)
    assert found.lens.name == "fisheye"
    assert found.unused == {}
    assert found.error == pytest.approx(0.1 * math.sqrt(2.0), rel=0.1)
    off = np.array([interval.value for interval in found.intervals.values()]) - WIDE
    assert np.sum(np.abs(off) <= found.uncertainty.half_widths) >= 7


@pytest.mark.parametrize("name", ["rational", "fisheye"])
def test_a_synthetic_camera_of_any_lens_is_tracked_to_a_millimetre(name: str) -> None:
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    plain = rig.cameras[0]
    lens = {
        "rational": ("pinhole", [0.35, 0.05, 0.0005, -0.0004, 0.0, 0.55, 0.06, 0.0]),
        "fisheye": ("fisheye", [0.03, -0.02, 0.015, -0.005]),
    }[name]
    camera = replace(plain, lens=lens[0], distortion=read_only(lens[1]))
    bent = replace(rig, cameras=(camera, *rig.cameras[1:]))
    truth = bent.home
    picture = SyntheticCamera(bent, load_scene(CONFIGS / "environment_1.yaml"), camera, 1).render(
        truth, 0
    )
    found = Tracker(bent, camera).observe(picture, 0.0)
    assert isinstance(found, PoseMeasurement)
    assert np.linalg.norm(found.pose.position - truth.position) < 1e-3
    without_lens = Tracker(rig, plain)
    with pytest.raises(CameraMoved):
        list(without_lens.observe(picture, 0.1 * k) for k in range(2))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


def with_lens(rig: Rig, kind: str, lens: list[float]) -> CameraDocument:
    plain = rig.document.cameras[0].model_dump(mode="json")
    return CameraDocument.model_validate(plain | {"lens": kind, "distortion": lens, "cx_px": 651.3})


UNKNOWN_THERE = {("kalibr", "five"), ("kalibr", "rational"), ("mrcal", "fisheye")}
"""Lens models that a program does not support."""


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("name", TRUTH)
def test_a_camera_comes_back_from_the_files_of_others(rig, tmp_path, form, name) -> None:
    own = with_lens(rig, LENSES[name].kind, TRUTH[name][1])
    if (form, name) in UNKNOWN_THERE:
        with pytest.raises(BadInput, match=r"has only|not Kannala"):
            FORMATS[form](own)
        return
    file = tmp_path / "camera.yaml"
    file.write_text(FORMATS[form](own))
    plain = rig.document.cameras[0]
    errors = {
        "lens_covariance": np.eye(4 + len(plain.distortion)).tolist(),
        "pose_by_lens": np.zeros((6, 4 + len(plain.distortion))).tolist(),
    }
    sure = rig_from_document(with_camera(rig.document, plain.model_copy(update=errors)))
    assert imported_camera(file, sure) == imported_camera(file, rig), "files state no errors"
    back = imported_camera(file, rig)
    assert back.lens == own.lens
    assert back.distortion == pytest.approx(own.distortion, abs=1e-15)
    assert (back.fx_px, back.cx_px, back.width_px) == (own.fx_px, 651.3, own.width_px)
    assert back.world_from_camera == plain.world_from_camera


KALIBR = """
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  distortion_model: radtan
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.0137, 0.0207, -0.0127, 0.0025]
  distortion_model: equidistant
  intrinsics: [190.97, 190.98, 254.93, 256.89]
  resolution: [512, 512]
  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""


def test_a_camera_of_a_kalibr_chain_is_read_by_its_entry(rig, tmp_path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(KALIBR)
    first, second = (imported_camera(file, rig, entry) for entry in ("cam0", "cam1"))
    assert (first.lens, second.lens) == ("pinhole", "fisheye")
    assert first.distortion == [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
    assert (first.fx_px, first.fy_px, first.cx_px, first.cy_px) == (
        461.629, 460.152, 362.680, 246.049)  # fmt: skip
    assert (second.width_px, second.height_px) == (512, 512)
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig)
    assert "cam0, cam1; choose one with --entry" in str(caught.value.why)
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig, "cam7")
    assert "not 'cam7'" in str(caught.value.why)


MESSAGE = """header: {stamp: {sec: 1, nanosec: 2}, frame_id: camera}
height: 720
width: 1280
distortion_model: plumb_bob
D: [-0.36, 0.11, 0.001, 0.0005, 0.0]
K: [900.0, 0.0, 640.5, 0.0, 901.0, 359.5, 0.0, 0.0, 1.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
"""


ROS_2 = MESSAGE.replace("D:", "d:").replace("K:", "k:") + "---\n"


WHOLE = MESSAGE.replace("height: 0, width: 0", "height: 720, width: 1280")


@pytest.mark.parametrize("text", [MESSAGE, ROS_2, WHOLE])
def test_a_message_of_ros_as_it_is_printed_can_be_read(rig, tmp_path, text: str) -> None:
    file = tmp_path / "message.yaml"
    file.write_text(text)
    found = imported_camera(file, rig)
    assert (found.width_px, found.height_px, found.fx_px, found.cy_px) == (1280, 720, 900.0, 359.5)
    assert found.distortion == [-0.36, 0.11, 0.001, 0.0005, 0.0]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("binning_x: 0", "binning_x: 2"),
        ("x_offset: 0", "x_offset: 8"),
        ("height: 0, width: 0", "height: 720, width: 640"),
        ("height: 0, width: 0", "height: 480, width: 1280"),
    ],
)
def test_a_message_of_ros_for_a_part_of_the_pixels_is_refused(rig, tmp_path, old, new) -> None:
    file = tmp_path / "message.yaml"
    file.write_text(MESSAGE.replace(old, new, 1))
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig)
    assert "binned, or a part" in str(caught.value.why)


def test_kalibr_models_that_rig_files_lack_are_named(rig, tmp_path) -> None:
    file = tmp_path / "camchain.yaml"
    file.write_text(KALIBR.replace("camera_model: pinhole", "camera_model: ds", 1))
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig, "cam0")
    assert "cam0 is ds-radtan" in str(caught.value.why)


def test_the_models_named_for_kalibr_are_those_that_are_read(rig, tmp_path) -> None:
    """Its option is `pinhole-equi`, its files say `equidistant`."""
    file = tmp_path / "camchain.yaml"
    text = KALIBR.replace("distortion_model: radtan", "distortion_model: MODEL", 1)
    file.write_text(text.replace("MODEL", "equi"))
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig, "cam0")
    why = str(caught.value.why)
    assert why == "cam0 is pinhole-equi; pinhole with radtan, equidistant, none can be read"
    file.write_text(text.replace("MODEL", "equidistant"))
    assert imported_camera(file, rig, "cam0").lens == "fisheye"


MRCAL = """# generated on 2024-01-01 with mrcal-calibrate-cameras
# 'lensmodel': 'LENSMODEL_SPLINED'
{
    'lensmodel':  'LENSMODEL_OPENCV8',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1761.1, 1761.2, 1965.8, 1087.5, 0.1, 0.2, 0.003, 0.004, 0.5, 0.6, 0.7, 0.8,],
    'valid_intrinsics_region': [ [ 1.0, 2.0 ], [ 3.0, 4.0 ], ],
    # extrinsics are rt_fromref
    'extrinsics': [ 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,],
    'imagersize': [ 3904, 2196,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'abc',
}
"""


def test_a_camera_of_mrcal_is_read_and_a_splined_one_refused(rig, tmp_path) -> None:
    file = tmp_path / "camera-0.cameramodel"
    file.write_text(MRCAL)
    found = imported_camera(file, rig)
    assert found.distortion == [0.1, 0.2, 0.003, 0.004, 0.5, 0.6, 0.7, 0.8]
    assert (found.fx_px, found.cy_px, found.width_px, found.height_px) == (
        1761.1,
        1087.5,
        3904,
        2196,
    )
    file.write_text(MRCAL.replace("LENSMODEL_OPENCV8", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3"))
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig)
    assert "mrcal-convert-lensmodel" in str(caught.value.why)


@pytest.mark.skipif(not Path("/usr/bin/mrcal-to-cahvor").exists(), reason="needs Debian's mrcal")
def test_mrcal_itself_reads_what_is_written_and_projects_alike(rig, tmp_path) -> None:
    """The extrinsics too: a point of the world is seen by both in the same pixel."""
    file = tmp_path / "camera.cameramodel"
    document = with_lens(rig, "pinhole", TRUTH["rational"][1])
    file.write_text(FORMATS["mrcal"](document))
    camera = camera_from(document)
    point = camera.world_from_camera.apply(np.array([[0.1, -0.2, 1.0]]))
    code = (
        "import sys, mrcal, numpy as np; m = mrcal.cameramodel(sys.argv[1]);"
        "p = mrcal.transform_point_rt(m.extrinsics_rt_fromref(),"
        " np.array([float(x) for x in sys.argv[2:]]));"
        "print(*mrcal.project(p, *m.intrinsics()))"
    )
    result = subprocess.run(
        ["/usr/bin/python3", "-c", code, str(file), *map(str, point[0])],
        capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    theirs = [float(x) for x in result.stdout.split()]
    np.testing.assert_allclose(
        theirs, pixels_of(camera, np.array([[0.1, -0.2, 1.0]]))[0], atol=1e-6
    )


def test_opencv_itself_reads_what_is_written(rig, tmp_path) -> None:
    own = with_lens(rig, "fisheye", TRUTH["fisheye"][1])
    file = tmp_path / "camera.yml"
    file.write_text(FORMATS["opencv"](own))
    storage = cv2.FileStorage(str(file), cv2.FileStorage_READ)
    np.testing.assert_allclose(storage.getNode("camera_matrix").mat()[0, 2], 651.3)
    assert storage.getNode("distortion_coefficients").mat().size == 4


def test_opencvs_xml_gives_the_same_camera_as_its_yaml(rig, tmp_path) -> None:
    own = with_lens(rig, "fisheye", TRUTH["fisheye"][1])
    text = FORMATS["opencv"](own)
    given = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    file = tmp_path / "camera.xml"
    xml = cv2.FileStorage(str(file), cv2.FileStorage_WRITE)
    for name in ("image_width", "image_height", "fisheye_model"):
        xml.write(name, int(given.getNode(name).real()))
    for name in ("camera_matrix", "distortion_coefficients"):
        xml.write(name, given.getNode(name).mat())
    xml.release()
    found = imported_camera(file, rig)
    assert found == own.model_copy(update={"error_mm": None})


def test_a_damaged_file_of_opencv_does_not_end_the_program(rig, tmp_path) -> None:
    """A matrix without ``cols`` makes OpenCV's own reader write past its memory."""
    text = FORMATS["opencv"](with_lens(rig, "pinhole", [0.01] * 4))
    file = tmp_path / "camera.yml"
    file.write_text(text.replace("   cols: 1\n", ""))
    assert imported_camera(file, rig).distortion == [0.01] * 4
    for number in (".nan", "1e400", "9" * 399, "[", "!!opencv-matrix"):
        file.write_text(text.replace("image_width: 1280", f"image_width: {number}"))
        with pytest.raises(BadInput):
            imported_camera(file, rig)


@pytest.mark.parametrize(
    "text",
    ["", "a: 1", "%YAML:1.0\n---\nimage_width: 640\n", "%YAML:1.0\n---\n{[", "- 1",
     "cam0: 3", "{'lensmodel': ['a'], 'intrinsics': [1, 2, 3, 4], 'imagersize': [1, 2]}",
     "{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1%s, 2, 3, 4], 'imagersize': [1, 2]}"
     % ("0" * 400), "%YAML:1.0\n- 3\n", "<?xml version='1.0'?><a>",
     "<?xml version='1.0'?><opencv_storage>", "<?xml version='1.0'?><a/>",
     "<?xml version='1.0'?><!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>",
     "<?xml version='1.0'?><a><image_width/></a>",
     "cam0: {camera_model: pinhole, distortion_model: [a], distortion_coeffs: [],"
     " intrinsics: [1, 2, 3, 4], resolution: [9, 9]}",
     "%YAML:1.0\na: !!bool x\n", "%YAML:1.0\na: !!timestamp x\n",
     "%YAML:1.0\na: !!int ''\n", "%YAML:1.0\na: &a [*a]\nk: *a\n",
     "%YAML:1.0\nwidth: 9\nheight: 9\nk: &a [*a]\n",
     "cam0: {camera_model: pinhole}", "{'lensmodel': 3}", "{'lensmodel': [",
     "{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': 'abcd', 'imagersize': [1, 2]}",
     "image_width: 640\nimage_height: 480\ndistortion_model: odd\n"
     "camera_matrix: {data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\ndistortion_coefficients: {data: []}"],
)  # fmt: skip
def test_files_that_hold_no_camera_are_refused_in_one_message(rig, tmp_path, text: str) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    with pytest.raises(BadInput):
        imported_camera(file, rig)


def test_a_rig_file_with_an_imported_lens_is_written_and_never_replaced(rig, tmp_path) -> None:
    file, new = tmp_path / "camera.yaml", tmp_path / "new.yaml"
    file.write_text(FORMATS["ros"](with_lens(rig, "fisheye", TRUTH["fisheye"][1])))
    path = CONFIGS / "gachon_8_6.yaml"
    assert call("calibrate", "import", path, file, "-o", new).code == 0
    assert load_rig(new).cameras[0].lens == "fisheye"
    one_message(call("calibrate", "import", path, file, "-o", new), 2, "exists already")
    with pytest.raises(BadInput, match="exists"):
        write_rig_with_camera(new, rig, rig.cameras[0].name, file)


def test_a_camera_of_opencvs_xml_is_read(rig, tmp_path) -> None:
    file = tmp_path / "camera.xml"
    storage = cv2.FileStorage(str(file), cv2.FileStorage_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", matrix_of(500.0))
    storage.write("distortion_coefficients", np.array([[0.1, 0.2, 0.0, 0.0, 0.3]]))
    storage.release()
    found = imported_camera(file, rig)
    assert (found.fx_px, found.cx_px, found.width_px) == (500.0, 470.0, 640)
    assert found.distortion == [0.1, 0.2, 0.0, 0.0, 0.3]


def test_a_damaged_opencv_file_is_read_or_refused_and_never_ends_the_program(rig, tmp_path) -> None:
    """OpenCV's own reader writes past the end of a matrix with fewer rows than numbers."""
    own = with_lens(rig, "pinhole", [0.1, 0.2, 0.0, 0.0, 0.3])
    whole, file = FORMATS["opencv"](own), tmp_path / "camera.yml"
    for old, new in (("rows: 3", "rows: 99999"), ("dt: d", "dt: 9x")):  # not used
        assert old in whole
        file.write_text(whole.replace(old, new))
        found = imported_camera(file, rig)
        assert found == own.model_copy(update={"error_mm": None})
    assert "image_width: 1280\n" in whole
    file.write_text(whole.replace("1280", "9" * 400))
    with pytest.raises(BadInput, match="image_width is not a number of pixels"):
        imported_camera(file, rig)


def test_ros_has_no_thin_prism(rig) -> None:
    with pytest.raises(BadInput, match="12 coefficients"):
        FORMATS["ros"](with_lens(rig, "pinhole", [0.01] * 12))


@pytest.mark.parametrize(("kind", "count"), [("fisheye", 5), ("fisheye", 0), ("pinhole", 3)])
def test_numbers_of_coefficients_that_a_lens_does_not_have_are_refused(rig, kind, count) -> None:
    with pytest.raises(ValidationError, match=f"{kind} lens needs .* it has {count}"):
        with_lens(rig, kind, [0.01] * count)


def test_a_fit_of_a_few_pictures_is_no_choice() -> None:
    few = dict(list(views("fisheye").items())[:6])
    found: CameraCalibration = calibrate_from_views(few, SIZE)
    assert found.lens.name == "five"
    assert fit_lens(LENSES["fisheye"], few, SIZE).finite
