"""Boards in rendered images: points at their true positions, and no false points."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.images import ImageSet
from calibration.intrinsics.calibrate import CameraCalibration, fit_camera
from calibration.procedures import calibrate_camera
from calibration.statistics import EvenSample
from calibration.targets.boards import Charuco, Chessboard, DetectedBoard, is_mirrored
from calibration.targets.grids import CircleGrid, TagGrid
from model.cameras import generic_camera
from model.errors import BadInput
from model.pose import Pose, matrix_from_rotation_vector
from tests.calibration.board_images import (
    DISTORTION,
    MATRIX,
    SIZE,
    picture_of,
    poses_before_the_camera,
    with_noise,
)
from tracking.camera_model import has_rays
from tracking.detection.diagnostics import RowNumbering, row_numbering, tag_offsets

CHARUCO = Charuco(7, 5, 0.040, 0.030, "4X4_50")
TAGS = TagGrid(5, 4, 0.040, 0.012, "tag36h11", first=20)
STRONG = (-0.45, 0.25, 0.0, 0.0, -0.05)
PLAIN = tuple(DISTORTION)
PIXEL = 0.0005


def charuco_print() -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 5), 0.040, 0.030, dictionary)
    return board.generateImage((560, 400), marginSize=0)


def tag_print() -> np.ndarray:
    """White, with the official images of the tags, which are OpenCV's rotated by 180°."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    sheet = np.full((4 * 104 + 40, 5 * 104 + 40), 255, np.uint8)
    for number in range(20):
        row, column = divmod(number, 5)
        tag = cv2.aruco.generateImageMarker(dictionary, 20 + number, 80)[::-1, ::-1]
        top, left = 24 + row * 104, 24 + column * 104
        sheet[top : top + 80, left : left + 80] = tag
    return sheet


KALIBR = TagGrid(5, 4, 0.040, 0.012, "tag36h11", first=20, order="kalibr")
CIRCLES = CircleGrid(7, 5, 0.030, 0.018)
SHIFTED = CircleGrid(4, 9, 0.022, 0.018, asymmetric=True)
MARGIN = 0.025


