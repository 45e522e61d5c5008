"""Images of a video and of a camera."""

from __future__ import annotations

import os
import struct
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput, Fault, HardwareMissing
from model.rig import Camera

# The newest image of a camera that takes them faster than anybody asks for them.
#
# A camera's images wait in queues: of the network, of its driver, of the decoder. Who takes
# one of three falls behind by the other two, and measures an ever older platform. So a thread takes
# them all, as they come, and keeps the last.


#: Images a camera may fail to give in a row before it counts as gone.
LOST_PICTURES = 5
#: A camera that is being read is waited for no longer than this when it is let go of, [s].
END_TIMEOUT = 2.0


class Capture(Protocol):
    """What gives images, such as `cv2.VideoCapture`."""

    def read(self) -> tuple[bool, Any]:
        """The next image in the queue, waited for; False and nothing where there is none."""
        ...

    def release(self) -> None:
        """Lets go of the camera."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """An image as it came.

    Attributes:
        number: Of the camera's images, from 0; those not requested count.
        time: When it arrived, on the reader's clock, [s].
        picture: As the camera gave it.
    """

    number: int
    time: float
    picture: NDArray[np.generic]


class PictureReader:
    """Takes all images of a camera in a thread of its own."""

    def __init__(self, capture: Capture, clock: Callable[[], float]) -> None:
        """Begins to read.

        Args:
            capture: Read and let go of by the thread alone.
            clock: Monotonic time, [s].
        """
        self._capture, self._clock = capture, clock
        self._changed = threading.Condition()
        self._newest: Arrived | None = None
        self._ended = self._told_to_end = False
        self._thread = threading.Thread(target=self._read, name="cdpr-pictures", daemon=True)
        self._thread.start()

    def newest(self) -> Arrived | None:
        """The newest image, each only once; waited for.

        Returns:
            None when the camera gives no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._ended)
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        """Ends the reading; a camera that hangs is left to the end of this process."""
        self._told_to_end = True
        if threading.current_thread() is not self._thread:
            self._thread.join(END_TIMEOUT)

    def _read(self) -> None:
        number = failed = 0
        try:
            while failed < LOST_PICTURES and not self._told_to_end:
                good, picture = self._capture.read()
                now = self._clock()
                failed = 0 if good else failed + 1
                if good:
                    self._put(Arrived(number, now, np.asarray(picture)))
                    number += 1
        finally:
            self._capture.release()
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _put(self, arrived: Arrived) -> None:
        with self._changed:
            self._newest = arrived
            self._changed.notify_all()


# The size that an image file states, read before anything is decoded.
#
# Source: PNG specification (W3C), 11.2.1; JPEG, ITU-T T.81, annex B; BMP,
# Microsoft's BITMAPINFOHEADER.


MOST_PIXELS = 2**28
"""Of an image; more than any camera of this field has, and a quarter of a gigabyte in grey."""

_NO_SIZE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a PNG, JPEG or BMP file, [px]; None of another or a broken one."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", data, 16)
        elif data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        elif data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
        else:
            return None
    except struct.error:
        return None
    return abs(width), abs(height)


def is_too_large(data: bytes) -> bool:
    """Whether an image states more pixels than are decoded; other kinds OpenCV limits itself."""
    size = stated_size(data)
    return size is not None and size[0] * size[1] > MOST_PIXELS


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """Goes from marker to marker up to the first frame header."""
    at = 2
    while True:
        sign, marker = struct.unpack_from(">BB", data, at)
        if sign != 0xFF:
            return None
        at += 2 if marker != 0xFF else 1
        if marker == 0xFF or marker in _NO_SIZE:
            continue
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 3)
            return int(width), int(height)
        (length,) = struct.unpack_from(">H", data, at)
        at += max(2, length)


Image = NDArray[np.uint8]
LAST_CAMERA = 255
"""Index of the last camera that Linux numbers; OpenCV reads larger ones as other drivers' ports."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    Attributes:
        time: When it was taken, [s]; since the first image for files.
        image: Grey, shape (height, width).
        name: File name, or number in the video or of the camera.
    """

    time: float
    image: Image
    name: str


