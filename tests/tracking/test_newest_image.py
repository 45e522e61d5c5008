"""A camera that takes images faster than they are read: none ages in a queue."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

import drivers.cameras.frame_reader
import drivers.cameras.live
from drivers.cameras.frame_reader import FROZEN, LOST_IMAGES
from drivers.cameras.live import LiveCamera
from model.errors import BadInput, Fault, HardwareMissing, StoppedByOperator
from model.rig import Camera

#: Images until the first on time, which a camera returns as it opens: it comes at 2 s.
OPENING = 201


class Queue:
    """Queue of camera images.

    An image's brightness is its number (modulo 256), or with ``repeats`` that of the first of so
    many equal ones. Reading one takes no time; when none waits, reading waits, as with a camera,
    for the next.
    """

    repeats = 1
    backend = "FFMPEG"

    def __init__(self, camera: Camera) -> None:
        self._shape = (camera.height, camera.width, 3)
        self._changed = threading.Condition()
        self._taken = self._come = self._wanting = 0
        self._gone = self.released = False

    def take(self, pictures: int) -> None:
        """Adds new images."""
        with self._changed:
            self._come += pictures
            self._changed.notify_all()

    def wait_until_read(self) -> None:
        """Returns when all are read and the reader waits for the next."""
        with self._changed:
            assert self._changed.wait_for(
                lambda: self._wanting and self._taken == self._come, timeout=20.0
            )

    def unplug(self) -> None:
        with self._changed:
            self._gone = True
            self._changed.notify_all()

    def isOpened(self) -> bool:  # noqa: N802  # as OpenCV has it
        return True

    def set(self, _what: int, _value: float) -> bool:
        return True

    def getBackendName(self) -> str:  # noqa: N802  # as OpenCV has it
        return self.backend

    def get(self, what: int) -> float:
        """The time that its driver states is that of the exposure, on a clock of its own."""
        if what == cv2.CAP_PROP_FOURCC:
            return cv2.VideoWriter.fourcc(*"H264")
        assert what == cv2.CAP_PROP_POS_MSEC
        return 1e6 + 10.0 * (self._taken - 1)

    def read(self) -> tuple[bool, Any]:
        with self._changed:
            self._wanting += 1
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._gone or self._taken < self._come)
            self._wanting -= 1
            if self._taken == self._come:
                return False, None
            self._taken += 1
            number = self._taken - 1
            return True, np.full(self._shape, (number - number % self.repeats) % 256, np.uint8)

    def release(self) -> None:
        self.released = True

    def clock(self) -> float:
        """Each image arrives when it is read, at 100 Hz."""
        return (self._taken - 1) / 100.0


@pytest.fixture
def queue(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> Iterator[Queue]:
    made = Queue(camera)
    monkeypatch.setattr(drivers.cameras.live, "_opened", lambda _: made)
    yield made
    made.unplug()


def test_the_newest_picture_is_answered_with_the_time_at_which_it_came(
    queue: Queue, camera: Camera
) -> None:
    queue.take(OPENING)
    with LiveCamera("0", camera, queue.clock) as live:
        for number in (230, 260, 290):  # it takes thirty while one is asked for
            queue.take(30)
            queue.wait_until_read()
            frame = live.read()
            assert (int(frame.image[0, 0]), frame.name) == (number % 256, f"image {number}")
            assert frame.time == pytest.approx(number / 100.0)
        queue.unplug()
    assert queue.released


def test_a_picture_was_exposed_its_latency_before_it_came(queue: Queue, camera: Camera) -> None:
    queue.take(OPENING)
    with LiveCamera("0", replace(camera, latency=0.08), queue.clock) as live:
        queue.take(5)
        queue.wait_until_read()
        assert live.read().time == pytest.approx(2.05 - 0.08)
        queue.unplug()


def test_no_picture_is_answered_twice(queue: Queue, camera: Camera) -> None:
    queue.take(OPENING)
    with LiveCamera("0", camera, queue.clock) as live:
        later = threading.Timer(0.0, queue.take, [1])
        later.start()
        assert live.read().name == "image 201"
        later.join()
        queue.unplug()


def test_a_copy_of_the_last_picture_is_not_a_new_one(queue: Queue, camera: Camera) -> None:
    """A hanging decoder repeats its last image; its platform would be measured as at rest."""
    queue.repeats = 4
    queue.take(OPENING)
    with LiveCamera("0", camera, queue.clock) as live:
        queue.take(6)
        queue.wait_until_read()
        frame = live.read()
        assert (int(frame.image[0, 0]), frame.name) == (204, "image 204")
        assert frame.time == pytest.approx(2.04)
        queue.take(2)
        queue.wait_until_read()
        assert live.read().name == "image 208"
        queue.unplug()


def test_images_that_waited_are_skipped(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a pause of 1 s at 100 images/s, a hundred come at once: nobody knows their times."""
    read_at = [k / 100.0 for k in range(300)]  # taken at the same times
    read_at += [4.0 + 1e-3 * k for k in range(100)]
    read_at += [k / 100.0 for k in range(411, 500)]
    monkeypatch.setattr(queue, "clock", lambda: read_at[max(0, queue._taken - 1)])
    queue.take(OPENING)
    with LiveCamera("0", camera, queue.clock) as live:
        queue.take(400 - OPENING)
        queue.wait_until_read()
        frame = live.read()
        assert (frame.name, frame.time) == ("image 299", pytest.approx(2.99))
        queue.take(60)
        queue.wait_until_read()
        frame = live.read()
        assert (frame.name, frame.time) == ("image 459", pytest.approx(4.70))
        queue.unplug()