def kalibr_print(*, by_opencv: bool = False) -> np.ndarray:
    """As kalibr_create_target_pdf draws it: wide borders, black squares at all corners.

    OpenCV draws the tags themselves upside down.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    sheet = np.full((4 * 104 + 76, 5 * 104 + 76), 255, np.uint8)
    for number in range(20):
        row, column = divmod(number, 5)
        tag = cv2.aruco.generateImageMarker(dictionary, 20 + number, 80, borderBits=2)
        top, left = 50 + (3 - row) * 104, 50 + column * 104
        sheet[top : top + 80, left : left + 80] = tag if by_opencv else tag[::-1, ::-1]
    for row in range(5):
        for column in range(6):
            top, left = 26 + row * 104, 26 + column * 104
            sheet[top : top + 24, left : left + 24] = 0
    return sheet


def circle_print(board: CircleGrid) -> np.ndarray:
    """Black circles on white, the first centre `MARGIN` from the left and the top."""
    fine = 4
    centres = (board.points()[:, :2] + MARGIN) / PIXEL
    width, height = (centres.max(axis=0) + MARGIN / PIXEL).astype(int)
    sheet = np.full((height * fine, width * fine), 255, np.uint8)
    for centre in centres:
        middle = tuple(np.round((centre * fine - 0.5) * 16).astype(int).tolist())
        radius = round(board.diameter / 2.0 / PIXEL * fine * 16)
        cv2.circle(sheet, middle, radius, 0, -1, cv2.LINE_8, 4)
    return cv2.resize(sheet, (width, height), interpolation=cv2.INTER_AREA)


@cache
def grid_pictures(board: CircleGrid | TagGrid) -> list[tuple[np.ndarray, Pose]]:
    if isinstance(board, CircleGrid):
        sheet, origin = circle_print(board), np.full(2, MARGIN)
        middle = board.points().mean(axis=0)
    else:
        sheet, origin, middle = kalibr_print(), np.full(2, 0.025), np.array([0.12, 0.1, 0.0])
    poses = poses_before_the_camera(middle, 12, spread=0.03)
    return [(with_noise(picture_of(sheet, PIXEL, origin, p), k), p) for k, p in enumerate(poses)]


def errors_of(seen: DetectedBoard, pose: Pose) -> np.ndarray:
    rotation = cv2.Rodrigues(pose.rotation)[0]
    truth = cv2.projectPoints(seen.points, rotation, pose.position, MATRIX, DISTORTION)[0]
    return seen.corners - truth.reshape(-1, 2)


def off(board, pictures) -> np.ndarray:
    found = ((board.find(image), pose) for image, pose in pictures)
    errors = [errors_of(seen, pose) for seen, pose in found if seen is not None]
    return np.concatenate(errors) if errors else np.zeros((0, 2))


@pytest.mark.parametrize(
    ("board", "points", "limit"), [(CIRCLES, 200, 0.04), (SHIFTED, 200, 0.05), (KALIBR, 500, 0.1)]
)
def test_centres_and_saddles_are_found_where_they_are(board, points: int, limit: float) -> None:
    """Centres of ellipses would be off by 0.1 px and more for oblique circles."""
    errors = np.concatenate([errors_of(seen, pose) for _, pose, seen in found_in(board)])
    assert len(errors) > points
    assert np.sqrt(np.mean(errors**2)) < limit
    assert np.abs(errors.mean(axis=0)).max() < 0.02


def test_tags_drawn_upside_down_are_found_where_they_are() -> None:
    sheet, origin = kalibr_print(by_opencv=True), np.full(2, 0.025)
    poses = poses_before_the_camera(np.array([0.12, 0.1, 0.0]), 4, spread=0.03)
    errors = off(KALIBR, [(picture_of(sheet, PIXEL, origin, pose), pose) for pose in poses])
    assert len(errors) > 200
    assert np.abs(errors).max() < 0.5


def test_small_tags_of_kalibr_are_refined_or_left_out() -> None:
    """The contour's corners are some pixels off, where OpenCV may return them unchanged."""
    poses = poses_before_the_camera(np.array([0.12, 0.1, 0.0]), 12, spread=0.03)
    far = [replace(pose, position=pose.position * 1.8) for pose in poses]
    images = [
        (with_noise(picture_of(kalibr_print(), PIXEL, np.full(2, 0.025), pose), k), pose)
        for k, pose in enumerate(far)
    ]
    errors = np.linalg.norm(off(KALIBR, images), axis=1)
    assert len(errors) > 400
    assert errors.max() < 0.8


@cache
def found_in(board: CircleGrid | TagGrid | Charuco) -> list[tuple[np.ndarray, Pose, DetectedBoard]]:
    """The images in which a board is found; detecting it takes long."""
    rendered = pictures(board) if board in (TAGS, CHARUCO) else grid_pictures(board)
    seen = [(image, pose, board.find(image)) for image, pose in rendered]
    return [(image, pose, one) for image, pose, one in seen if one is not None]


@pytest.mark.parametrize("board", [CIRCLES, SHIFTED, KALIBR, TAGS, CHARUCO])
def test_boards_with_black_and_white_exchanged_are_found(board) -> None:
    shown = found_in(board)[:3]
    assert len(shown) == 3
    inverted = off(board, [(255 - image, pose) for image, pose, _ in shown])
    assert len(inverted) == sum(len(seen.points) for _, _, seen in shown)
    assert np.sqrt(np.mean(inverted**2)) < 0.12


def test_the_order_of_kalibr_is_named_where_the_numbers_contradict_the_rows() -> None:
    shown = [image for image, _, _ in found_in(KALIBR)[:1]]
    rows = replace(KALIBR, order="rows")
    with pytest.raises(BadInput) as caught:
        fit_camera([(f"{k}", image) for k, image in enumerate(shown)], rows)
    assert "rows upward, as Kalibr prints them: try `order='kalibr'`" in caught.value.why


def test_own_tags_in_the_order_of_kalibr_are_rejected() -> None:
    other = replace(TAGS, order="kalibr")
    whole = whole_pictures(TAGS, 61)[:3]
    assert whole
    for _, image in whole:
        assert other.find(image) is None
        assert "`order='rows'`" in other.describe_other(image)


