"""Images of a video file and of a live camera."""

from __future__ import annotations

import os
import re
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.frame_reader import (
    NOT_ON_TIME,
    NOT_OPENED,
    SAME,
    TRUNCATED,
    FrameReader,
    silent_opencv,
)
from model.cameras import Camera, cause_of_size
from model.errors import BadInput, Fault, HardwareMissing, StoppedByOperator, without_passwords
from model.files.reading import MOST_PIXELS, require_one_page

Image = NDArray[np.uint8]
LAST_CAMERA = 255
"""Largest camera index on Linux; OpenCV takes larger numbers as ports of other drivers."""

ADDRESSES = ("http", "https", "rtsp", "rtsps", "rtmp", "rtmps", "rtp", "srt", "tcp", "udp")
"""Kinds of address at which FFmpeg, with which OpenCV reads them, can find a video."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    Attributes:
        time: Middle of the exposure, [s]; of a live camera on its clock, of files since the first
            image.
        image: Grey, shape (height, width).
        name: File name, or number in the video or of the camera.
        number: In the source, from 0, counting also images that are skipped or cannot be read.
    """

    time: float
    image: Image
    name: str
    number: int = 0


class FrameSource:
    """Images of one camera; a context manager that closes them."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Releases what stays open between images: nothing for files."""


#: Begin of a file without times, for which FFmpeg assumes 25 images per second: JPEG images one
#: after the other, also with HTTP headers, or H.264 or H.265 as the encoder delivers it (start code
#: and a NAL unit, ITU-T H.264, annex B). MPEG streams of other kinds have larger numbers there. A
#: box of an MP4 or MOV file begins with its size in four bytes, which may look like a start code.
_NO_TIMES = re.compile(rb"\xff\xd8|\s*--|\x00{2,}\x01(?!mdat|.(?:ftyp|moov))[\x00-\x7f]", re.DOTALL)
#: Begin of a file that lists its images, AVI or MP4; elsewhere FFmpeg estimates their number.
_LISTED = re.compile(rb"(RIFF)|....(?:ftyp|moov|mdat|wide|free|skip)", re.DOTALL)
_ATTEMPTS = 25  # to read the next image before the video counts as over: a part may be damaged


