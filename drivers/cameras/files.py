"""Image files: reading folders, writing folders and videos."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.cameras.live import Frame, FrameSource, Image, eight_bits
from model.cameras import OTHER_SIZE, cause_of_size
from model.errors import AlreadyExists, BadInput, CdprError, Fault
from model.files.documents import write_bytes_atomic
from model.files.reading import (
    IMAGE_LIMIT,
    SECONDS_SINCE_1970,
    SPLIT,
    exif_orientation,
    files_in,
    is_folder,
    is_too_large,
    page_count,
    read_bytes,
)
from model.rig import Camera

#: Suffixes of image files, in lower case.
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")
_GREY_LEVELS = (np.uint8, np.uint16)
_ON_ITS_SIDE = range(5, 9)  # EXIF orientations that swap width and height
_NO_IMAGE, _CAMERA = "is not a readable image", "the camera has"


class ImageFolder(FrameSource):
    """The images of a folder in natural order of their names.

    They are rotated by the rule of `read_image`, as in a calibration.

    Args:
        folder: Folder of the images.
        camera: The camera that took them.
        rate: Images per second (default: the camera's).
        cameras: Of the rig, to name the one whose images these seem to be.

    Attributes:
        files: All files with an image suffix.
        names: Their names.
        rate: Images per second, [Hz].
        unused: Reason by name of each file that is not used.

    Raises:
        BadInput: The folder is missing or has no images.
    """

    def __init__(
        self,
        folder: Path,
        camera: Camera,
        rate: float | None = None,
        cameras: Sequence[Camera] = (),
    ) -> None:
        self.files = image_files(folder)
        self.names = tuple(image_name(path) for path in self.files)
        self.unused: dict[str, str] = {}
        self._folder, self._camera, self._cameras = folder, camera, cameras
        self.rate = rate or camera.rate

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[Frame]:
        """Yields the images that have the camera's size.

        Raises:
            BadInput: None can be read or has the camera's size, or as `Camera.require_unrotated`.
        """
        self.unused.clear()
        wanted, sizes = (self._camera.width, self._camera.height), set[tuple[int, int]]()
        for number, (name, path) in enumerate(zip(self.names, self.files, strict=True)):
            image, is_rotated = _read(path, wanted)
            sizes.add(_size(image))
            if image is not None and _size(image) == wanted:
                if is_rotated:
                    self._camera.require_unrotated(str(path))
                yield Frame(number / self.rate, image, name, number)
                continue
            why = _unreadable(path) if image is None else _other_size(_size(image), _CAMERA, wanted)
            self.unused[name] = why
        if sizes == {_size(None)}:
            raise _no_picture(self._folder, self.unused)
        if wanted not in sizes:
            cause = cause_of_size(self._camera, sizes, self._cameras)
            raise _wrong_sizes(self._folder, self.unused, wanted, cause)


class SingleCameraImages:
    """The images of a folder with one size, rotated by the rule of `read_image`.

    Files that cannot be used are listed in `unused`.

    Args:
        folder: Folder of the images.
        wanted: Width and height of the camera that took them, [px] (default: the most frequent).

    Attributes:
        size: Width and height, [px].
        names: Names of the images used, in order.
        unused: Reason by name of each file that is not used.

    Raises:
        BadInput: The folder is missing, has no images, or none that can be read or has the
            wanted size.
    """

    def __init__(self, folder: Path, wanted: tuple[int, int] | None = None) -> None:
        self.unused: dict[str, str] = {}
        sizes: dict[Path, tuple[int, int]] = {}
        orientations: list[int] = []
        for path in image_files(folder):
            data = _data(path)
            image = _decoded(data)
            if image is None:
                self.unused[image_name(path)] = _unreadable(path)
            else:
                sizes[path] = _size(image)
                orientations.append(exif_orientation(data))
        if not sizes:
            raise _no_picture(folder, self.unused)
        self.size = wanted or _most_frequent([*zip(sizes.values(), orientations, strict=True)])
        for path, size in sizes.items():
            if size != self.size and _size(read_image(path, self.size)) != self.size:
                owner = _CAMERA if wanted else "most have"
                self.unused[image_name(path)] = _other_size(size, owner, self.size)
        named = {image_name(path): path for path in sizes}
        self._files = {name: path for name, path in named.items() if name not in self.unused}
        if not self._files:
            raise _wrong_sizes(folder, self.unused, self.size, OTHER_SIZE)
        self.names = tuple(self._files)

    def __iter__(self) -> Iterator[tuple[str, Image]]:
        """Yields names and grey images."""
        for name, path in self._files.items():
            image = read_image(path, self.size)
            if image is not None and _size(image) == self.size:
                yield name, image


def image_files(folder: Path) -> tuple[Path, ...]:
    """The files of a folder with an image suffix, in natural order of their names.

    Raises:
        BadInput: The folder is missing or has none.
    """
    if not is_folder(folder):
        raise BadInput("no such folder", where=str(folder), next_step="check the path")
    found = [p for p in files_in(folder) if p.suffix.lower() in IMAGE_ENDINGS]
    if not found:
        raise BadInput(
            "the folder has no images",
            where=str(folder),
            next_step=f"name a folder with files ending in {', '.join(IMAGE_ENDINGS)}",
        )
    order = natural_order(map(image_name, found))
    return tuple(sorted(found, key=lambda path: order(image_name(path))))


def image_name(path: Path) -> str:
    """The name of an image's file; bytes that are not UTF-8 are escaped, as in a log."""
    return path.name.encode(errors="backslashreplace").decode()


def read_image(path: Path, size: tuple[int, int] | None = None) -> Image | None:
    """The grey image of a file, or None if it has none, or several.

    Names that OpenCV cannot open are read too. The image is as the sensor stored it, like that of a
    live camera: a camera that points down states its orientation at random, and an image rotated by
    180° has another principal point. Only one that has the camera's size once rotated as its EXIF
    data say, by 90°, is rotated.

    Args:
        size: Width and height of the camera's images, [px]; None for as stored.
    """
    return _read(path, size)[0]


def _read(path: Path, size: tuple[int, int] | None) -> tuple[Image | None, bool]:
    """The image as for `read_image`, and whether it was rotated."""
    data = _data(path)
    image = _decoded(data)
    if image is None or size in (None, _size(image)):
        return image, False
    rotated = _decoded(data, upright=True)
    return (rotated, True) if _size(rotated) == size else (image, False)


def _data(path: Path) -> bytes:
    """The content of a file; empty if it cannot be read."""
    with suppress(BadInput):
        return read_bytes(path, IMAGE_LIMIT)
    return b""


def _most_frequent(images: Sequence[tuple[tuple[int, int], int]]) -> tuple[int, int]:
    """The size that most of a camera's images have, as stored or rotated by 90° as stated.

    Of two equally frequent ones, that of the images as rotated if all state the same rotation.

    Args:
        images: Width and height as stored, [px], and EXIF orientation of each.
    """

    def rank(size: tuple[int, int]) -> tuple[int, int, tuple[int, int]]:
        used = [(stored, turn) for stored, turn in images if size in (stored, _shown(stored, turn))]
        is_one_turn = len({turn for _, turn in used if turn in _ON_ITS_SIDE}) < 2
        as_wanted = [(_shown(one, turn) if is_one_turn else one) == size for one, turn in used]
        return len(used), sum(as_wanted), size

    return max((size for one, turn in images for size in (one, _shown(one, turn))), key=rank)


def _shown(stored: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Width and height of an image rotated by 90° if its EXIF orientation says so, [px]."""
    return stored[::-1] if orientation in _ON_ITS_SIDE else stored


def _decoded(data: bytes, upright: bool = False) -> Image | None:
    picture = _raw(data, upright) if page_count(data) == 1 else None
    return None if picture is None or picture.dtype not in _GREY_LEVELS else eight_bits(picture)


def _unreadable(path: Path) -> str:
    """Why a file is not used."""
    data = _data(path)
    if (pages := page_count(data)) > 1:
        return f"has {pages} pages; {SPLIT}"
    picture = _raw(data)
    if picture is None:
        return _NO_IMAGE
    return f"has values of type {picture.dtype}; only integers of 8 to 16 bits can be used"


def _raw(data: bytes, upright: bool = False) -> NDArray[np.generic] | None:
    if not data or is_too_large(data):
        return None
    as_stored = 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | as_stored
    try:
        picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        return None
    return None if picture is None else np.asarray(picture)


def _other_size(size: tuple[int, int], owner: str, wanted: tuple[int, int]) -> str:
    return f"has {size[0]} x {size[1]} px, {owner} {wanted[0]} x {wanted[1]} px"


def _size(image: Image | None) -> tuple[int, int]:
    return (0, 0) if image is None else (image.shape[1], image.shape[0])


def _no_picture(folder: Path, unused: Mapping[str, str]) -> BadInput:
    return BadInput(
        f"none of the {len(unused)} files is a readable image",
        where=str(folder),
        why=_first(unused),
        next_step="check that the files were copied completely, and hold integers of 8 to 16 bits",
    )


def _wrong_sizes(
    folder: Path, unused: dict[str, str], wanted: tuple[int, int], cause: tuple[str, str]
) -> BadInput:
    return BadInput(
        f"none of the {len(unused)} images has the camera's {wanted[0]} x {wanted[1]} px",
        where=str(folder),
        why=f"{_first(unused)}: {cause[0]}",
        next_step=cause[1],
    )


def _first(unused: Mapping[str, str]) -> str:
    return "; ".join(f"{name} {why}" for name, why in list(unused.items())[:4])


#: A number with a point at the end of a file's name, before its suffix.
_DECIMALS = re.compile(r"(\d+)\.(\d+)(?=\.[^.]*$)")


def natural_order(names: Iterable[str]) -> Callable[[str], tuple[list[tuple[int, int, str]], str]]:
    """Sort key of a folder's names, different for each: ``frame_10`` comes after ``frame_9``.

    If names end in numbers of seconds, such as ``1763000000.667`` and ``1763000000.8``, they are
    in order of time.
    """
    digits = _most_decimals(names)

    def key(name: str) -> tuple[list[tuple[int, int, str]], str]:
        padded = _DECIMALS.sub(lambda two: f"{two[1]}.{two[2].ljust(digits, '0')}", name.lower())
        parts = re.split(r"(\d+)", padded)
        return [(1, int(p), "") if p.isdecimal() else (0, 0, p) for p in parts], name

    return key


def _most_decimals(names: Iterable[str]) -> int:
    """The most decimals of numbers written without trailing zeros, as Python does; 0 for others.

    Where dots separate counts, as in ``2.9`` and ``2.10``, some end in zero unless there are few or
    every second was left out, only the shortest begin with zero, and the number before is usually
    that of a recording: the same in all names, and shorter than seconds since 1970.
    """
    found = [two.groups() for name in names if (two := _DECIMALS.search(name))]
    wholes, decimals = {whole for whole, _ in found}, [digits for _, digits in found]
    if any(len(digits) > 1 and digits.endswith("0") for digits in decimals):
        return 0
    shortest, most = min(map(len, decimals), default=0), max(map(len, decimals), default=0)
    are_fractions = any(digits.startswith("0") and len(digits) > shortest for digits in decimals)
    are_seconds = len(wholes) > 1 or any(len(whole) >= SECONDS_SINCE_1970 for whole in wholes)
    return most if are_fractions or (are_seconds and most >= 3) else 0


# Images written to a folder or into a video.


#: Codec of the written videos, by suffix.
VIDEO_CODES = {".mp4": "mp4v", ".avi": "MJPG"}


class ImageOutput:
    """Context manager that writes colour images to a folder or a video.

    What was written before a user-visible error or Ctrl-C is kept.

    Args:
        path: A folder to create, or a video file, by its suffix.
        rate: Images per second of a video.
        force: Whether an existing video may be replaced, or an existing folder added to.

    Raises:
        BadInput: It exists already, or its suffix is unknown.
    """

    def __init__(self, path: Path, rate: float, force: bool = False) -> None:
        self._path, self._rate = path, rate
        self._video: cv2.VideoWriter | None = None
        self._unfinished = path.with_name(f".{path.stem[:40]}.{os.getpid()}{path.suffix}")
        self._count = 0
        self._names: dict[str, str] = {}
        self._is_video = path.suffix.lower() in VIDEO_CODES
        if not self._is_video and path.suffix and not path.is_dir():
            raise BadInput(
                "neither a folder nor a supported video file",
                where=str(path),
                next_step=f"name a folder, or a file ending in {', '.join(VIDEO_CODES)}",
            )
        if path.exists() and not force:
            raise AlreadyExists("the file exists already", str(path))
        try:
            (path.parent if self._is_video else path).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(
                "the folder cannot be created", where=str(path), why=error.strerror or str(error)
            ) from None

    def __enter__(self) -> ImageOutput:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._video is None:
            return
        is_writable = self._video.isOpened()
        self._video.release()
        try:
            if is_writable and isinstance(error, CdprError | KeyboardInterrupt | None):
                self._keep_video()
        finally:
            self._unfinished.unlink(missing_ok=True)

    def _keep_video(self) -> None:
        """Renames the finished video after counting its images: OpenCV ignores a full disk."""
        reader = cv2.VideoCapture(str(self._unfinished))
        count = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
        reader.release()
        if count < self._count:
            why = f"it contains only {count} of {self._count} images; the disk may be full"
            raise _unwritable(self._path, why)
        try:
            self._unfinished.replace(self._path)
        except OSError as error:
            raise _unwritable(self._path, error.strerror or str(error)) from None

    def write(self, picture: NDArray[np.uint8], name: str) -> None:
        """Writes the next image.

        Args:
            picture: Shape (height, width, 3), blue green red; all of one size.
            name: Of the image; the file in a folder is named after it.

        Raises:
            Fault: It cannot be written.
        """
        if self._is_video:
            self._to_video(picture)
            return
        good, data = cv2.imencode(".png", picture)
        if not good:
            raise ValueError(f"no image: shape {picture.shape}, type {picture.dtype}")
        try:
            write_bytes_atomic(self._path / self._file_name(name), data.tobytes())
        except BadInput as error:
            raise _unwritable(Path(error.where), error.why) from None

    def _file_name(self, name: str) -> str:
        """File name of an image: ``a.png``, or if taken ``a.jpg.png``, or ``a-2.png``."""
        whole = "".join(sign if sign.isalnum() or sign in "-_." else "_" for sign in name)
        stem = Path(whole).stem
        numbered = (f"{stem}-{k}.png" for k in count(2))
        free = chain((f"{stem}.png", f"{whole}.png"), numbered)
        return next(file for file in free if self._names.setdefault(file, name) == name)

    def _to_video(self, picture: NDArray[np.uint8]) -> None:
        if self._video is None:
            code = cv2.VideoWriter.fourcc(*VIDEO_CODES[self._path.suffix.lower()])
            self._video = cv2.VideoWriter(str(self._unfinished), code, self._rate, _size(picture))
            if not self._video.isOpened():
                raise _unwritable(self._path, "OpenCV has no encoder for this video format")
        self._video.write(picture)
        self._count += 1


def _unwritable(path: Path, why: str) -> Fault:
    return Fault(
        "the image cannot be written",
        where=str(path),
        why=why,
        next_step="free some space, or choose another folder",
    )
