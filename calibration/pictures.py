"""Images that a calibration is made from: of a folder, a video, or a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2

from calibration.intrinsics.capture import CaptureGuide
from calibration.targets.board import Board, plain_camera
from drivers.cameras.files import ImageFolder, OneCamerasPictures
from drivers.cameras.live import Frame, LiveCamera, VideoFile, video_size
from executor.cameras.sources import require_camera_source
from model.errors import BadInput
from model.files.documents import write_bytes_atomic
from model.progress import SILENT, Listener
from model.rig import Camera
from tracking.camera_model import Image


@dataclass(frozen=True, slots=True)
class Pictures:
    """Images of one size.

    Attributes:
        images: Names and grey images.
        count: How many there will be.
        unused: Why files are not used, by name.
    """

    images: Iterable[tuple[str, Image]]
    count: int
    unused: Mapping[str, str] = field(default_factory=dict)

    @contextmanager
    def reported(self, text: str, listener: Listener) -> Iterator[Iterator[tuple[str, Image]]]:
        """The images, each reported when it was used."""
        with listener.progress(text, self.count) as advance:
            yield self._advancing(advance)

    def _advancing(self, advance: Callable[[float], None]) -> Iterator[tuple[str, Image]]:
        for number, picture in enumerate(self.images, 1):
            yield picture
            advance(number)


VIDEO_PICTURES = 80
"""Taken of a video that a camera is calibrated from, spread over it."""


def pictures_in(folder: Path) -> Pictures:
    """The pictures of a folder, all of one size, or of a video, spread over it.

    Raises:
        BadInput: The folder is missing or has no pictures, or the file is no video.
    """
    if folder.is_file():
        return _spread_over(VideoFile(folder, plain_camera(video_size(folder))), VIDEO_PICTURES)
    images = OneCamerasPictures(folder)
    return Pictures(images, len(images.names), images.unused)


def pictures_of(source: str | Path, camera: Camera, wanted: int | None, usual: int) -> Pictures:
    """The images of a source.

    Args:
        source: A folder, a video file, a camera's index or its address.
        camera: The rig's camera that took them.
        wanted: How many to take of a camera, or of a video, spread over it.
        usual: How many where that is left out.

    Raises:
        BadInput: It is none of these, its images are of another size, or a number is wanted of
            a folder.
        HardwareMissing: The camera does not open.
    """
    path, most = Path(source), wanted or usual
    if path.is_dir():
        if wanted is not None:
            raise BadInput(
                "--pictures is for a video or a camera",
                where=str(source),
                next_step="leave it out: all images of a folder are used",
            )
        folder = OneCamerasPictures(path, (camera.width, camera.height))
        return Pictures(folder, len(folder.names), folder.unused)
    if path.is_file():
        return _spread_over(VideoFile(path, camera), most)
    require_camera_source(str(source))
    return Pictures(_live(str(source), camera, most), most)


def timed_pictures(source: Path, camera: Camera, rate: float | None) -> Pictures:
    """All images of a folder or a video, which know when they were taken.

    Args:
        source: The folder, or the file.
        camera: The rig's camera that took them.
        rate: Images a second of a folder; the camera's when left out.

    Returns:
        The images; their names are times in seconds since the first, such as ``0.100 s a.png``.

    Raises:
        BadInput: It is neither, or its images are of another size.
    """
    if source.is_dir():
        folder = ImageFolder(source, camera, rate)
        return Pictures(_named_by_time(folder), len(folder), folder.unused)
    if rate is not None:
        raise BadInput(
            "--rate-hz is for a folder of images",
            where=str(source),
            next_step="leave it out: a video states its rate",
        )
    video = VideoFile(source, camera)
    return Pictures(_named_by_time(video), len(video))


def _named_by_time(frames: Iterable[Frame]) -> Iterator[tuple[str, Image]]:
    return ((f"{frame.time:.6f} s {frame.name}", frame.image) for frame in frames)


def _spread_over(video: VideoFile, most: int) -> Pictures:
    every = max(1, -(-len(video) // most))
    frames = (frame for number, frame in enumerate(video) if number % every == 0)
    return Pictures(((f.name, f.image) for f in frames), -(-len(video) // every))


def _live(source: str, camera: Camera, most: int) -> Iterable[tuple[str, Image]]:
    with LiveCamera(source, camera) as live:
        for _ in range(most):
            frame = live.read()
            yield frame.name, frame.image


def take_pictures(
    source: str,
    folder: Path,
    board: Board,
    *,
    wanted: int = 40,
    size: tuple[int, int] = (1280, 720),
    on_advice: Callable[[str], None] = SILENT.note,
    stopped: Callable[[], bool] = lambda: False,
) -> int:
    """Takes images of a board that is moved, until enough are there or the video ends.

    Args:
        source: A camera's index, device or address, or a video file.
        folder: Where images go, which exists.
        board: What is shown.
        wanted: How many images at least.
        size: Width and height of the camera's images, [px]; a video has its own.
        on_advice: Receives what the person who moves the board should do, when that changes.
        stopped: Whether to take no more; asked after each image.

    Returns:
        How many were taken.

    Raises:
        HardwareMissing: The camera does not open.
        BadInput: The source is none, its images are of another size, or none was taken.
    """
    guide, last = CaptureGuide(board, wanted), ""
    with _frames(source, size) as frames:
        for image in frames:
            if stopped():
                break
            advice = guide.look(image)
            if advice.taken:
                data = cv2.imencode(".png", image)[1].tobytes()
                write_bytes_atomic(folder / f"live_{len(guide.views):03}.png", data)
                on_advice(guide.drawn())
            if advice.text != last:
                last = advice.text
                on_advice(last)
            if advice.done:
                break
    if not guide.views:
        raise BadInput(
            "no image was captured",
            where=f"camera {source}",
            why=f"{board} was never detected at rest",
            next_step="check the board's kind, its dimensions and the light, and hold it still",
        )
    return len(guide.views)


@contextmanager
def _frames(source: str, size: tuple[int, int]) -> Iterator[Iterator[Image]]:
    """Grey images of a camera or a video."""
    path = Path(source)
    if path.is_file():
        yield (frame.image for frame in VideoFile(path, plain_camera(video_size(path), source)))
        return
    with LiveCamera(source, plain_camera(size, source)) as live:
        yield (frame.image for frame in live)