class VideoFile(FrameSource):
    """The images of a video file.

    Args:
        path: The file.
        camera: The camera that took it.
        rate: Images per second of a file that states no times (default: the camera's), [Hz].
        cameras: Of the rig, to name the one whose images these seem to be.

    Attributes:
        rate: Images per second that the file states (default: as given), [Hz].
        remark: That a rate was assumed, for the operator; empty if the file states its times or
            `rate` was given.
        unused: How many images could not be read, and why; empty until all were read.

    Raises:
        BadInput: The file is missing, or is not a video, or is an image of several pages; its
            images have to be rotated by 90°, and the camera has a rolling shutter; a rate is given
            for a file that states its times.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        rate: float | None = None,
        cameras: Sequence[Camera] = (),
    ) -> None:
        if not path.is_file():
            raise BadInput("no such file", where=str(path), next_step="check the path")
        self._path, self._camera, self._cameras = path, camera, cameras
        if path.suffix.lower() in (".tif", ".tiff"):
            require_one_page(path)
        capture = _opened_video(path, camera)
        if not capture.isOpened():
            raise BadInput(
                "the file is not a readable video",
                where=str(path),
                next_step="convert it, for example with ffmpeg to MJPEG or H.264",
            )
        count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self._count = max(0, int(count)) if 0 <= count < 1e9 else 0
        self.unused: dict[str, str] = {}
        self._set_rate(capture.get(cv2.CAP_PROP_FPS), rate)
        width, height = _size(capture)
        capture.release()
        if width * height > MOST_PIXELS:
            raise BadInput(
                f"the video states images of {width} x {height} px",
                where=str(path),
                why="the file is damaged",
                next_step="use another file",
            )

    def _set_rate(self, stated: float, given: float | None) -> None:
        with self._path.open("rb") as file:
            head = file.read(64)
        self._has_times, self._listed = _NO_TIMES.match(head) is None, _LISTED.match(head)
        if self._has_times and given is not None:
            raise BadInput(
                "a rate can be given for a folder of images, or a video without times",
                where=str(self._path),
                next_step="leave the rate out: this video states its times",
            )
        is_stated = self._has_times and np.isfinite(stated) and stated > 0
        self.rate = stated if is_stated else given or self._camera.rate
        self.remark = ""
        if not (self._has_times or given or self._count == 1):
            self.remark = (
                f"{self._path.name} states no times: its images are taken as {self.rate:.6g} per"
                f" second, the rate_hz of camera {self._camera.name}; if that is wrong, state it"
                f" in a container: ffmpeg -r RATE -i {self._path.name} -c copy video.mp4"
            )

    def __len__(self) -> int:
        """Number of images that the file states, for progress."""
        return self._count

    @cached_property
    def readable(self) -> int:
        """Number of its images, by reading all; the one that it states may be wrong."""
        return sum(1 for _ in self)

    def __iter__(self) -> Iterator[Frame]:
        """Yields every image.

        Raises:
            BadInput: They have another size than the camera, or none can be read.
        """
        capture = _opened_video(self._path, self._camera)
        number, seconds, begin, failed, lost = 0, -1.0 / self.rate, 0.0, 0, 0
        try:
            while failed < _ATTEMPTS:
                good, picture = capture.read()
                if not good:
                    failed += 1
                    continue
                failed, lost = 0, lost + failed
                image = _grey(np.asarray(picture))
                stated = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3  # the rate may vary
                if number == 0:
                    refuse_wrong_size(image, self._camera, str(self._path), self._cameras)
                    begin = stated if np.isfinite(stated) else 0.0  # not always 0
                shown = stated - begin
                is_later = self._has_times and np.isfinite(shown) and shown > seconds
                seconds = shown if is_later else seconds + 1.0 / self.rate
                yield Frame(seconds, image, f"image {number}", number)
                number += 1
        finally:
            capture.release()
        if number == 0:
            raise BadInput("the video has no readable image", where=str(self._path))
        if lost := max(lost, self._count - number if self._listed else 0):
            why = "could not be read: the file is damaged, incomplete, or cut without re-encoding"
            if self._listed and self._listed[1]:  # AVI states no times
                why += "; the times after the first of them may be too early"
            self.unused[f"{lost} of {number + lost} images of {self._path.name}"] = why


class LiveCamera(FrameSource):
    """A local or network camera that returns its newest image.

    If times are needed, it opens in about two seconds more than the device: its first images may
    have waited in queues.

    Args:
        source: Index, such as ``0``, device file or address.
        camera: Its description in the rig file.
        clock: Monotonic time, [s].
        stopped: Ends the images when true; called repeatedly while there is none.
        needs_times: Skips images whose times are unknown, as they may have waited; False for images
            of something at rest.
        cameras: Of the rig, to name the one whose images these seem to be.

    Raises:
        HardwareMissing: It does not open or delivers no image.
        BadInput: It delivers images of another size.
        StoppedByOperator: Stopped before the first image.
    """

    def __init__(
        self,
        source: int | str,
        camera: Camera,
        clock: Callable[[], float] = time.monotonic,
        stopped: Callable[[], bool] = lambda: False,
        *,
        needs_times: bool = True,
        cameras: Sequence[Camera] = (),
    ) -> None:
        self.name = f"camera {live_name(camera.name, str(source))}"
        self._stopped, self._seen, self._camera, self._cameras = stopped, 0, camera, cameras
        self._is_address = "://" in str(source)
        numbered = isinstance(source, int) or source.isdecimal()
        _require_possible(str(source), self.name[:100])

        def opened() -> cv2.VideoCapture:
            capture = _opened(int(source) if numbered else str(source))
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
            return capture

        self._reader = FrameReader(opened, clock, needs_times=needs_times)
        # A caller that only iterates does not close it, and the thread must not outlive it.
        self._finalizer = weakref.finalize(self, self._reader.close)
        try:
            self.read()
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Iterator[Frame]:
        """Yields images until stopped; those that arrive late or during processing are skipped.

        Raises:
            Fault: The camera stopped delivering images.
        """
        with suppress(StoppedByOperator):
            while True:
                yield self.read()

    def read(self) -> Frame:
        """The newest unread image with its time, the camera's latency before it arrived.

        Raises:
            HardwareMissing: The camera never delivered an image.
            Fault: It stopped delivering images.
            BadInput: The image has another size.
            StoppedByOperator: Stopped before the next image.
        """
        arrived = self._reader.newest(self._stopped)
        if arrived is not None:
            self._seen += 1
            number, image = arrived.number, _grey(arrived.picture)
            refuse_wrong_size(image, self._camera, self.name, self._cameras)
            return Frame(arrived.time - self._camera.latency, image, f"image {number}", number)
        if self._stopped():
            what = "stopped before the camera delivered an image"
            raise StoppedByOperator(what, where=self.name)
        why, next_step = _likely_cause(self._reader.lost, self._is_address, self._seen)
        kind = Fault if self._seen else HardwareMissing
        what = f"the camera {self._reader.lost or 'delivers no more images'}"
        raise kind(what, where=self.name, why=why, next_step=next_step)

    @property
    def late(self) -> int:
        """Number of images skipped after the first, as they may have waited in a queue."""
        return self._reader.late

    @property
    def truncated(self) -> int:
        """Number of images skipped after the first, as they were truncated."""
        return self._reader.truncated

    def close(self) -> None:
        """Releases the camera."""
        self._finalizer()


def _require_possible(source: str, where: str) -> None:
    """Refuses an index or an address that no camera can have."""
    kind, is_address, rest = source.partition("://")
    port = re.match(r"[^/?#]*:(\d+)(?![^/?#])", rest)
    if source.isdecimal() and (len(source) > 9 or int(source) > LAST_CAMERA):
        what = f"there is no camera with index {source[:40]}"
        next_step = f"give an index from 0 to {LAST_CAMERA}; `ls /dev/video*` lists them"
    elif is_address and kind.lower() not in ADDRESSES:
        what = f"no camera has an address that begins with {kind[:40]}://"
        known = f"{', '.join(ADDRESSES[:-1])} or {ADDRESSES[-1]}"
        next_step = f"take the address from the camera's manual: it begins with {known}"
    elif port is not None and not 0 < int(port[1][:9]) <= 65535:
        what, next_step = "the address has a port that does not exist", "give one from 1 to 65535"
    else:
        return
    raise BadInput(what, where=where, next_step=next_step)


def _likely_cause(lost: str, is_address: bool, seen: int) -> tuple[str, str]:
    """Why a camera may deliver no images, and the next step.

    Args:
        lost: As `FrameReader` has it.
        is_address: It is a network camera.
        seen: Number of images that were used.
    """
    if lost == NOT_ON_TIME:
        return (
            "its images come too unevenly for their times to be known",
            "use a cable instead of Wi-Fi, or a fixed exposure",
        )
    if lost == TRUNCATED:
        return (
            "the camera or the network is overloaded, or the camera is defective",
            "lower its rate or the size of its images, or use a cable instead of Wi-Fi",
        )
    if is_address and lost == NOT_OPENED:
        return (
            "the address, user or password is wrong, the camera is off or cannot be reached, or it"
            " delivers no video that OpenCV can read",
            "open the address on this computer (http:// in a browser, rtsp:// in a player such as"
            " VLC) and correct it, or set the camera to MJPEG or H.264",
        )
    if lost == SAME:
        return (
            "it or its driver hangs, or its lens is covered",
            "check its lens, and switch it off and on, then start again",
        )
    if is_address and seen <= 1:
        return (
            "the address is that of a single image, not of a video, the camera hangs or was"
            " switched off, or the network is interrupted",
            "take the address of the video from the camera's manual, and check its power and"
            " network",
        )
    if is_address:
        return (
            "it hangs or was switched off, or the network is interrupted",
            "check its power and network, and open the address on this computer (http:// in a"
            " browser, rtsp:// in a player such as VLC), then start again",
        )
    if lost == NOT_OPENED:
        return (
            "it is not connected, another program uses it, or you may not read it",
            "check the cable and `ls -l /dev/video*`, close other programs, or name another camera",
        )
    return (
        "it was unplugged or hangs, or its USB bus is too slow",
        "check the cable, then start again",
    )


def live_name(camera: str, source: str) -> str:
    """Name and source of a camera for people, such as ``side (0)``; without a password."""
    shown = without_passwords(source)
    return shown if camera == source else f"{camera} ({shown})"


def refuse_wrong_size(image: Image, camera: Camera, where: str, cameras: Sequence[Camera]) -> None:
    """Refuses an image that has not the size for which the camera was calibrated.

    Args:
        cameras: Of the rig, to name the one whose image it seems to be.

    Raises:
        BadInput: The size differs.
    """
    height, width = image.shape
    if (width, height) != (camera.width, camera.height):
        why, next_step = cause_of_size(camera, [(width, height)], cameras)
        raise BadInput(
            f"the image has {width} x {height} px, camera {camera.name!r} has {camera.width} x"
            f" {camera.height} px",
            where=where,
            why=why,
            next_step=next_step,
        )


def video_size(path: Path) -> tuple[int, int]:
    """Width and height of a video's images as it is shown, [px]; zero if it is not a video."""
    capture = _opened(str(path))
    try:
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        return _size(capture)
    finally:
        capture.release()