def test_a_charuco_board_of_an_old_opencv_is_named() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = cv2.aruco.CharucoBoard((5, 6), 0.040, 0.030, dictionary)
    drawn.setLegacyPattern(True)
    image = cv2.copyMakeBorder(drawn.generateImage((400, 480)), 40, 40, 40, 40, 0, value=255)
    assert Charuco(5, 6, 0.040, 0.030, "4X4_50", legacy=True).find(image) is not None
    assert "try with `legacy=True`" in Charuco(5, 6, 0.040, 0.030, "4X4_50").describe_other(image)


@cache
def pictures(board: Charuco | TagGrid) -> list[tuple[np.ndarray, Pose]]:
    if isinstance(board, Charuco):
        sheet, origin, middle = charuco_print(), np.zeros(2), np.array([0.14, 0.1, 0.0])
    else:
        sheet, origin, middle = tag_print(), np.full(2, 0.012), np.array([0.12, 0.1, 0.0])
    return [
        (with_noise(picture_of(sheet, PIXEL, origin, pose), k), pose)
        for k, pose in enumerate(poses_before_the_camera(middle, 12))
    ]


@pytest.mark.parametrize(("board", "limit"), [(CHARUCO, 0.03), (TAGS, 0.06)])
def test_points_are_found_where_they_are(board: Charuco | TagGrid, limit: float) -> None:
    errors = np.concatenate([errors_of(seen, pose) for _, pose, seen in found_in(board)])
    assert len(errors) > 120
    assert np.sqrt(np.mean(errors**2)) < limit
    assert np.abs(errors.mean(axis=0)).max() < 0.03  # no bias


@pytest.mark.parametrize(
    ("board", "times", "blur", "limit"),
    [
        (Charuco(8, 6, 0.040, 0.0293, "5X5_100"), 0.7, 0.0, 0.02),
        (Charuco(8, 6, 0.040, 0.0293, "5X5_100"), 1.0, 1.2, 0.03),
        (Charuco(8, 6, 0.040, 0.0293, "5X5_100", legacy=True), 1.5, 0.7, 0.04),
        (Charuco(5, 7, 0.040, 0.020, "6X6_250"), 1.0, 0.7, 0.02),
        (Charuco(7, 5, 0.040, 0.034, "4X4_50"), 1.0, 2.0, 0.03),
        (Charuco(7, 5, 0.040, 0.034, "4X4_50"), 2.0, 0.7, 0.08),
    ],
)
def test_saddles_of_charuco_boards_are_not_biased_by_markers_or_blur(
    board: Charuco, times: float, blur: float, limit: float
) -> None:
    shown = charuco_pictures(board, times, blur, PLAIN)
    errors = off(board, shown)
    assert len(errors) > 20
    assert np.sqrt(np.mean(errors**2)) < limit
    assert np.abs(errors).max() < 8.0 * limit
    assert np.abs(errors.mean(axis=0)).max() < limit / 2.0


@pytest.mark.parametrize(
    ("board", "times", "blur", "lens"),
    [
        (CHARUCO, 1.0, 0.7, PLAIN),
        (CHARUCO, 0.7, 0.7, STRONG),
        (Charuco(8, 6, 0.040, 0.0293, "5X5_100"), 1.0, 1.2, PLAIN),
        (Charuco(8, 6, 0.040, 0.030, "5X5_100"), 2.0, 0.0, PLAIN),
        (Charuco(5, 7, 0.040, 0.020, "6X6_250"), 1.0, 0.7, PLAIN),
    ],
)
@pytest.mark.parametrize("stated", [1.0, 0.85])
def test_the_size_of_markers_is_measured_whatever_is_stated(
    board: Charuco, times: float, blur: float, lens: tuple[float, ...], stated: float
) -> None:
    wrong = replace(board, marker=stated * board.marker)
    seen = [wrong.find(image) for image, _ in charuco_pictures(board, times, blur, lens)]
    sides = np.array([one.marker for one in seen if one is not None]) / board.marker
    measured = sides[np.isfinite(sides)]  # squares whose four corners are seen
    assert len(measured) > 3
    assert np.abs(measured - 1.0).max() < 0.02