class VideoFile:
    """The images of a video.

    Args:
        path: The file.
        camera: The camera that took it.

    Raises:
        BadInput: The file is missing or no video.
    """

    def __init__(self, path: Path, camera: Camera) -> None:
        if not path.is_file():
            raise BadInput("no such file", where=str(path), next_step="check the path")
        self._path, self._camera = path, camera
        capture = _opened(str(path))
        if not capture.isOpened():
            raise BadInput(
                "the file is not a readable video",
                where=str(path),
                next_step="convert it, for example with ffmpeg to MJPEG or H.264",
            )
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self._count = max(0, int(count)) if 0 <= count < 1e9 else 0
        width, height = (
            capture.get(cv2.CAP_PROP_FRAME_WIDTH),
            capture.get(cv2.CAP_PROP_FRAME_HEIGHT),
        )
        capture.release()
        if width * height > MOST_PIXELS:
            raise BadInput(
                f"the video states images of {width:.0f} x {height:.0f} px",
                where=str(path),
                why="the file is damaged",
                next_step="use another file",
            )

    def __len__(self) -> int:
        """Number of images as the file states it, for progress."""
        return self._count

    def __iter__(self) -> Iterator[Frame]:
        """Every image.

        Raises:
            BadInput: They are not of the camera's size, or none can be read.
        """
        capture = _opened(str(self._path))
        rate = capture.get(cv2.CAP_PROP_FPS)
        rate = rate if np.isfinite(rate) and rate > 0 else self._camera.rate
        number = 0
        try:
            while True:
                good, picture = capture.read()
                if not good:
                    break
                image = _grey(np.asarray(picture))
                if number == 0:
                    refuse_wrong_size(image, self._camera, str(self._path))
                yield Frame(number / rate, image, f"image {number}")
                number += 1
        finally:
            capture.release()
        if number == 0:
            raise BadInput("the video has no readable image", where=str(self._path))


class LiveCamera:
    """A camera on this machine or on the network; it answers with its newest image.

    Args:
        source: Its index, such as ``0``, its device file or its address.
        camera: What the rig file says about it.
        clock: Monotonic time, [s].

    Raises:
        HardwareMissing: It does not open or gives no image.
        BadInput: It gives images of another size.
    """

    def __init__(
        self, source: int | str, camera: Camera, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = f"camera {live_name(camera.name, str(source))}"
        self._seen = False
        numbered = isinstance(source, int) or source.isdecimal()
        if numbered and (len(str(source)) > 9 or int(source) > LAST_CAMERA):
            raise BadInput(
                f"there is no camera with index {str(source)[:40]}",
                where=self.name[:100],
                next_step=f"give an index from 0 to {LAST_CAMERA}; `ls /dev/video*` lists them",
            )
        capture = _opened(int(source) if numbered else str(source))
        if not capture.isOpened():
            capture.release()
            raise HardwareMissing(
                "the camera cannot be opened",
                where=self.name,
                why="it is not connected, another program uses it, or you may not read it",
                next_step="check the cable and `ls -l /dev/video*`, close other programs, or name"
                " another camera",
            )
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
        self._reader = PictureReader(capture, clock)
        # A caller that only iterates closes nothing, and the thread must not outlive it.
        self._let_go = weakref.finalize(self, self._reader.close)
        try:
            refuse_wrong_size(self.read().image, camera, self.name)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> LiveCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        """Images without end; those that came while one was looked at are left out.

        Raises:
            Fault: The camera stopped giving images.
        """
        while True:
            yield self.read()

    def read(self) -> Frame:
        """The newest image that was not read before, with the time at which it arrived.

        It may have arrived before this was called.

        Raises:
            HardwareMissing: It never gave an image.
            Fault: It stopped giving images.
        """
        arrived = self._reader.newest()
        if arrived is not None:
            self._seen = True
            return Frame(arrived.time, _grey(arrived.picture), f"image {arrived.number}")
        kind = Fault if self._seen else HardwareMissing
        raise kind(
            f"the camera delivered no image {LOST_PICTURES} times in a row",
            where=self.name,
            why="it was unplugged, or its USB bus is too slow for its images",
            next_step="check the cable, then start again",
        )

    def close(self) -> None:
        """Lets go of the camera."""
        self._let_go()


def live_name(camera: str, source: str) -> str:
    """A camera of the rig file and where its images come from, such as ``side (0)``."""
    return source if camera == source else f"{camera} ({source})"


def refuse_wrong_size(image: Image, camera: Camera, where: str) -> None:
    """Images of another size than the camera was calibrated for would measure wrongly.

    Raises:
        BadInput: The size is another one.
    """
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        raise BadInput(
            f"the image has {width} x {height} px, camera {camera.name!r} has {camera.width} x"
            f" {camera.height} px",
            where=where,
            why="it is from another camera, or was cropped or scaled",
            next_step="use full-size images of this camera, or calibrate it at this size",
        )


def video_size(path: Path) -> tuple[int, int]:
    """Width and height of a video's images, [px]; nought of a file that is none."""
    capture = _opened(str(path))
    try:
        width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
        return int(capture.get(width)), int(capture.get(height))
    finally:
        capture.release()


def _opened(source: int | str) -> cv2.VideoCapture:
    """Opens quietly: what OpenCV and FFmpeg print about it, our own message says better."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(source)
    finally:
        cv2.utils.logging.setLogLevel(before)


def _grey(picture: NDArray[np.generic]) -> Image:
    if picture.ndim == 3:
        return np.asarray(cv2.cvtColor(picture.astype(np.uint8), cv2.COLOR_BGR2GRAY), np.uint8)
    return picture.astype(np.uint8)
