"""Images for a calibration, from a folder, a video or a camera.

A live camera captures an image when the board is at rest and adds something new: an image region
or a tilt not covered yet, or a position far from all others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from calibration.targets.boards import Board, DetectedBoard
from drivers.cameras.files import IMAGE_ENDINGS, SingleCameraImages
from drivers.cameras.live import LiveCamera, VideoFile, video_size
from executor.cameras.sources import require_camera_source
from model.cameras import generic_camera
from model.errors import BadInput, path_of
from model.files.documents import write_bytes_atomic
from model.files.output import make_folder
from model.files.reading import files_in, is_folder
from model.pose import Array
from model.progress import SILENT, Listener
from model.rig import Camera
from planner.settings import whole_number
from tracking.camera_model import Image, rms

STILL_PX = 0.7
"""RMS motion of the corners from one image to the next, for images of 1000 px."""
ENOUGH_TILT = 18.0
"""Required tilt to each side, [deg]."""
_FAR, _FAR_TILT = 0.12, 12.0
"""A view is new this far from all others: share of the image width, or rotation [deg]."""
_PARTS = (("left", "middle", "right"), ("top", "middle", "bottom"))
_AWAY = ("lower", "upper", "right", "left")
"""Edge of the board, as seen in the image, that a tilt moves away from the camera: − and + about
the image's x axis, then about its y axis."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One detection of the board.

    Attributes:
        seen: Its corners.
        middle: Mean of the corners, shape (2,), [px].
        tilt: Approximate tilt of the board's normal from the optical axis, towards the image's y
            and x axes, shape (2,), [deg].
        parts: Cells of a 3 x 3 grid over the image that it covers, (column, row).
    """

    seen: DetectedBoard
    middle: Array
    tilt: Array
    parts: frozenset[tuple[int, int]]


@dataclass(frozen=True, slots=True)
class Advice:
    """What to do next.

    Attributes:
        taken: Whether to keep this image.
        text: One sentence for the operator who moves the board.
        done: Whether there are enough images.
    """

    taken: bool
    text: str
    done: bool


@dataclass(slots=True)
class CaptureGuide:
    """Decides for each image whether to keep it.

    Attributes:
        board: The target to detect.
        wanted: Minimum number of images.
        views: Views kept so far.
    """

    board: Board
    wanted: int
    views: list[View] = field(default_factory=list)
    _last: DetectedBoard | None = None

    def judge(self, image: Image) -> Advice:
        """Decides whether to keep the next image.

        Args:
            image: Grey, all of one size.
        """
        before, self._last = self._last, self.board.find(image)
        if self._last is None:
            return self._advice(False, "show the board")
        size = (image.shape[1], image.shape[0])
        if before is None or not _still(before, self._last, size):
            return self._advice(False, "hold it still")
        view = _view(self._last, size)
        if is_new := self._is_new(view, size):
            self.views.append(view)
        return self._advice(is_new, self.missing() or "move it to another position and tilt it")

    def coverage_map(self) -> str:
        """Coverage so far in ASCII, for any terminal.

        Image regions where the board was seen are ``#``, others ``.``; beside them the tilts
        covered, by the edge of the board that was farther from the camera.
        """
        covered = {part for view in self.views for part in view.parts}
        rows = [" ".join("#" if (x, y) in covered else "." for x in range(3)) for y in range(3)]
        named = (name if self._is_tilted(k) else "-" for k, name in enumerate(_AWAY))
        lower, upper, right, left = named
        beside = (f"edges away: {upper}", f"            {left} {right}", f"            {lower}")
        return "\n".join(f"  {row}   {text}" for row, text in zip(rows, beside, strict=True))

    def _is_tilted(self, which: int) -> bool:
        """Whether an image shows the edge of index ``which`` in `_AWAY` tilted away."""
        axis, sign = which // 2, (-1.0, 1.0)[which % 2]
        return any(sign * view.tilt[axis] > ENOUGH_TILT for view in self.views)

    def missing(self) -> str:
        """The first coverage still missing, as an instruction; empty when complete."""
        covered = {part for view in self.views for part in view.parts}
        for part in sorted(product(range(3), range(3)), key=lambda p: (p == (1, 1), p[1], p[0])):
            if part not in covered:
                return f"bring the board to the {_name(part)} of the image"
        for which, name in enumerate(_AWAY):
            if not self._is_tilted(which):
                return f"tilt the board by 20° to 40°, its {name} edge away from the camera"
        return ""

    def _is_new(self, view: View, size: tuple[int, int]) -> bool:
        covered = {part for other in self.views for part in other.parts}
        return bool(view.parts - covered) or all(
            np.linalg.norm(view.middle - other.middle) > _FAR * size[0]
            or np.abs(view.tilt - other.tilt).max() > _FAR_TILT
            for other in self.views
        )

    def _advice(self, taken: bool, text: str) -> Advice:
        done = len(self.views) >= self.wanted and not self.missing()
        count = f"{len(self.views)} of {self.wanted} images"
        return Advice(taken, f"{count}: {'enough' if done else text}", done)


def _name(part: tuple[int, int]) -> str:
    """Such as ``top left``, ``left`` or ``middle``."""
    column, row = _PARTS[0][part[0]], _PARTS[1][part[1]]
    words = [word for word in (row, column) if word != "middle"]
    return " ".join(words) or "middle"


def _still(before: DetectedBoard, now: DetectedBoard, size: tuple[int, int]) -> bool:
    """Whether the corners common to both images are at rest."""
    earlier = {tuple(p): c for p, c in zip(before.points.tolist(), before.corners, strict=True)}
    pairs = [
        corner - earlier[tuple(point)]
        for point, corner in zip(now.points.tolist(), now.corners, strict=True)
        if tuple(point) in earlier
    ]
    if len(pairs) < len(now.points) / 2:
        return False
    motion = float(rms(np.array(pairs)))
    return motion < STILL_PX * size[0] / 1000.0


def _view(seen: DetectedBoard, size: tuple[int, int]) -> View:
    cells = np.clip((seen.corners / size * 3.0).astype(int), 0, 2)
    return View(
        seen,
        np.asarray(seen.corners.mean(axis=0)),
        _tilt(seen, size),
        frozenset((int(column), int(row)) for column, row in cells),
    )


def _tilt(seen: DetectedBoard, size: tuple[int, int]) -> Array:
    """Approximate tilt, assuming a typical lens, shape (2,), [deg]."""
    camera = generic_camera(size)
    _, turn, _ = cv2.solvePnP(seen.points, seen.corners, camera.matrix, camera.distortion)
    normal = cv2.Rodrigues(turn)[0][:, 2]
    normal = normal * (-1.0 if normal[2] < 0.0 else 1.0)
    return np.asarray(np.degrees(np.arctan2(normal[[1, 0]], normal[2])), dtype=np.float64)


# Image sources.


@dataclass(frozen=True, slots=True)
class ImageSet:
    """Images of one size, opened but not read yet.

    Attributes:
        images: Names and grey images.
        count: Number of images.
        unused: Reason for each file left out, by name.
        video: The video of which they are a sample.
        is_live: They are taken by a camera while they are read.
    """

    images: Iterable[tuple[str, Image]]
    count: int
    unused: Mapping[str, str] = field(default_factory=dict)
    video: VideoFile | None = None
    is_live: bool = False

    @contextmanager
    def reported(self, text: str, listener: Listener) -> Iterator[Iterator[tuple[str, Image]]]:
        """Iterates over the images and reports progress after each."""
        with listener.progress(text, self.count) as advance:
            yield self._advancing(advance)

    def _advancing(self, advance: Callable[[float], None]) -> Iterator[tuple[str, Image]]:
        for number, picture in enumerate(self.images, 1):
            yield picture
            advance(number)


ImageSource = ImageSet | str | int | Path
"""Images, or a folder, video, camera index or camera address."""
DEFAULT_IMAGES, DEFAULT_TAG_IMAGES = 20, 40
"""Default number of images for camera extrinsics, and for the tag layout."""
VIDEO_IMAGES = 80
"""Frames sampled evenly from a video for a lens calibration."""


def open_images(folder: Path) -> ImageSet:
    """The images of a folder, all of one size, or frames sampled evenly from a video.

    Raises:
        BadInput: The folder is missing or has no images, or the file is not a video.
    """
    if not is_folder(folder) and folder.is_file():
        return _sampled(VideoFile(folder, generic_camera(video_size(folder))), VIDEO_IMAGES)
    images = SingleCameraImages(folder)
    return ImageSet(images, len(images.names), images.unused)


def open_source(source: ImageSource, camera: Camera, wanted: int | None, usual: int) -> ImageSet:
    """The images of a source.

    Args:
        source: A folder, a video file, a camera's index or its address, or the images themselves.
        camera: The rig's camera that took them.
        wanted: Number of images to take from a camera, or to sample evenly from a video.
        usual: Default for ``wanted``.

    Raises:
        BadInput: The source is unknown, its images are of another size, or a number is given for
            a folder.
        HardwareMissing: The camera does not open.
    """
    if isinstance(source, ImageSet):
        return source
    path = path_of(str(source) if isinstance(source, int) else source)
    most = usual if wanted is None else whole_number("pictures", wanted, least=1)
    if is_folder(path):
        if wanted is not None:
            raise BadInput(
                "`pictures=` is for a video or a camera",
                where=str(source),
                next_step="leave it out: all images of a folder are used",
            )
        folder = SingleCameraImages(path, (camera.width, camera.height))
        return ImageSet(folder, len(folder.names), folder.unused)
    if path.is_file():
        return _sampled(VideoFile(path, replace(camera, readout=0.0)), most)  # corrects no rows
    require_camera_source(str(source))
    return ImageSet(_live(str(source), camera, most), most, is_live=True)


def same_images(sets: Sequence[ImageSet]) -> list[ImageSet]:
    """The sets, but of videos samples with the same numbers, as far as the shortest one.

    Raises:
        BadInput: The videos differ in rate: images of the same number are not simultaneous.
    """
    videos = [one.video for one in sets if one.video is not None]
    if len(videos) < len(sets):
        return list(sets)
    total, most = min(video.readable for video in videos), min(one.count for one in sets)
    rates = [video.rate for video in videos]
    if total * (max(rates) - min(rates)) > 0.5 * min(rates):
        raise BadInput(
            "the videos have different rates, so images of the same number are not simultaneous",
            where=", ".join(f"{rate:.6g} images/s" for rate in rates),
            next_step="convert them to one rate, or save images in pairs of equal names",
        )
    return [_sampled(video, most, total) for video in videos]


def _sampled(video: VideoFile, most: int, total: int | None = None) -> ImageSet:
    """Evenly spaced images of a video, of its first ``total`` (default: all)."""
    total = video.readable if total is None else total
    count = min(most, total)
    numbers = {k * total // count for k in range(count)}
    return ImageSet(_Sample(video, numbers), count, video.unused, video)


@dataclass(frozen=True, slots=True)
class _Sample:
    """Images of a video with given numbers; it can be read repeatedly."""

    video: VideoFile
    numbers: set[int]

    def __iter__(self) -> Iterator[tuple[str, Image]]:
        frames = (f for number, f in enumerate(self.video) if number in self.numbers)
        return ((f.name, f.image) for f in frames)


def _live(source: str, camera: Camera, most: int) -> Iterable[tuple[str, Image]]:
    with LiveCamera(source, camera, needs_times=False) as live:
        for _ in range(most):
            frame = live.read()
            yield frame.name, frame.image


def capture_images(
    source: str,
    folder: Path,
    board: Board,
    *,
    wanted: int = 40,
    size: tuple[int, int] = (1280, 720),
    replace: bool = False,
    on_advice: Callable[[str], None] = SILENT.note,
    stopped: Callable[[], bool] = lambda: False,
) -> int:
    """Captures images of a moving board until there are enough or the video ends.

    Args:
        source: A camera's index, device or address, or a video file.
        folder: For the images, ``live_001.png`` …; created if missing.
        board: The target to detect.
        wanted: Minimum number of images.
        size: Width and height of the camera's images, [px]; a video has its own.
        replace: Whether the folder may have images of an earlier session; the first one replaces
            them all.
        on_advice: Receives the next instruction for the operator whenever it changes.
        stopped: Ends the capture when true; called after each image, and while there is none.

    Returns:
        Number of images captured.

    Raises:
        HardwareMissing: The camera does not open.
        BadInput: The source is unknown, its images are of another size, none was captured, or the
            folder has images from elsewhere, or any without `replace`.
    """
    if not Path(source).is_file():
        require_camera_source(source)
    make_folder(folder, replace)
    guide, last = CaptureGuide(board, wanted), ""
    earlier = _captured(folder)
    with _frames(source, size, stopped) as frames:
        for image in frames:
            if stopped():
                break
            advice = guide.judge(image)
            if advice.taken:
                while earlier:
                    earlier.pop().unlink(missing_ok=True)
                data = cv2.imencode(".png", image)[1].tobytes()
                write_bytes_atomic(folder / f"live_{len(guide.views):03}.png", data)
                on_advice(guide.coverage_map())
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


def _captured(folder: Path) -> list[Path]:
    """The images that earlier sessions captured into a folder."""
    images = [path for path in files_in(folder) if path.suffix.lower() in IMAGE_ENDINGS]
    others = [path.name for path in images if not re.fullmatch(r"live_\d{3,}\.png", path.name)]
    if others:
        raise BadInput(
            "the folder has images that were not captured by --live",
            where=f"{folder}: {', '.join(sorted(others)[:4])}",
            next_step="choose another folder, so that they are not mixed with new images",
        )
    return images


@contextmanager
def _frames(
    source: str, size: tuple[int, int], stopped: Callable[[], bool]
) -> Iterator[Iterator[Image]]:
    """Grey images from a camera, until stopped, or a video."""
    path = Path(source)
    if path.is_file():
        yield (frame.image for frame in VideoFile(path, generic_camera(video_size(path), source)))
        return
    camera = generic_camera(size, source)
    with LiveCamera(source, camera, stopped=stopped, needs_times=False) as live:
        yield (frame.image for frame in live)
