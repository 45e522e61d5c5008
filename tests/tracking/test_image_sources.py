"""Folders, videos and cameras as sources; what cannot be used is listed by name."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from calibration.images import open_source
from drivers.cameras.files import ImageFolder, ImageOutput, SingleCameraImages, image_files
from drivers.cameras.live import Frame, LiveCamera, VideoFile, video_size
from executor.cameras.sources import first_gap
from model.errors import BadInput, HardwareMissing
from model.pose import Pose
from model.rig import Camera, Rig
from model.scene import Scene
from simulation.camera.camera import SyntheticCamera
from tests.calibration.exif import jpeg
from tracking.measurement import NoPose, PoseMeasurement
from tracking.pose_log import POSE_COLUMNS, pose_row, write_pose_log
from tracking.track import NoPlatformSeen, NoPoseReasons, TrackCount, track
from tracking.tracker import Tracker

TRUTH = [Pose.level([0.10 - 0.01 * k, 0.1, 0.4]) for k in range(4)]


@pytest.fixture
def folder(tmp_path: Path, synthetic: SyntheticCamera) -> Path:
    """Images 8 to 11, so that numeric and alphabetic order differ."""
    directory = tmp_path / "some images"
    directory.mkdir()
    for k, pose in enumerate(TRUTH):
        name = str(directory / f"frame_{8 + k}.png")
        cv2.imwrite(name, synthetic.render(pose, k), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return directory


def test_a_folder_is_read_in_the_order_of_its_numbers(folder: Path, camera: Camera) -> None:
    (folder / "notes.txt").write_text("not an image")
    frames = list(ImageFolder(folder, camera))
    assert [frame.name for frame in frames] == [f"frame_{8 + k}.png" for k in range(4)]
    np.testing.assert_allclose([frame.time for frame in frames], [0.0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    "names",
    [
        ["frame_9.png", "frame_10.png", "frame_100.png"],
        ["9.1.png", "9.2.png", "10.1.png"],
        ["take1.8.png", "take1.9.png", "take1.10.png", "take1.11.png", "take2.1.png"],
        ["take1.099.png", "take1.100.png", "take1.101.png"],
        ["1763000000.66704.png", "1763000000.699895.png", "1763000000.7.png", "1763000001.0.png"],
        ["cam2_999999999.9.png", "cam2_1000000000.66704.png", "cam2_1000000000.7.png"],
        ["0.0.png", "0.03.png", "0.07.png", "0.1.png", "0.13.png"],
        ["12.967.png", "13.0.png", "13.033.png", "other.png"],
        ["1763000000.5.png", "1763000000.625.png", "1763000000.75.png"],
        [f"cam1.{k}.png" for k in range(1, 160, 2)],
        [f"cam1.{k:02}.png" for k in range(1, 160, 2)],
        [f"seq3.{k}.jpg" for k in range(1, 300, 5)],
        [f"a1.{k}.png" for k in (97, 98, 99, 101, 102)],
    ],
)
def test_images_are_in_the_order_of_their_numbers_or_times(
    tmp_path: Path, names: list[str]
) -> None:
    """Python writes 0.7 for 0.700000: the digits after the point are no number of their own."""
    for name in reversed(names):
        (tmp_path / name).touch()
    assert [path.name for path in image_files(tmp_path)] == names


@given(
    count=st.integers(3, 40),
    step=st.sampled_from([1, 10, 33_333_333]),
    first=st.integers(0, 10**18),
    lost=st.integers(1, 38),
)
def test_a_gap_in_the_numbers_of_names_is_found(
    count: int, step: int, first: int, lost: int
) -> None:
    """The first and the last image are there; the clock of time stamps is not exact."""
    names = [f"cam2_{first + k * step + k * k % 7 * (step // 100)}.png" for k in range(count)]
    assert first_gap(names) is None
    assume(lost < count - 1 and count > 3)
    del names[lost]
    assert first_gap(names) == (names[lost - 1], names[lost])


def _utc(form: str, time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns / 1e9, UTC).strftime(form)


@pytest.mark.parametrize(
    "name",
    [
        lambda ns: f"{ns / 1e9}.png",
        lambda ns: f"{ns // 10**9}.{ns % 10**9:09d}.png",
        lambda ns: f"frame_{ns // 10**9}_{ns % 10**9 // 1000:06d}.jpg",
        lambda ns: _utc("%Y-%m-%dT%H-%M-%S.%f.png", ns),
        lambda ns: _utc("%Y%m%d_%H%M%S_%f.png", ns),
        lambda ns: _utc("%Y%m%d_%H%M%S_%f", ns)[:-3] + ".png",
    ],
)
def test_a_gap_in_seconds_and_their_fractions_is_found(name: Callable[[int], str]) -> None:
    """Over the end of a minute, at 30 images per second."""
    names = [name(1_763_000_038_000_000_000 + k * 33_366_700) for k in range(90)]
    assert first_gap(names) is None
    assert first_gap(names[:40] + names[41:]) == (names[39], names[41])


@pytest.mark.parametrize(
    "names",
    [
        [],
        ["1.png", "9.png"],
        ["a.png", "b.png", "d.png"],
        ["start.png", "1.png", "2.png", "5.png"],
        ["12-00-58.png", "12-00-59.png", "12-01-00.png", "12-01-01.png"],
        ["IMG_20261127_175958.jpg", "IMG_20261127_175959.jpg", "IMG_20261127_180000.jpg"],
        [f"PXL_20261127_{time}.jpg" for time in (175959640, 175959970, 180000300, 180000630)],
        ["20261127175957.png", "20261127175959.png", "20261127180001.png"],
        ["left_1.png", "left_2.png", "right_1.png", "right_2.png"],
        ["1_000001.png", "1_000002.png", "2_000001.png", "2_000002.png"],
        ["1.1.png", "1.2.png", "1.3.png", "2.1.png", "2.2.png"],
        [f"IMG_20261127_{name}.jpg" for name in ("175959_001", "175959_002", "180000_001")],
        [f"20261127_{name}.jpg" for name in ("235959_500", "235959_900", "000000_300")],
    ],
)
def test_names_without_consecutive_numbers_have_no_gap(names: list[str]) -> None:
    assert first_gap(names) is None


def test_names_that_are_not_utf8_can_be_written_down(tmp_path: Path, camera: Camera) -> None:
    """As on a disk of another system: in a result, a log or a hash."""
    camera = replace(camera, width=64, height=48)
    for name, size in (
        (b"bild_\xe4.png", (48, 64)),
        (b"b_\xff.png", (20, 20)),
        (b"c.png", (48, 64)),
    ):
        data = cv2.imencode(".png", np.zeros(size, np.uint8))[1].tobytes()
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_bytes(data)
    calibrated, measured = SingleCameraImages(tmp_path, (64, 48)), ImageFolder(tmp_path, camera)
    names = ["bild_\\udce4.png", "c.png"]
    assert [name for name, _ in calibrated] == [*calibrated.names] == names
    assert [frame.name for frame in measured] == names
    assert [*calibrated.unused] == [*measured.unused] == ["b_\\udcff.png"]


def test_a_broken_file_among_good_ones_is_named_and_skipped(
    folder: Path, rig: Rig, camera: Camera
) -> None:
    (folder / "frame_9.png").write_bytes(b"\x89PNG\r\n\x1a\n cut short")
    (folder / "frame_10.png").write_bytes(b"")
    source = ImageFolder(folder, camera)
    results = list(track(source, Tracker(rig, camera)))
    assert list(source.unused) == ["frame_9.png", "frame_10.png"]
    assert [r.name for r in results] == ["frame_8.png", "frame_11.png"]
    for result, truth in zip(results, (TRUTH[0], TRUTH[3]), strict=True):
        assert isinstance(result.observation, PoseMeasurement)
        assert result.observation.pose.distance_to(truth) < 1e-3
    assert results[1].observation.time == pytest.approx(0.3)  # the gap stays a gap


@pytest.mark.parametrize(
    "orientations", [(1, 1), (3, 3), (6, 6), (1, 3), (1, 6), (2, 4), (6, 8), (3, 6)]
)
@pytest.mark.parametrize("stored", ["wide", "tall"])
@pytest.mark.parametrize("stray", [None, "0.png", "z.png"])
def test_a_measurement_sees_the_pixels_that_a_calibration_saw(
    tmp_path: Path, camera: Camera, orientations: tuple[int, ...], stored: str, stray: str | None
) -> None:
    """Whatever EXIF orientations the images of a camera have, and whatever else is there."""
    if stray is not None:
        cv2.imwrite(str(tmp_path / stray), np.zeros((30, 80), np.uint8))
    image = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint8)
    pixels = image if stored == "wide" else image.T
    for name, orientation in zip("ab", orientations, strict=True):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(pixels, orientation))
    (tmp_path / "c.jpg").write_bytes(b"not an image")
    calibrated = SingleCameraImages(tmp_path)
    assert calibrated.names == ("a.jpg", "b.jpg")
    # In the same position the pixels of two images differ only by the compression.
    first, second = (image.astype(int) for _, image in calibrated)
    assert np.abs(first - second).max() < 8
    camera = replace(camera, width=calibrated.size[0], height=calibrated.size[1])
    measured = ImageFolder(tmp_path, camera)
    again = SingleCameraImages(tmp_path, calibrated.size)
    for frame, (name, expected), other in zip(measured, calibrated, again, strict=True):
        assert (frame.name, other[0]) == (name, name)
        np.testing.assert_array_equal(frame.image, expected)
        np.testing.assert_array_equal(other[1], expected)


CORNER = np.add.outer(np.arange(48) * 2, np.arange(64)).astype(np.uint8)
"""An image that differs in every orientation, 64 x 48 px."""


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("others", [(), (1,), (3, 4)])
def test_images_of_the_cameras_size_are_as_the_sensor_stored_them(
    tmp_path: Path, camera: Camera, orientation: int, others: tuple[int, ...]
) -> None:
    """Whatever a camera that points down states, in this folder and in that of the calibration."""
    for name, stated in zip("abc", (orientation, *others), strict=False):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(CORNER, stated))
    camera = replace(camera, width=64, height=48)
    for frame in ImageFolder(tmp_path, camera):
        assert np.abs(frame.image.astype(int) - CORNER).max() < 8
    for _, image in SingleCameraImages(tmp_path, (64, 48)):
        assert np.abs(image.astype(int) - CORNER).max() < 8


@pytest.mark.parametrize(
    ("orientation", "expected"),
    [(5, CORNER.T), (6, np.rot90(CORNER, -1)), (7, np.rot90(CORNER, 2).T), (8, np.rot90(CORNER))],
)
@pytest.mark.parametrize("beside", [False, True])
def test_images_in_portrait_are_rotated_as_stated(
    tmp_path: Path, camera: Camera, orientation: int, expected: np.ndarray, beside: bool
) -> None:
    """Alone, and beside images of the wrong size."""
    (tmp_path / "a.jpg").write_bytes(jpeg(CORNER, orientation))
    if beside:
        (tmp_path / "b.jpg").write_bytes(jpeg(CORNER, 1))
        (tmp_path / "c.jpg").write_bytes(jpeg(CORNER, 3))
    (frame,) = ImageFolder(tmp_path, replace(camera, width=48, height=64))
    assert np.abs(frame.image.astype(int) - expected).max() < 8
    if not beside:
        assert SingleCameraImages(tmp_path).size == (48, 64)


DEGREES = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


@pytest.mark.parametrize("degrees", DEGREES)
@pytest.mark.parametrize("is_portrait", [False, True])
def test_videos_follow_the_rule_of_images(
    tmp_path: Path, camera: Camera, degrees: int, is_portrait: bool
) -> None:
    """As stored if of the camera's size, else rotated as the file states, clockwise."""
    path = tmp_path / "a.mp4"
    image = np.kron([[0, 80], [160, 240]], np.ones((48, 64))).astype(np.uint8)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (128, 96), False)
    writer.write(image)
    writer.release()
    a, b, c, d = (value << 16 for value in DEGREES[degrees])
    data = path.read_bytes()
    at = data.index(b"tkhd") + 4 + 40  # its matrix, ISO/IEC 14496-12, 8.3.2
    matrix = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data[:at] + matrix + data[at + 36 :])
    size = (96, 128) if is_portrait else (128, 96)
    taken_by = replace(camera, width=size[0], height=size[1])
    if is_portrait and degrees in (90, 270):
        with pytest.raises(BadInput, match="readout_ms"):
            VideoFile(path, replace(taken_by, readout=0.03))
        # Calibrations at rest correct no rows.
        assert len(list(open_source(path, replace(taken_by, readout=0.03), None, 1).images)) == 1
    video = VideoFile(path, taken_by)
    if is_portrait and degrees in (0, 180):
        with pytest.raises(BadInput, match="the image has 128 x 96 px"):
            list(video)
        return
    expected = np.rot90(image, -degrees // 90) if is_portrait else image
    (frame,) = video
    assert np.median(np.abs(frame.image.astype(int) - expected)) < 8
    assert video_size(path) == ((96, 128) if degrees in (90, 270) else (128, 96))


def test_rotated_images_of_a_rolling_shutter_are_refused(tmp_path: Path, camera: Camera) -> None:
    """They were corrected along the wrong axis; as stored they are used."""
    (tmp_path / "a.jpg").write_bytes(jpeg(CORNER, 6))
    rolling = replace(camera, width=64, height=48, readout=0.03)
    assert len(list(ImageFolder(tmp_path, rolling))) == 1
    portrait = replace(rolling, width=48, height=64)
    with pytest.raises(BadInput, match="readout_ms") as caught:
        list(ImageFolder(tmp_path, portrait))
    assert "remove the orientation" in caught.value.next_step
    assert len(list(ImageFolder(tmp_path, replace(portrait, readout=0.0)))) == 1


def test_a_folder_of_broken_files_only_is_refused(tmp_path: Path, camera: Camera) -> None:
    (tmp_path / "a.png").write_bytes(b"nothing")
    with pytest.raises(BadInput, match="none of the 1 files"):
        list(ImageFolder(tmp_path, camera))


def test_an_empty_or_missing_folder_is_refused(tmp_path: Path, camera: Camera) -> None:
    with pytest.raises(BadInput, match="no images"):
        ImageFolder(tmp_path, camera)
    with pytest.raises(BadInput, match="no such folder"):
        ImageFolder(tmp_path / "nowhere", camera)


def test_a_picture_of_another_size_among_good_ones_is_named_and_skipped(
    folder: Path, camera: Camera
) -> None:
    cv2.imwrite(str(folder / "frame_9.png"), np.zeros((480, 640), dtype=np.uint8))
    source = ImageFolder(folder, camera)
    assert [frame.name for frame in source] == ["frame_8.png", "frame_10.png", "frame_11.png"]
    assert source.unused == {"frame_9.png": "has 640 x 480 px, the camera has 1280 x 720 px"}


@pytest.mark.parametrize("name", ["pictures", "a.avi"])
@pytest.mark.parametrize("is_small", [False, True])
def test_images_of_the_size_of_another_camera_are_named_as_its_own(
    tmp_path: Path, camera: Camera, name: str, is_small: bool
) -> None:
    small = replace(camera, name="side", width=64 if is_small else 66, height=48)
    with ImageOutput(tmp_path / name, 10.0) as out:
        out.write(np.zeros((48, 64, 3), np.uint8), "a.png")
    source = VideoFile if name == "a.avi" else ImageFolder
    with pytest.raises(BadInput) as caught:
        list(source(tmp_path / name, camera, cameras=(camera, small)))
    assert ("'front' seems to be that of 'side'" in caught.value.why) is is_small
    assert ("do not calibrate" in caught.value.next_step) is is_small
    assert ("calibrate it at this size" in caught.value.next_step) is not is_small


def test_pictures_that_are_all_of_another_size_are_refused_by_name(
    tmp_path: Path, camera: Camera
) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((480, 640), dtype=np.uint8))
    (tmp_path / "broken.png").write_bytes(b"nothing")
    with pytest.raises(BadInput, match="none of the 2 images has the camera's 1280 x 7") as caught:
        list(ImageFolder(tmp_path, camera))
    assert "small.png has 640 x 480 px" in caught.value.why
    assert "broken.png is not a readable image" in caught.value.why