@cache
def charuco_pictures(
    board: Charuco, times: float, blur: float, lens: tuple[float, ...] = PLAIN
) -> list[tuple[np.ndarray, Pose]]:
    """A board at several times the usual distance, in blurred images.

    OpenCV's print has markers off the middle of their squares by up to a pixel of 40.
    """
    sheet = board._board.generateImage((40 * board.columns, 40 * board.rows), marginSize=0)
    sheet, middle = np.kron(sheet, np.ones((3, 3), np.uint8)), np.array([0.14, 0.1, 0.0])
    shown = []
    for k, pose in enumerate(poses_before_the_camera(middle, 6, seed=7)):
        far = replace(pose, position=(pose.position + pose.rotation @ middle) * times)
        far = replace(far, position=far.position - pose.rotation @ middle)
        image = picture_of(sheet, board.square / 120, np.zeros(2), far, lens)
        image = cv2.GaussianBlur(image, (0, 0), blur) if blur else image
        shown.append((with_noise(image, k), far))
    return shown


def test_corners_of_charuco_boards_without_a_saddle_are_left_out() -> None:
    """Such as below glare: OpenCV returns where they would be by the markers."""
    image, pose, plain = found_in(CHARUCO)[0]
    x, y = np.round(plain.corners[len(plain.corners) // 2]).astype(int)
    cv2.circle(image := image.copy(), (int(x), int(y)), 6, 255, -1)
    assert len(CHARUCO.find(image).points) == len(plain.points) - 1
    assert np.abs(off(CHARUCO, [(image, pose)])).max() < 0.3


def named_images(board: Charuco | TagGrid) -> dict[str, np.ndarray]:
    return {f"{k}.png": image for k, (image, _) in enumerate(pictures(board))}


@cache
def fitted(board: Charuco | TagGrid) -> CameraCalibration:
    return fit_camera(named_images(board).items(), board)


@pytest.mark.parametrize("board", [CHARUCO, TAGS])
def test_the_camera_comes_back_from_parts_of_a_board(board: Charuco | TagGrid) -> None:
    found = fitted(board)
    off = np.abs(found.matrix - MATRIX)[[0, 1, 0, 1], [0, 1, 2, 2]]
    assert (off < 4.0).all()
    assert found.error < 0.2
    assert found.size == SIZE


@pytest.mark.parametrize("board", [CHARUCO, TAGS])
def test_copies_with_fewer_corners_count_once(board: Charuco | TagGrid) -> None:
    """In the first, a corner is below glare; in the second, half of the board is covered."""
    whole, plain, copies = named_images(board), fitted(board), []
    for k, (name, seen) in enumerate(plain.views.items()):
        image, (x, y) = whole[name].copy(), np.round(seen.corners[0]).astype(int).tolist()
        if k % 2:
            image[:, : int(np.median(seen.corners[:, 0]))] = 255
        else:
            cv2.circle(image, (x, y), 12, 255, -1)
        copies.append((f"copy of {name}", image))
    found = fit_camera([*copies, *whole.items()], board)
    assert found.views.keys() == plain.views.keys()
    np.testing.assert_allclose(
        found.uncertainty.half_widths, plain.uncertainty.half_widths, rtol=1e-6
    )
    reasons = [found.unused[name] for name, _ in copies]
    assert sum(reason.startswith("duplicates ") for reason in reasons) > len(copies) / 2


BARREL = (-0.3, 0.1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("board", "sheet", "margin"),
    [
        (TAGS, tag_print(), 0.012),
        (CIRCLES, circle_print(CIRCLES), MARGIN),
        (CHARUCO, charuco_print(), 0.0),
    ],
)
def test_barrel_distortion_does_not_bias_the_camera(board, sheet, margin: float) -> None:
    """Edges of tags are curved, and centroids of circles are off their centres."""
    origin, middle = np.full(2, margin), np.array([0.11, 0.08, 0.0])
    images = []
    for k, pose in enumerate(poses_before_the_camera(middle, 12, spread=0.09)):
        near = replace(pose, position=pose.position - [0.0, 0.0, 0.1])
        image = picture_of(sheet, PIXEL, origin, near, BARREL)
        images.append((f"{k}.png", with_noise(image, k)))
    found = calibrate_camera(ImageSet(images, len(images)), board, lens="five").found
    for name, truth in (("fx_px", MATRIX[0, 0]), ("fy_px", MATRIX[1, 1])):
        low, high = found.intervals[name].bounds
        assert low < truth < high
        assert high - low < 1.2


@pytest.mark.parametrize("board", [CHARUCO, TAGS])
def test_another_board_and_a_mirrored_one_are_not_found(board: Charuco | TagGrid) -> None:
    image = pictures(board)[0][0]
    other = TAGS if board is CHARUCO else CHARUCO
    assert other.find(image) is None
    flipped = np.ascontiguousarray(image[:, ::-1])
    assert board.find(flipped) is None
    assert is_mirrored(board, flipped)
    with pytest.raises(BadInput) as caught:
        fit_camera([("a", flipped), ("b", flipped)], board)
    assert "mirrored" in caught.value.why


def part_of(board: Charuco | TagGrid) -> np.ndarray:
    """A part of the print, as large families take long to exclude for every tag."""
    part = tag_print()[:232, :232] if board is TAGS else charuco_print()[:160]
    image = np.full((280, 620), 255, np.uint8)
    image[30 : 30 + len(part), 30 : 30 + len(part[0])] = part
    return image


@pytest.mark.parametrize(
    ("board", "wrong", "named"),
    [
        (CHARUCO, Charuco(7, 5, 0.040, 0.030, "6X6_50"), "; 4X4 0, 1"),
        (TAGS, TagGrid(5, 4, 0.040, 0.012, "tag25h9"), "shows tag36h11 20, 21"),
        (TAGS, TagGrid(5, 4, 0.040, 0.012, "tag36h11", first=300), "shows tag36h11 20, 21"),
    ],
)
def test_the_message_names_what_images_show_instead(board, wrong, named: str) -> None:
    image = part_of(board)
    with pytest.raises(BadInput) as caught:
        fit_camera([("a", image), ("b", np.full_like(image, 128))], wrong)
    assert "was found in 0 of 2 images" in caught.value.what
    assert named in caught.value.why
    assert "; a shows " in caught.value.why


def test_the_message_names_what_most_images_show_instead() -> None:
    """One image of another board among six."""
    image, stray = part_of(TAGS), part_of(CHARUCO)
    named = [("0.png", stray), *((f"{k}.png", image) for k in range(1, 7))]
    with pytest.raises(BadInput) as caught:
        fit_camera(named, TagGrid(5, 4, 0.040, 0.012, "tag25h9"))
    found = re.search(r"; (\d+).png and (\d) of 4 others .* show tag36h11", caught.value.why)
    assert found is not None, caught.value.why
    assert found[1] != "0"
    assert found[2] == "3"


def whole_pictures(board: Charuco | TagGrid, least: int) -> list[tuple[str, np.ndarray]]:
    """Named images that show at least so many points of a board."""
    whole = [image for image, _, seen in found_in(board) if len(seen.points) >= least]
    return [(f"{k}.png", image) for k, image in enumerate(whole)]


@pytest.mark.parametrize(
    ("wrong", "advice"),
    [
        ({"first": 21}, "fit a grid of 5 x 4 tags, tag36h11 20 to 39: try `first=20`;"),
        ({"first": 18}, "try `first=20`;"),
        ({"columns": 6}, "fit a grid of 5 x 4 tags, tag36h11 20 to 39: try `columns=5`;"),
        ({"columns": 4}, "try `columns=5`;"),
        ({"columns": 4, "rows": 3, "first": 22}, "try `columns=5` `rows=4` `first=20`;"),
        ({"columns": 6, "order": "kalibr"}, "try `columns=5` `order='rows'`;"),
    ],
)
def test_tags_numbered_otherwise_are_named(wrong: dict[str, int], advice: str) -> None:
    """They would fit a homography by tens of pixels, which no lens model cures."""
    images = whole_pictures(TAGS, 76)[:1]
    assert images
    with pytest.raises(BadInput) as caught:
        fit_camera(images, replace(TAGS, **wrong))
    assert advice in caught.value.why


@given(
    columns=st.integers(2, 8),
    rows=st.integers(2, 6),
    first=st.integers(0, 300),
    order=st.sampled_from(["rows", "kalibr"]),
    turn=st.tuples(*[st.floats(-0.7, 0.7)] * 2, st.floats(-3.1, 3.1)),
    upside_down=st.booleans(),
)
def test_the_numbering_of_a_grid_follows_from_its_tags(
    columns: int, rows: int, first: int, order: str, turn: tuple[float, ...], upside_down: bool
) -> None:
    """Through a lens with barrel distortion, at any tilt and rotation."""
    grid = TagGrid(columns, rows, 0.040, 0.012, "tag36h11", first, order)
    numbers = range(first, first + columns * rows)
    points = grid.points_of(numbers)
    middle = points.mean(axis=0)
    rotation = matrix_from_rotation_vector(np.array(turn))
    seen = (points - middle) @ rotation.T + [0.0, 0.0, 0.8]
    corners = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), MATRIX, np.array(BARREL))[0]
    quads = corners.reshape(-1, 4, 2)
    if upside_down:
        quads = np.roll(quads, 2, axis=1)
    squares = dict(zip(numbers, quads, strict=True))
    assert row_numbering(squares) == RowNumbering(columns, order == "kalibr", first % columns)
    offsets = tag_offsets(squares) * (-1.0 if upside_down else 1.0)
    assert grid._misfit(numbers, offsets) < 0.15
    for wrong in (
        replace(grid, columns=columns + 1),
        replace(grid, first=max(0, first - 1), rows=rows + 1),
        replace(grid, order="rows" if order == "kalibr" else "kalibr"),
    ):
        if wrong != replace(grid, rows=rows + 1):
            assert wrong._misfit(numbers, offsets) > 0.5


