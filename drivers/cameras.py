"""Pictures of a video and of a camera."""

from __future__ import annotations

import os
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput, Fault, HardwareMissing
from cdpr.rig import Camera
from drivers.newest_picture import LOST_PICTURES, PictureReader

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture.

    Attributes:
        time: When it was taken, [s]; since the first picture for files.
        image: Grey, shape (height, width).
        name: File name, or number in the video or of the camera.
    """

    time: float
    image: Image
    name: str


class VideoFile:
    """The pictures of a video.

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
                "the file is no video that can be read",
                where=str(path),
                next_step="convert it, for example with ffmpeg to MJPEG or H.264",
            )
        self._count = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        capture.release()

    def __len__(self) -> int:
        """Number of pictures as the file states it, for progress."""
        return self._count

    def __iter__(self) -> Iterator[Frame]:
        """Every picture.

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
                yield Frame(number / rate, image, f"picture {number}")
                number += 1
        finally:
            capture.release()
        if number == 0:
            raise BadInput("the video has no picture that can be read", where=str(self._path))


class LiveCamera:
    """A camera on this machine or on the network; it answers with its newest picture.

    Args:
        source: Its index, such as ``0``, its device file or its address.
        camera: What the rig file says about it.
        clock: Monotonic time, [s].

    Raises:
        HardwareMissing: It does not open or gives no picture.
        BadInput: It gives pictures of another size.
    """

    def __init__(
        self, source: int | str, camera: Camera, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.name = f"camera {live_name(camera.name, str(source))}"
        self._seen = False
        numbered = isinstance(source, int) or source.isdecimal()
        capture = _opened(int(source) if numbered else str(source))
        if not capture.isOpened():
            capture.release()
            raise HardwareMissing(
                "the camera cannot be opened",
                where=self.name,
                why="it is not connected, another program uses it, or you may not read it",
                next_step="check the cable and `ls -l /dev/video*`, close other programs, or pass"
                " another camera",
            )
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
        self._reader = PictureReader(capture, clock)
        # Whoever only iterates over it closes nothing, and its thread must not outlive it.
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
        """Pictures without end; those that came while one was looked at are left out.

        Raises:
            Fault: The camera stopped giving pictures.
        """
        while True:
            yield self.read()

    def read(self) -> Frame:
        """The newest picture that was not read before, with the time at which it arrived.

        It may have arrived before this was called.

        Raises:
            HardwareMissing: It never gave a picture.
            Fault: It stopped giving pictures.
        """
        arrived = self._reader.newest()
        if arrived is not None:
            self._seen = True
            return Frame(arrived.time, _grey(arrived.picture), f"picture {arrived.number}")
        kind = Fault if self._seen else HardwareMissing
        raise kind(
            f"the camera gave no picture {LOST_PICTURES} times in a row",
            where=self.name,
            why="it was unplugged, or the bus it hangs on is too slow for its pictures",
            next_step="check the cable, then start again",
        )

    def close(self) -> None:
        """Lets go of the camera."""
        self._let_go()


def live_name(camera: str, source: str) -> str:
    """A camera of the rig file and where its pictures come from, such as ``side (0)``."""
    return source if camera == source else f"{camera} ({source})"


def refuse_wrong_size(image: Image, camera: Camera, where: str) -> None:
    """Pictures of another size than the camera was calibrated for would measure wrongly.

    Raises:
        BadInput: The size is another one.
    """
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        raise BadInput(
            f"the picture has {width} x {height} px, camera {camera.name!r} has {camera.width} x"
            f" {camera.height} px",
            where=where,
            why="it is of another camera, or was cut or scaled",
            next_step="use full pictures of this camera, or calibrate it in this size",
        )


def video_size(path: Path) -> tuple[int, int]:
    """Width and height of a video's pictures, [px]; nought of a file that is none."""
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