def test_a_video_is_measured_picture_by_picture(
    tmp_path: Path, rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    path = tmp_path / "run.avi"
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 10.0, (camera.width, camera.height), isColor=False)
    if not writer.isOpened():
        pytest.fail("this OpenCV writes no MJPG video, so videos cannot be tested here")
    for k, pose in enumerate(TRUTH):
        writer.write(synthetic.render(pose, k))
    writer.release()
    video = VideoFile(path, camera)
    assert len(video) == len(TRUTH)
    count = TrackCount()
    results = list(track(video, Tracker(rig, camera), count))
    assert count.poses == len(TRUTH)
    for k, (result, truth) in enumerate(zip(results, TRUTH, strict=True)):
        assert isinstance(result.observation, PoseMeasurement)
        assert result.observation.time == pytest.approx(0.1 * k)
        assert result.observation.pose.distance_to(truth) < 2e-3


def video_of(path: Path, camera: Camera, images: int) -> Path:
    """Black images of the camera's size, 10 per second."""
    size, code = (camera.width, camera.height), cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 10.0, size, isColor=False)
    for _ in range(images):
        writer.write(np.zeros(size[::-1], np.uint8))
    writer.release()
    return path


class Capture:
    """Images with the times of a container, whose rate varies; None where one is damaged."""

    def __init__(self, times_ms: Sequence[float | None], size: tuple[int, int]) -> None:
        self._times, self._size, self._at = times_ms, size, -1

    def read(self) -> tuple[bool, np.ndarray | None]:
        self._at += 1
        good = self._at < len(self._times) and self._times[self._at] is not None
        return good, np.zeros(self._size, np.uint8) if good else None

    def get(self, what: int) -> float:
        time = self._times[self._at] if what == cv2.CAP_PROP_POS_MSEC else 10.0
        assert time is not None
        return time

    def set(self, what: int, value: float) -> bool:
        return False

    def release(self) -> None:
        pass

    def isOpened(self) -> bool:  # noqa: N802  # as OpenCV has it
        return True


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ([0.0, 33.0, 66.0, 166.0, 266.0], [0.0, 0.033, 0.066, 0.166, 0.266]),
        ([0.0, 0.0, 0.0], [0.0, 0.1, 0.2]),
        ([float("nan")] * 3, [0.0, 0.1, 0.2]),
        ([0.0, 500.0, 100.0, 900.0], [0.0, 0.5, 0.6, 0.9]),
        ([66.7, 100.0, 133.3], [0.0, 0.0333, 0.0666]),  # H.264 with B-frames in AVI
    ],
)
def test_a_video_may_change_its_rate(
    tmp_path: Path,
    camera: Camera,
    monkeypatch: pytest.MonkeyPatch,
    stated: list[float],
    expected: list[float],
) -> None:
    video = VideoFile(video_of(tmp_path / "run.avi", camera, 1), camera)
    capture = Capture(stated, (camera.height, camera.width))
    monkeypatch.setattr("drivers.cameras.live._opened", lambda _path: capture)
    assert [frame.time for frame in video] == pytest.approx(expected)