@pytest.mark.parametrize("gap_mm", [11.0, 13.0])
def test_a_wrong_gap_between_tags_is_named_with_the_right_one(gap_mm: float) -> None:
    images = whole_pictures(TAGS, 40)
    wrong = replace(TAGS, gap=gap_mm / 1e3)
    verdict = calibrate_camera(ImageSet(images, len(images)), wrong, lens="five").quality.verdict
    found = re.search(
        r"gaps of ([\d.]+) mm between tags of 40 mm, not 1[13] mm", str(verdict.reasons)
    )
    assert found is not None, verdict.reasons
    assert float(found[1]) == pytest.approx(12.0, abs=0.1)
    assert (
        verdict.next_steps[0]
        == "measure the print, and correct --tag-mm or --gap-mm, in Python tag= or gap="
    )


def test_right_sizes_of_a_board_are_not_questioned() -> None:
    for board in (TAGS, CHARUCO):
        images = whole_pictures(board, 16)
        right = calibrate_camera(ImageSet(images, len(images)), board, lens="five").quality
        assert not any("the images fit" in reason for reason in right.verdict.reasons)


@pytest.mark.parametrize("marker_mm", [24.0, 26.7, 36.0])
def test_a_wrong_size_of_markers_is_named(marker_mm: float, capfd) -> None:
    """OpenCV itself only warns, on standard error, of markers almost as large as their squares."""
    images = whole_pictures(CHARUCO, 16)
    wrong = replace(CHARUCO, marker=marker_mm / 1e3)
    verdict = calibrate_camera(ImageSet(images, len(images)), wrong, lens="five").quality.verdict
    assert re.search(r"markers of about (29|30) mm in squares of 40 mm", str(verdict.reasons))
    assert verdict.next_steps[0].endswith(
        "--square-mm or --marker-mm, in Python square= or marker="
    )
    assert capfd.readouterr().err == ""


