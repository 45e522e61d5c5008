"""Pictures of one of the rig's cameras: a folder, a video, or the camera itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from cdpr.errors import BadInput

if TYPE_CHECKING:
    from cdpr.rig import Camera
    from tracking.picture import Image


@dataclass(frozen=True, slots=True)
class Pictures:
    """Pictures of one size.

    Attributes:
        images: Names and grey pictures.
        count: How many there will be.
        unused: Why files are not used, by name.
    """

    images: Iterable[tuple[str, Image]]
    count: int
    unused: Mapping[str, str] = field(default_factory=dict)


def pictures_of(source: str, camera: Camera, wanted: int | None, usual: int) -> Pictures:
    """The pictures of a source.

    Args:
        source: A folder, a video file, a camera's index or its address.
        camera: The rig's camera that took them.
        wanted: How many to take of a camera, or of a video, spread over it.
        usual: How many where that is left out.

    Raises:
        BadInput: It is none of these, its pictures are of another size, or a number is wanted of
            a folder.
        HardwareMissing: The camera does not open.
    """
    from drivers.cameras import VideoFile
    from drivers.picture_folder import OneCamerasPictures

    path = Path(source)
    most = wanted or usual
    if path.is_dir():
        if wanted is not None:
            raise BadInput(
                "--pictures is for a video or a camera",
                where=source,
                next_step="leave it out: a folder's pictures are all used",
            )
        folder = OneCamerasPictures(path, (camera.width, camera.height))
        return Pictures(folder, len(folder.names), folder.unused)
    if path.is_file():
        video = VideoFile(path, camera)
        every = max(1, -(-len(video) // most))
        frames = (frame for number, frame in enumerate(video) if number % every == 0)
        return Pictures(((f.name, f.image) for f in frames), -(-len(video) // every))
    require_camera_source(source)
    return Pictures(_live(source, camera, most), most)


def told(pictures: Pictures, advance: Callable[[float], None]) -> Iterator[tuple[str, Image]]:
    """The pictures, each told when it was looked at."""
    for number, picture in enumerate(pictures.images, 1):
        yield picture
        advance(number)


def require_camera_source(source: str) -> None:
    """Refuses what can be no camera.

    Raises:
        BadInput: It is neither a number nor a device nor an address.
    """
    if not is_camera(source):
        raise BadInput(
            "neither a folder of pictures, nor a video file, nor a camera",
            where=source,
            next_step="check the path; a camera is an index such as 0, /dev/video0 or an address",
        )


def is_camera(source: str) -> bool:
    """Whether it can be a camera: a number, a device or an address, and no file."""
    if source.startswith("/dev/"):
        return not (Path(source).is_file() or Path(source).is_dir())
    return source.isdecimal() or ("://" in source and not source.startswith("file:"))


def _live(source: str, camera: Camera, most: int) -> Iterable[tuple[str, Image]]:
    from drivers.cameras import LiveCamera

    with LiveCamera(source, camera) as live:
        for _ in range(most):
            frame = live.read()
            yield frame.name, frame.image