def test_images_that_waited_have_their_times_if_the_driver_states_them(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same pause with V4L2: the newest is used, whether it waited or not."""
    read_at = [k / 100.0 for k in range(300)]
    read_at += [4.0 + 1e-3 * k for k in range(100)]
    read_at += [k / 100.0 for k in range(411, 500)]
    monkeypatch.setattr(queue, "clock", lambda: read_at[max(0, queue._taken - 1)])
    monkeypatch.setattr(queue, "backend", "V4L2")
    queue.take(OPENING)
    with LiveCamera("0", camera, queue.clock) as live:
        for number in (299, 310, 380, 399):
            queue.take(number + 1 - queue._come)
            queue.wait_until_read()
            frame = live.read()
            assert (frame.name, frame.time) == (f"image {number}", pytest.approx(number / 100.0))
        assert live.late == 0
        queue.unplug()


def test_a_camera_without_an_image_on_time_is_lost(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queue, "clock", lambda: 0.2 * queue._taken + 0.15 * (queue._taken % 2))
    queue.take(round(5 * FROZEN) + 2)
    with pytest.raises(
        HardwareMissing, match=f"delivered no image on time for {FROZEN:g} s"
    ) as caught:
        LiveCamera("0", camera, queue.clock)
    assert "too unevenly" in caught.value.why
    assert "a cable instead of Wi-Fi, or a fixed exposure" in caught.value.next_step
    assert queue.released


def test_a_camera_whose_times_are_not_needed_is_used_from_its_first_image(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At rest it does not matter when an image was taken."""
    monkeypatch.setattr(queue, "clock", lambda: 0.2 * queue._taken + 0.15 * (queue._taken % 2))
    queue.take(1)
    with LiveCamera("0", camera, queue.clock, needs_times=False) as live:
        for number in (5, 400, 900):
            queue.take(number + 1 - queue._come)
            queue.wait_until_read()
            assert live.read().name == f"image {number}"
        queue.unplug()


def test_a_camera_that_repeats_one_picture_for_long_is_lost(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small one: it takes thousands of images."""
    camera = replace(camera, width=64, height=48)
    monkeypatch.setattr(queue, "_shape", (48, 64, 3))
    queue.repeats = 100_000
    queue.take(OPENING)
    with LiveCamera("7", camera, queue.clock) as live:
        queue.take(round(100 * FROZEN) + 2)
        with pytest.raises(Fault, match=f"the same image for {FROZEN:g} s") as caught:
            live.read()
    assert caught.value.where == f"camera {camera.name} (7)"
    assert "lens" in caught.value.why
    assert queue.released


def test_a_lost_camera_is_reported_by_its_name_and_source(queue: Queue, camera: Camera) -> None:
    queue.take(OPENING)
    with LiveCamera("7", camera, queue.clock) as live:
        queue.unplug()
        with pytest.raises(Fault, match=f"{LOST_IMAGES} times in a row") as caught:
            live.read()
    assert caught.value.where == f"camera {camera.name} (7)"
    assert "lens" not in caught.value.why


def test_a_camera_without_images_or_of_another_size_is_released(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue.unplug()
    with pytest.raises(HardwareMissing, match="failed to deliver an image"):
        LiveCamera("0", camera, queue.clock)
    assert queue.released
    monkeypatch.setattr(queue, "released", False)
    monkeypatch.setattr(queue, "_shape", (4, 5, 3))
    queue.take(OPENING)
    small = replace(camera, name="side", width=5, height=4)
    with pytest.raises(BadInput, match="5 x 4 px") as caught:
        LiveCamera("0", camera, queue.clock, cameras=(camera, small))
    assert "exchange the sources of cameras 'front' and 'side'" in caught.value.next_step
    assert queue.released


def test_a_camera_without_images_can_be_stopped(
    queue: Queue, camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before its first image, and afterwards; it hangs in neither case for the operator."""
    monkeypatch.setattr(drivers.cameras.frame_reader, "ROUND", 1e-3)
    monkeypatch.setattr(drivers.cameras.frame_reader, "END_TIMEOUT", 0.0)  # it hangs
    hanging = Queue(camera)
    monkeypatch.setattr(drivers.cameras.live, "_opened", {0: queue, 1: hanging}.__getitem__)
    with pytest.raises(StoppedByOperator, match="stopped before"):
        LiveCamera("1", camera, hanging.clock, stopped=lambda: True)
    hanging.unplug()
    queue.take(OPENING)
    request = threading.Event()
    with LiveCamera("0", camera, queue.clock, stopped=request.is_set) as live:
        request.set()
        assert list(live) == []


def test_a_camera_that_does_not_open_can_be_stopped(
    camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening an address waits half a minute for its server."""
    answered, made = threading.Event(), Queue(camera)

    def opened(_source: int | str) -> Queue:
        answered.wait()
        return made

    monkeypatch.setattr(drivers.cameras.live, "_opened", opened)
    monkeypatch.setattr(drivers.cameras.frame_reader, "END_TIMEOUT", 0.0)
    with pytest.raises(StoppedByOperator):
        LiveCamera("http://[::1]/x", camera, made.clock, stopped=lambda: True)
    (reader,) = [one for one in threading.enumerate() if one.name == "cdpr-pictures"]
    answered.set()
    reader.join()
    assert made.released


def test_no_thread_is_left_without_a_close(queue: Queue, camera: Camera) -> None:
    queue.take(OPENING)
    live = LiveCamera("0", camera, queue.clock)
    queue.take(1)
    assert next(iter(live)).name == "image 201"
    queue.unplug()
    del live
    assert queue.released
