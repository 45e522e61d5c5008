"""Images for viewers: complete or not at all, at most five per second, none without a viewer."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from executor.cameras import live_image
from executor.cameras.live_image import SHOWN_EVERY, ImageBoard, ImageReader, memory_for
from executor.realtime.shared_memory import SharedMemory
from model.pose import Pose
from model.rig import load_rig
from tests.cli.plans import RIG
from tracking.measurement import NoPose, PoseMeasurement

(CAMERA,) = load_rig(RIG).cameras
NOTHING = NoPose(0.5, "no tag")


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """The clock, set by the test."""
    time = [100.0]
    monkeypatch.setattr(live_image.time, "monotonic", lambda: time[0])
    return time


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    memory = memory_for(CAMERA)
    yield memory
    memory.close()


def picture(value: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    return np.full((CAMERA.height, CAMERA.width), value, np.uint8)


def test_what_was_seen_arrives_with_what_was_measured(
    memory: SharedMemory, now: list[float]
) -> None:
    board = ImageBoard(memory)
    pose = Pose(np.array([0.1, 0.2, 0.3]), np.eye(3))
    found = PoseMeasurement(1.5, pose, np.eye(6), (3, 7), 0.1, "tracked")
    assert not board.show(1, picture(1), found), "there is no viewer"
    with closing(ImageReader(os.getpid(), memory.descriptor)) as reader:
        assert reader.newest() is None
        assert board.show(2, picture(2), found)
        newest = reader.newest()
        assert newest is not None
        assert newest.frame == 2
        assert np.array_equal(newest.image, picture(2))
        assert isinstance(newest.found, PoseMeasurement)
        assert newest.found.tags == (3, 7)
        assert newest.found.pose.distance_to(pose) < 1e-12
        assert reader.newest() is None, "each is given once"
        now[0] += SHOWN_EVERY
        assert board.show(9, picture(9), NoPose(2.0, "dark"))
        newest = reader.newest()
        assert newest is not None
        assert newest.found == NoPose(2.0, "dark")


def test_at_most_five_a_second_are_shown_and_none_when_there_is_no_viewer(
    memory: SharedMemory, now: list[float]
) -> None:
    board, shown = ImageBoard(memory), []
    with closing(ImageReader(os.getpid(), memory.descriptor)) as reader:
        for frame in range(3000):
            now[0] += 0.01
            if frame < 1000:
                reader.newest()
            if board.show(frame, picture(0), NOTHING):
                shown.append(now[0])
    assert len(shown) == pytest.approx(5 * 11, abs=3)
    assert min(b - a for a, b in itertools.pairwise(shown)) >= SHOWN_EVERY - 1e-9


def test_half_an_image_is_not_shown(memory: SharedMemory, now: list[float]) -> None:
    """The viewer reads while the camera's process writes."""
    board = ImageBoard(memory)
    with closing(ImageReader(os.getpid(), memory.descriptor)) as reader:
        reader.newest()
        board.show(1, picture(1), NOTHING)
        (writes,) = live_image._NUMBER.unpack_from(memory.view, live_image._WRITES)
        live_image._NUMBER.pack_into(memory.view, live_image._WRITES, writes + 1)
        assert reader.newest() is None
        live_image._NUMBER.pack_into(memory.view, live_image._WRITES, writes + 2)
        assert reader.newest() is not None


def test_an_image_that_does_not_fit_is_left_out(memory: SharedMemory, now: list[float]) -> None:
    board = ImageBoard(memory)
    with closing(ImageReader(os.getpid(), memory.descriptor)) as reader:
        reader.newest()
        wide = np.zeros((CAMERA.height, CAMERA.width + 1), np.uint8)
        assert not board.show(1, wide, NOTHING)
        assert reader.newest() is None


def test_nothing_but_such_memory_is_opened(tmp_path: Path, memory: SharedMemory) -> None:
    """A descriptor may belong to another file by now."""
    other = tmp_path / "file"
    other.write_bytes(bytes(2 * memory.size))
    with other.open("r+b") as stream, pytest.raises(OSError, match="not an image"):
        ImageReader(os.getpid(), stream.fileno())
    read, write = os.pipe()
    try:
        with pytest.raises(OSError, match="not an image"):
            ImageReader(os.getpid(), read)
    finally:
        os.close(read)
        os.close(write)
    with pytest.raises(FileNotFoundError):
        ImageReader(os.getpid(), 10_000)
