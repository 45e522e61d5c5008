"""Which images a live camera captures, the instructions to the operator, and videos' samples."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.images import VIDEO_IMAGES, CaptureGuide, open_images, open_source, same_images
from calibration.targets.boards import Chessboard, DetectedBoard
from drivers.cameras.live import VideoFile
from model.cameras import generic_camera
from model.pose import Array, Pose, matrix_from_rotation_vector

SIZE = (1280, 720)
POINTS = Chessboard(9, 6, 0.025).points()
MATRIX = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 360.0], [0.0, 0.0, 1.0]])
BLANK = np.zeros((SIZE[1], SIZE[0]), np.uint8)


class Shown:
    """A board at a pose set by the test."""

    def __init__(self) -> None:
        self.pose: Pose | None = None

    def find(self, image: np.ndarray) -> DetectedBoard | None:
        if self.pose is None:
            return None
        zero = np.zeros(3)
        points = self.pose.apply(POINTS)
        corners = cv2.projectPoints(points, zero, zero, MATRIX, np.zeros(5))[0].reshape(-1, 2)
        return DetectedBoard(POINTS, corners)

    def describe_other(self, image: np.ndarray) -> str:
        return ""


def held(x: float, y: float, turn: Array | list[float] = (0.0, 0.0, 0.0), z: float = 0.6) -> Pose:
    """A board with its centre at a position in front of the camera, [m], rotated about it."""
    rotation = matrix_from_rotation_vector(turn)
    return Pose(np.array([x, y, z]) - rotation @ POINTS.mean(axis=0), rotation)


@pytest.fixture
def shown() -> Shown:
    return Shown()


def show(guide: CaptureGuide, board: Shown, pose: Pose | None, times: int = 2):
    board.pose = pose
    advice = [guide.judge(BLANK) for _ in range(times)]
    return advice[-1]


def test_an_image_is_taken_when_the_board_is_at_rest_and_shows_something_new(shown) -> None:
    guide = CaptureGuide(shown, wanted=10)
    assert guide.judge(BLANK).text == "0 of 10 images: show the board"
    shown.pose = held(0.0, 0.0)
    moving = guide.judge(BLANK)
    assert not moving.taken
    assert "hold it still" in moving.text
    assert guide.judge(BLANK).taken
    assert not guide.judge(BLANK).taken  # the same again
    shown.pose = held(0.15, 0.0)
    assert not guide.judge(BLANK).taken  # still moving
    assert guide.judge(BLANK).taken
    assert len(guide.views) == 2


def test_the_part_of_the_picture_that_is_missing_is_named(shown) -> None:
    guide = CaptureGuide(shown, wanted=4)
    advice = show(guide, shown, held(0.0, 0.0))
    assert "bring the board to the top left of the image" in advice.text
    advice = show(guide, shown, held(-0.21, -0.11))
    assert "top left" not in advice.text


@pytest.mark.parametrize(
    ("turn", "edge"),
    [
        ([-0.5, 0.0, 0.0], "upper"),
        ([0.5, 0.0, 0.0], "lower"),
        ([0.0, 0.5, 0.0], "left"),
        ([0.0, -0.5, 0.0], "right"),
    ],
)
def test_tilts_are_named_by_the_edge_that_is_away(shown, turn, edge: str) -> None:
    pose = held(0.0, 0.0, turn)
    corners = POINTS.reshape(6, 9, 3)
    edges = {
        "upper": corners[0], "lower": corners[-1], "left": corners[:, 0], "right": corners[:, -1]
    }  # fmt: skip
    far = max(edges, key=lambda name: pose.apply(edges[name])[:, 2].mean())
    guide = CaptureGuide(shown, wanted=4)
    for x in (-0.21, 0.0, 0.21):
        for y in (-0.11, 0.0, 0.11):
            show(guide, shown, held(x, y))
    asked = set()
    for other in edges:
        turns = {
            "lower": [0.5, 0, 0],
            "upper": [-0.5, 0, 0],
            "left": [0, 0.5, 0],
            "right": [0, -0.5, 0],
        }
        if other != far:
            show(guide, shown, held(0.0, 0.0, turns[other]))
    asked = guide.missing()
    assert far == edge
    assert asked == f"tilt the board by 20° to 40°, its {edge} edge away from the camera"


def test_what_was_seen_is_drawn_in_plain_characters(shown) -> None:
    guide = CaptureGuide(shown, wanted=4)
    assert guide.coverage_map().count("#") == 0
    show(guide, shown, held(-0.21, -0.11))
    rows = guide.coverage_map().splitlines()
    assert rows[0].split()[0] == "#"
    assert rows[2].split()[2] == "."
    assert "upper" not in guide.coverage_map()
    show(guide, shown, held(0.0, 0.0, [-0.5, 0.0, 0.0]))
    assert guide.coverage_map().splitlines()[0].endswith("upper")
    assert guide.coverage_map().isascii()


def test_enough_is_said_when_all_parts_and_tilts_were_seen(shown) -> None:
    guide = CaptureGuide(shown, wanted=12)
    for x in (-0.21, 0.0, 0.21):
        for y in (-0.11, 0.0, 0.11):
            show(guide, shown, held(x, y))
    for turn in ([0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0]):
        assert not show(guide, shown, held(0.0, 0.0, turn)).done
    last = show(guide, shown, held(0.0, 0.0, [0, -0.5, 0]))
    assert last.done
    assert last.text.endswith("enough")
    assert not show(CaptureGuide(shown, wanted=99), shown, None).done


def video_of(path: Path, length: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48), False)
    for _ in range(length):
        writer.write(np.zeros((48, 64), np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize("length", [7, VIDEO_IMAGES, VIDEO_IMAGES + 1, 100, 3 * VIDEO_IMAGES])
@pytest.mark.parametrize("stated", [None, 0, 10.0, 0.1])
def test_as_many_images_of_a_video_as_wanted_are_spaced_evenly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int, stated: float | None
) -> None:
    """Also if the file states none, or another number, as a cut one or one of variable rate."""
    path = video_of(tmp_path / "board.avi", length)
    if stated is not None:
        monkeypatch.setattr(VideoFile, "__len__", lambda _: int(stated * length))
    images = open_images(path)
    numbers = [int(name.removeprefix("image ")) for name, _ in images.images]
    assert images.count == len(numbers) == min(length, VIDEO_IMAGES)
    gaps = np.diff([*numbers, length])
    assert numbers[0] == 0
    assert np.ptp(gaps) <= 1


def test_a_cut_video_is_sampled_over_what_is_left_of_it(tmp_path: Path) -> None:
    """Its header states all images."""
    path = video_of(tmp_path / "board.avi", 1000)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 10])
    video = VideoFile(path, generic_camera((64, 48)))
    assert len(video) > 5 * video.readable > 5 * VIDEO_IMAGES
    numbers = [int(name.removeprefix("image ")) for name, _ in open_images(path).images]
    assert len(numbers) == VIDEO_IMAGES
    assert np.ptp(np.diff([*numbers, video.readable])) <= 1


@pytest.mark.parametrize("lengths", [(60, 62), (300, 310), (310, 12)])
def test_of_two_videos_images_with_the_same_numbers_are_used(
    tmp_path: Path, lengths: tuple[int, int]
) -> None:
    camera = generic_camera((64, 48))
    videos = [video_of(tmp_path / f"{k}.avi", length) for k, length in enumerate(lengths)]
    samples = same_images([open_source(video, camera, None, 20) for video in videos])
    first, second = ([name for name, _ in one.images] for one in samples)
    assert first == second
    assert len(first) == samples[0].count == samples[1].count == min(20, *lengths)


def test_the_images_of_a_video_can_be_read_repeatedly(tmp_path: Path) -> None:
    """For boards that are detected again with the lens."""
    images = open_images(video_of(tmp_path / "board.avi", 100))
    first, second = ([(name, image.tobytes()) for name, image in images.images] for _ in range(2))
    assert len(first) == images.count
    assert first == second
