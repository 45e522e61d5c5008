"""Taking pictures of a board with a live camera, with advice where to hold it next."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibration.board import Board
    from tracking.picture import Image


def require_source(source: str) -> None:
    """Before a folder is made for pictures of it.

    Raises:
        BadInput: It is no camera and no file.
    """
    from cdpr.cli.picture_sources import require_camera_source

    if not Path(source).is_file():
        require_camera_source(source)


def take_pictures(
    source: str, folder: Path, board: Board, wanted: int, size: tuple[int, int]
) -> None:
    """Takes pictures into a folder until enough are there, the video ends, or Ctrl-C.

    Args:
        source: A camera's index, device or address, or a video file.
        folder: Where pictures go, which exists.
        board: What is shown.
        wanted: How many pictures at least.
        size: Width and height of the camera's pictures, [px]; a video has its own.

    Raises:
        HardwareMissing: The camera does not open.
        BadInput: The source is none, its pictures are of another size, or none was taken.
    """
    import cv2

    from calibration.capture import CaptureGuide
    from cdpr.cli.output import err
    from cdpr.documents import write_bytes_atomic
    from cdpr.errors import BadInput

    guide, told = CaptureGuide(board, wanted), ""
    with _frames(source, size) as frames:
        try:
            for image in frames:
                advice = guide.look(image)
                if advice.taken:
                    data = cv2.imencode(".png", image)[1].tobytes()
                    write_bytes_atomic(folder / f"live_{len(guide.views):03}.png", data)
                if advice.text != told:
                    told = advice.text
                    err.print(told, soft_wrap=True)
                if advice.done:
                    break
        except KeyboardInterrupt:
            err.print("no more pictures are taken; those that were are used")
    if not guide.views:
        raise BadInput(
            "no picture was taken",
            where=f"camera {source}",
            why=f"{board} was never seen standing still",
            next_step="check the board's kind and numbers and the light, and hold it still",
        )


@contextmanager
def _frames(source: str, size: tuple[int, int]) -> Iterator[Iterator[Image]]:
    """Grey pictures of a camera or a video."""
    from calibration.plain_camera import plain_camera
    from drivers.cameras import LiveCamera, VideoFile, video_size

    path = Path(source)
    if path.is_file():
        yield (frame.image for frame in VideoFile(path, plain_camera(video_size(path), source)))
        return
    with LiveCamera(source, plain_camera(size, source)) as live:
        yield (frame.image for frame in live)