def test_rows_and_columns_of_a_charuco_board_exchanged_are_named() -> None:
    image = whole_pictures(CHARUCO, 16)[0][1]
    exchanged = replace(CHARUCO, columns=5, rows=7)
    assert exchanged.find(image) is None
    assert "7 x 5 squares with 4X4_50: try `columns=7` `rows=5`" in exchanged.describe_other(image)


def test_images_that_can_be_read_only_once_are_refused() -> None:
    """Corners of tags are detected twice; without the second time they would be biased."""
    images = whole_pictures(TAGS, 40)
    with pytest.raises(BadInput, match="cannot be read again"):
        calibrate_camera(ImageSet(iter(images), len(images)), TAGS, lens="five")


@pytest.mark.parametrize("board", [TAGS, CIRCLES])
def test_boards_where_a_lens_has_no_rays_are_found_as_without_it(board) -> None:
    """As by a fisheye more than 90° off its axis, which straight lines do not describe."""
    image, _, plain = found_in(board)[0]
    matrix = np.array([[60.0, 0.0, -40.0], [0.0, 60.0, -40.0], [0.0, 0.0, 1.0]])
    wide = replace(generic_camera(SIZE), matrix=matrix, distortion=np.zeros(4), lens="fisheye")
    seen = board.find(image, wide)
    far = ~has_rays(wide, plain.corners)
    assert far.sum() > 16
    np.testing.assert_array_equal(seen.points, plain.points)
    np.testing.assert_allclose(seen.corners[far], plain.corners[far], atol=0.5)


