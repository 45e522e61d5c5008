"""`cdpr calibrate camera --live`, with a video instead of a camera."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.images import capture_images
from calibration.targets.boards import Chessboard
from model.errors import AlreadyExists
from model.pose import Pose, matrix_from_rotation_vector
from tests.calibration.board_images import SIZE, picture_of
from tests.cli.program import call, nothing_written, one_message
from tests.cli.test_calibrate_camera import BOARD, MIDDLE, chessboard_print

TURNS = ([0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0], [0.3, 0.3, 0.2])


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board held at nine positions, two images each, and tilted in every direction."""
    positions = [(x, y) for x in (-0.11, 0.0, 0.11) for y in (-0.08, 0.0, 0.08)]
    held = [(*position, [0.0, 0.0, 0.0]) for position in positions] + [
        (0.0, 0.0, turn) for turn in TURNS
    ]
    path = tmp_path_factory.mktemp("live") / "board.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, SIZE)
    for x, y, turn in held:
        rotation = matrix_from_rotation_vector(turn)
        pose = Pose(np.array([x, y, 0.5]) - rotation @ MIDDLE, rotation)
        image = picture_of(chessboard_print(), 0.0005, np.full(2, 0.05), pose)
        for _ in range(2):
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_pictures_are_taken_with_advice_and_then_used(video: Path, tmp_path: Path) -> None:
    folder = tmp_path / "taken"
    options = ("--live", video, "--pictures", "12", *BOARD, "--wanted-mm", "20", "--json")
    answer = call("calibrate", "camera", folder, *options)
    assert answer.code in (0, 3), answer
    found = json.loads(answer.out)
    taken = sorted(path.name for path in folder.iterdir())
    assert 10 <= len(taken) <= 14
    assert taken[0] == "live_001.png"
    assert found["pictures_used"] == len(taken)
    assert "bring the board to the top right of the image" in answer.err
    assert "edge away from the camera" in answer.err
    assert "enough" in answer.err
    assert answer.err.count("edges away:") == len(taken)
    assert "# # #" in answer.err


def test_a_video_is_used_instead_of_a_folder(video: Path) -> None:
    """One image of every view is used, as nothing moved to the next."""
    answer = call("calibrate", "camera", video, *BOARD, "--json")
    assert answer.code in (0, 3), answer
    found = json.loads(answer.out)
    assert found["pictures_used"] == 9 + len(TURNS)
    assert all("nothing moved" in why for why in found["unused"].values())


def test_a_board_that_is_never_detected_is_reported(video: Path, tmp_path: Path) -> None:
    other = ("--board", "charuco", "--columns", "5", "--rows", "4", "--square-mm", "25")
    other += ("--marker-mm", "20")
    answer = call("calibrate", "camera", tmp_path / "taken", "--live", video, *other)
    one_message(answer, 2, "no image was captured", "a ChArUco board of 5 x 4 squares")


@pytest.mark.parametrize(
    ("options", "code", "named"),
    [
        (("--live", "nowhere.avi"), 2, "not a folder of images"),
        (("--live", "97"), 4, "the camera cannot be opened"),
        (("--pictures", "12"), 2, "are for capturing images"),
    ],
)
def test_invalid_cameras_are_reported(tmp_path: Path, options, code: int, named: str) -> None:
    answer = call("calibrate", "camera", tmp_path / "taken", *options, *BOARD)
    one_message(answer, code, named)


def test_a_video_that_is_missing_leaves_no_folder_behind(tmp_path: Path) -> None:
    with nothing_written(tmp_path):
        answer = call(
            "calibrate", "camera", tmp_path / "taken", "--live", tmp_path / "no.mp4", *BOARD
        )
    one_message(answer, 2, "not a folder of images, a video file or a camera")


def test_pictures_of_before_are_not_mixed_with_new_ones(video: Path, tmp_path: Path) -> None:
    (tmp_path / "old.png").write_bytes(b"old")
    with nothing_written(tmp_path):
        answer = call("calibrate", "camera", tmp_path, "--live", video, *BOARD)
    one_message(answer, 2, "the folder is not empty")


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """Images of an earlier session, with another lens."""
    for number in range(1, 21):
        image = np.full(SIZE[::-1], number, np.uint8)
        cv2.imwrite(str(tmp_path / f"live_{number:03}.png"), image)
    return tmp_path


def test_force_replaces_the_images_of_an_earlier_session(video: Path, earlier: Path) -> None:
    old = {path.read_bytes() for path in earlier.iterdir()}
    options = ("--live", video, "--pictures", "12", *BOARD, "--force", "--json")
    answer = call("calibrate", "camera", earlier, *options)
    assert answer.code in (0, 3), answer
    found = json.loads(answer.out)
    taken = {path.read_bytes() for path in earlier.iterdir()}
    assert not taken & old
    assert found["pictures_used"] == len(taken)
    assert found["unused"] == {}


def test_force_keeps_an_earlier_session_until_an_image_is_captured(
    video: Path, earlier: Path
) -> None:
    other = ("--board", "charuco", "--columns", "5", "--rows", "4", "--square-mm", "25")
    other += ("--marker-mm", "20", "--force")
    with nothing_written(earlier):
        answer = call("calibrate", "camera", earlier, "--live", video, *other)
    one_message(answer, 2, "no image was captured")


def test_images_of_another_source_are_not_mixed_with_new_ones(video: Path, earlier: Path) -> None:
    """Nor deleted: only captured images are replaced."""
    (earlier / "live_001.png").rename(earlier / "mine.PNG")
    with nothing_written(earlier):
        answer = call("calibrate", "camera", earlier, "--live", video, *BOARD, "--force")
    one_message(answer, 2, "mine.PNG", "choose another folder")


def test_a_script_does_not_capture_into_a_folder_of_images_by_accident(
    video: Path, earlier: Path
) -> None:
    with nothing_written(earlier), pytest.raises(AlreadyExists, match="not empty"):
        capture_images(str(video), earlier, Chessboard(9, 6, 0.025))


def test_an_interrupted_session_is_not_mixed_with_an_earlier_one(
    video: Path, earlier: Path
) -> None:
    """As by Ctrl-C after its fifth image."""
    texts: list[str] = []
    taken = capture_images(
        str(video),
        earlier,
        Chessboard(9, 6, 0.025),
        replace=True,
        on_advice=texts.append,
        stopped=lambda: sum(text.startswith("5 of") for text in texts) > 0,
    )
    assert taken == 5
    assert sorted(path.name for path in earlier.iterdir()) == [
        f"live_00{number}.png" for number in range(1, 6)
    ]