def test_what_follows_a_damaged_part_of_a_video_is_read(
    tmp_path: Path, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = VideoFile(video_of(tmp_path / "run.avi", camera, 1), camera)
    capture = Capture([0.0, 100.0, None, None, 400.0], (camera.height, camera.width))
    monkeypatch.setattr("drivers.cameras.live._opened", lambda _path: capture)
    assert [frame.time for frame in video] == pytest.approx([0.0, 0.1, 0.4])
    assert list(video.unused) == ["2 of 5 images of run.avi"]


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_images_that_a_cut_video_lacks_are_counted(
    tmp_path: Path, camera: Camera, share: float
) -> None:
    small = replace(camera, width=64, height=48)
    path = video_of(tmp_path / "run.avi", small, 40)
    video = VideoFile(path, small)
    assert video.readable == 40
    assert video.unused == {}
    path.write_bytes(path.read_bytes()[: round(share * path.stat().st_size)])
    cut = VideoFile(path, small)
    assert 0 < cut.readable < 40
    (lost,) = cut.unused
    assert lost == f"{40 - cut.readable} of 40 images of run.avi"


@pytest.mark.parametrize("over_http", [False, True])
def test_a_stream_without_times_has_the_camera_s_rate(
    tmp_path: Path, camera: Camera, over_http: bool
) -> None:
    """FFmpeg would assume 25 images per second."""
    path = tmp_path / "a.mjpeg"
    image = np.zeros((camera.height, camera.width), np.uint8)
    jpegs = [cv2.imencode(".jpg", image + k)[1].tobytes() for k in range(5)]
    if over_http:
        kind = b"--b\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"
        jpegs = [kind % len(jpeg) + jpeg + b"\r\n" for jpeg in jpegs]
    path.write_bytes(b"".join(jpegs))
    video = VideoFile(path, replace(camera, rate=10.0))
    assert [frame.time for frame in video] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert "a.mjpeg states no times: its images are taken as 10 per second" in video.remark
    given = VideoFile(path, camera, rate=40.0)
    assert [frame.time for frame in given] == pytest.approx([0.0, 0.025, 0.05, 0.075, 0.1])
    assert given.remark == ""


@pytest.mark.parametrize(
    ("begin", "has_times"),
    [
        (b"\0\0\0\1\x67\x64\0", False),  # H.264
        (b"\0\0\0\1\x40\x01\x0c", False),  # H.265
        (b"\0\0\1\xba\x44\0", True),  # MPEG program stream
        (b"\0\0\1\xb3\x14\0", True),  # MPEG-2
        (b"\0\0\0\x20ftypisom", True),  # MP4
        (b"\0\0\1\x14ftypmp42", True),  # of many brands
        (b"\0\0\1\x0amoov\0\0", True),  # MOV
        (b"\0\0\0\1mdat\0\0\0\0\1\2", True),  # with a size of 64 bits
        (b"RIFF\0\0\0\0AVI LIST", True),
        (b"\x1a\x45\xdf\xa3\x01\0", True),  # Matroska
        (b"\x47\x40\x11\x10\0", True),  # MPEG transport stream
    ],
)
def test_streams_without_times_are_known_by_their_first_bytes(
    tmp_path: Path,
    camera: Camera,
    monkeypatch: pytest.MonkeyPatch,
    begin: bytes,
    has_times: bool,
) -> None:
    path = tmp_path / "video"
    path.write_bytes(begin)
    capture = Capture([0.0, 33.0], (camera.height, camera.width))
    monkeypatch.setattr("drivers.cameras.live._opened", lambda _path: capture)
    assert (VideoFile(path, replace(camera, rate=7.0)).rate == 7.0) is not has_times


def test_a_file_that_is_no_video_is_refused(tmp_path: Path, camera: Camera) -> None:
    path = tmp_path / "notes.avi"
    path.write_text("not a readable video")
    with pytest.raises(BadInput, match="not a readable video"):
        VideoFile(path, camera)
    with pytest.raises(BadInput, match="no such file"):
        VideoFile(tmp_path / "missing.avi", camera)


def test_a_camera_that_is_not_there_is_hardware_missing(camera: Camera) -> None:
    with pytest.raises(HardwareMissing, match="cannot be opened") as caught:
        LiveCamera("97", camera)
    assert caught.value.exit_code == 4
    assert caught.value.where == "camera front (97)"


@pytest.mark.parametrize(
    ("source", "what"),
    [
        ("gopher://camera/video", "no camera has an address that begins with gopher://"),
        ("file:///tmp/run.avi", "begins with file://"),
        ("htp://camera:80", "begins with htp://"),
        ("://camera", "begins with ://"),
        ("http://camera:99999/video", "the address has a port that does not exist"),
        ("RTSP://me:pass@camera:0", "a port that does not exist"),
        ("rtsp://[::1]:65536?x", "a port that does not exist"),
        ("udp://camera:" + "9" * 5000, "a port that does not exist"),
    ],
)
def test_an_address_that_no_camera_can_have_is_refused(
    camera: Camera, monkeypatch: pytest.MonkeyPatch, source: str, what: str
) -> None:
    monkeypatch.setattr("drivers.cameras.live._opened", pytest.fail)
    with pytest.raises(BadInput) as caught:
        LiveCamera(source, camera)
    assert what in caught.value.what
    assert "rtsp" in caught.value.next_step or "from 1 to 65535" in caught.value.next_step
    assert "pass@" not in str(caught.value)


@pytest.mark.parametrize(
    "source",
    [
        "http://camera",
        "rtsp://99999@[fe80::1]/x",
        "HTTPS://me:99999@camera:65535/a:0?b:0",
        "udp://@:1",
    ],
)
def test_an_address_that_a_camera_can_have_is_opened(
    camera: Camera, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    monkeypatch.setattr("drivers.cameras.live._opened", lambda _: cv2.VideoCapture())
    with pytest.raises(HardwareMissing, match="cannot be opened"):
        LiveCamera(source, camera)


def test_pictures_without_tags_say_what_was_expected(rig: Rig, camera: Camera) -> None:
    blank = [Frame(k * 0.1, np.full((720, 1280), 90, np.uint8), f"p{k}") for k in range(3)]
    seen = track(blank, Tracker(rig, camera))
    with pytest.raises(NoPlatformSeen) as caught:
        for _ in seen:
            pass
    message = str(caught.value)
    assert caught.value.exit_code == 2
    assert "none of 3 images" in message
    assert "tag36h11 tags 301, 302, 303, 304, 305, 306" in message
    assert "no tag of any known family" in message


def test_pictures_with_other_tags_say_which(
    rig: Rig, camera: Camera, scene: object, synthetic: SyntheticCamera
) -> None:
    others = tuple(replace(tag, id=tag.id + 200) for tag in rig.platform_tags)
    picture = Frame(0.0, synthetic.render(TRUTH[0], 0), "first.png")
    with pytest.raises(NoPlatformSeen, match=r"first\.png shows tag36h11 .*303, .*401"):
        list(track([picture], Tracker(replace(rig, platform_tags=others), camera)))


def test_a_camera_out_of_focus_is_named_and_no_size_is_doubted(
    rig: Rig, camera: Camera, synthetic: SyntheticCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tags are decoded, but their edges are not found."""
    monkeypatch.setattr(
        "tracking.estimator.refine", lambda _image, _camera, rough, _m: [None] * len(rough)
    )
    picture = Frame(0.0, synthetic.render(TRUTH[0], 0), "first.png")
    with pytest.raises(
        NoPlatformSeen, match="they are too blurred, or something lies along them"
    ) as caught:
        list(track([picture], Tracker(rig, camera)))
    assert "focus" in caught.value.next_step
    assert "size_mm" not in caught.value.next_step


def test_an_empty_source_and_an_endless_one_finish(rig: Rig, camera: Camera) -> None:
    with pytest.raises(NoPlatformSeen, match="no images"):
        list(track([], Tracker(rig, camera)))

    def endless() -> object:
        while True:
            yield Frame(0.0, np.full((720, 1280), 90, np.uint8), "again")

    with pytest.raises(NoPlatformSeen, match="none of 2 images"):
        list(track(endless(), Tracker(rig, camera), give_up_after=2))  # type: ignore[arg-type]


def test_the_pose_log_has_a_row_a_picture_whether_it_gave_a_pose_or_not(
    tmp_path: Path, rig: Rig, camera: Camera, synthetic: SyntheticCamera
) -> None:
    pictures = [
        Frame(0.0, synthetic.render(TRUTH[0], 0), "a.png"),
        Frame(0.1, np.full((720, 1280), 90, np.uint8), "b.png"),
    ]
    logged = list(track(pictures, Tracker(rig, camera)))
    assert isinstance(logged[1].observation, NoPose)
    write_pose_log(tmp_path / "poses.csv", logged)
    lines = (tmp_path / "poses.csv").read_text().splitlines()
    assert lines[0].split(",") == list(POSE_COLUMNS)
    assert len(lines) == 3
    row = dict(zip(POSE_COLUMNS, pose_row(logged[0]), strict=True))
    found = logged[0].observation
    assert isinstance(found, PoseMeasurement)
    assert float(row["x_mm"]) == pytest.approx(found.pose.position[0] * 1e3, abs=1e-6)
    assert float(row["std_rz_deg"]) == pytest.approx(
        np.degrees(found.rotation_deviation[2]), abs=1e-6
    )
    assert float(row["cov_x_rz_mm_deg"]) == pytest.approx(
        1e3 * np.degrees(1.0) * found.covariance[0, 5], rel=1e-4
    )
    assert row["tags"].split() == [str(tag) for tag in found.tags]
    assert "detected" in lines[2]


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_images_of_more_bits_keep_their_contrast(tmp_path: Path, camera: Camera, bits: int) -> None:
    """Cameras store 10 or 12 bits in files of 16."""
    grey = np.add.outer(np.arange(camera.height), np.arange(camera.width)) % 256
    wide = (grey.astype(np.uint16) << (bits - 8)) if bits > 8 else grey.astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), wide)
    (frame,) = ImageFolder(tmp_path, camera)
    np.testing.assert_array_equal(frame.image, grey)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_floating_point_images_are_refused_with_the_reason(
    folder: Path, tmp_path: Path, camera: Camera, kind: type
) -> None:
    """Values from 0 to 1 would all become black."""
    only = tmp_path / "only"
    only.mkdir()
    for path in (folder / "a.tiff", only / "a.tiff"):
        cv2.imwrite(str(path), np.full((camera.height, camera.width), 0.5, kind))
    reason = f"has values of type {kind.__name__}; only integers of 8 to 16 bits can be used"
    source = ImageFolder(folder, camera)
    assert len(list(source)) == len(TRUTH)
    assert source.unused == SingleCameraImages(folder).unused == {"a.tiff": reason}
    for read in (lambda: SingleCameraImages(only), lambda: list(ImageFolder(only, camera))):
        with pytest.raises(BadInput, match="none of the 1 files is a readable image") as caught:
            read()
        assert caught.value.why == f"a.tiff {reason}"


def test_reasons_that_differ_in_numbers_are_one() -> None:
    reasons = NoPoseReasons()
    for reason in ("error is 1.39 px", "no tag detected", "error is 0.5 px", "error is 12 px"):
        reasons.add(reason)
    reasons.add("no tag detected")
    assert reasons.most_frequent() == "error is 1.39 px"


def test_a_platform_below_its_outlets_is_found(rig: Rig, scene: Scene, camera: Camera) -> None:
    """As of a suspended robot, whose outlets are all above it."""
    raised = replace(rig, outlets=np.column_stack([rig.outlets[:, :2], np.full(8, 2.0)]))
    pose = Pose.level(rig.home.position)
    image = SyntheticCamera(rig, scene, camera, seed=2).render(pose)
    found = Tracker(raised, camera).observe(image, 0.0)
    assert isinstance(found, PoseMeasurement), found
    assert found.pose.distance_to(pose) < 1e-3