@given(count=st.integers(0, 200), wanted=st.integers(1, 7))
def test_a_few_of_many_are_spread_over_all(count: int, wanted: int) -> None:
    spread = EvenSample[int](wanted)
    for number in range(count):
        spread.add(number)
    chosen = spread.chosen()
    assert len(chosen) == min(count, wanted)
    assert chosen == sorted(set(chosen))
    if count > wanted > 1:
        assert chosen[0] == 0
        assert chosen[-1] >= count / 2
        assert np.diff(chosen).max() <= 4 * count / wanted


@pytest.mark.parametrize(("board", "number"), [(CHARUCO, 8), (TAGS, 27)])
def test_a_number_that_is_seen_twice_is_left_out_by_name(board, number: int) -> None:
    image, plain = next((i, seen) for i, _, seen in found_in(board) if len(seen.points) > 20)
    family = cv2.aruco.DICT_4X4_50 if board is CHARUCO else cv2.aruco.DICT_APRILTAG_36H11
    decoy = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(family), number, 60)
    doubled = image.copy()
    doubled[:80, :80] = 255
    doubled[10:70, 10:70] = decoy
    seen = board.find(doubled)
    assert seen is not None
    assert seen.twice == (number,)
    assert plain.twice == ()
    assert len(seen.points) < len(plain.points)
    assert {tuple(p) for p in seen.points} <= {tuple(p) for p in plain.points}


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Chessboard(2, 6, 0.02), "3 inner corners"),
        (lambda: Chessboard(9, 6, 0.0), "side of a square"),
        (lambda: Charuco(7, 5, 0.03, 0.03, "4X4_50"), "smaller than its square"),
        (lambda: Charuco(7, 5, 0.03, 0.02, "9X9_50"), "unknown dictionary"),
        (lambda: Charuco(20, 20, 0.03, 0.02, "4X4_50"), "50 markers; the board needs 200"),
        (lambda: TagGrid(3, 1, 0.03, 0.01, "tag36h11"), "needs 4 tags"),
        (lambda: TagGrid(3, 2, 0.03, 0.0, "tag36h11"), "gap"),
        (lambda: TagGrid(3, 2, 0.03, math.nan, "tag36h11"), "gap"),
        (lambda: TagGrid(3, 2, 0.03, 0.01, "tag99h1"), "unknown tag family"),
        (lambda: TagGrid(4, 3, 0.04, 0.012, "tag36h11", 580), "tags 0 to 586; .* 580 to 591"),
        (lambda: TagGrid(4, 3, 0.04, 0.012, "tag36h11", order="up"), "unknown order"),
        (lambda: CircleGrid(2, 6, 0.02, 0.01), "3 circles"),
        (lambda: CircleGrid(4, 6, 0.02, 0.02), "not touch"),
        (lambda: TagGrid(4, 3, 0.04, 0.012, "tag36h11", -1), "tags 0 to 586; .* -1 to 10"),
    ],
)
def test_impossible_boards_are_refused(make, named: str) -> None:
    with pytest.raises(BadInput, match=named):
        make()


def test_pictures_too_small_or_empty_show_no_board() -> None:
    for board in (Chessboard(9, 6, 0.025), CHARUCO, TAGS, CIRCLES, SHIFTED, KALIBR):
        assert board.find(np.zeros((8, 8), np.uint8)) is None
        assert board.find(np.full((480, 640), 128, np.uint8)) is None
