"""Pictures written to a folder or into a video."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput, Fault

#: Endings of videos that are written, and how their pictures are coded.
VIDEO_CODES = {".mp4": "mp4v", ".avi": "MJPG"}


class PictureOutput:
    """Writes colour pictures one after the other, as a context manager.

    Args:
        path: A folder to make, or a video file by its ending.
        rate: Pictures a second of a video.
        force: Whether something that is there may be replaced (a video) or added to (a folder).

    Raises:
        BadInput: It is there already, or its ending is no known one.
    """

    def __init__(self, path: Path, rate: float, force: bool = False) -> None:
        self._path, self._rate = path, rate
        self._video: cv2.VideoWriter | None = None
        self._is_video = path.suffix.lower() in VIDEO_CODES
        if not self._is_video and path.suffix and not path.is_dir():
            raise BadInput(
                "neither a folder nor a video that can be written",
                where=str(path),
                next_step=f"name a folder, or a file that ends in {', '.join(VIDEO_CODES)}",
            )
        if path.exists() and not force:
            raise BadInput(
                "it exists already", where=str(path), next_step="name another one, or pass --force"
            )
        try:
            (path.parent if self._is_video else path).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(
                "the folder cannot be made", where=str(path), why=error.strerror or str(error)
            ) from None

    def __enter__(self) -> PictureOutput:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._video is not None:
            self._video.release()

    def write(self, picture: NDArray[np.uint8], name: str) -> None:
        """Writes the next picture.

        Args:
            picture: Shape (height, width, 3), blue green red; all of one size.
            name: Of the picture; a folder's file is called after it.

        Raises:
            Fault: It cannot be written.
        """
        if self._is_video:
            self._to_video(picture)
            return
        stem = "".join(sign if sign.isalnum() or sign in "-_." else "_" for sign in name)
        file = self._path / (Path(stem).stem + ".png")
        good, data = cv2.imencode(".png", picture)
        try:
            if good:
                file.write_bytes(data.tobytes())
        except OSError as error:
            raise _unwritable(file, error.strerror or str(error)) from None

    def _to_video(self, picture: NDArray[np.uint8]) -> None:
        if self._video is None:
            code = cv2.VideoWriter.fourcc(*VIDEO_CODES[self._path.suffix.lower()])
            size = (picture.shape[1], picture.shape[0])
            self._video = cv2.VideoWriter(str(self._path), code, self._rate, size)
            if not self._video.isOpened():
                raise _unwritable(self._path, "OpenCV cannot write such a video here")
        self._video.write(picture)


def _unwritable(path: Path, why: str) -> Fault:
    return Fault(
        "the picture cannot be written",
        where=str(path),
        why=why,
        next_step="free some space, or name another place",
    )