def _opened_video(path: Path, camera: Camera) -> cv2.VideoCapture:
    """Opens a video, whose images are rotated as it states only if they need it for their size."""
    capture = _opened(str(path))
    if _size(capture) != (camera.width, camera.height):
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        if _size(capture) == (camera.width, camera.height):
            camera.require_unrotated(str(path))
    return capture


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    """Width and height of its images, [px]."""
    width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    return int(capture.get(width)), int(capture.get(height))


def _opened(source: int | str) -> cv2.VideoCapture:
    """Opens a source of images as stored, without the log output of OpenCV and FFmpeg."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with silent_opencv():
        capture = cv2.VideoCapture(source)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return capture


def _grey(picture: NDArray[np.generic]) -> Image:
    eight = eight_bits(picture)
    if eight.ndim == 3:
        return np.asarray(cv2.cvtColor(eight, cv2.COLOR_BGR2GRAY), np.uint8)
    return eight


def eight_bits(picture: NDArray[np.generic]) -> NDArray[np.uint8]:
    """An image with values of 8 bits, from one with the 8 to 16 bits that its brightest needs.

    Sensors of 10 and 12 bits deliver 16 bits, of which the upper ones are never set.
    """
    if picture.dtype == np.uint8:
        return np.asarray(picture, np.uint8)
    values = picture.astype(np.uint16)
    used = max(8, int(values.max(initial=0)).bit_length())
    return (values >> (used - 8)).astype(np.uint8)
