"""Images of the cameras that measure a run, with outlines of what is seen in them, for the page."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Any

from executor.cameras.live_image import ImageReader, LiveImage
from model.rig import Rig

#: Wider images are made smaller, [px]; and compressed by so much.
WIDEST, QUALITY = 640, 70


class CameraPictures:
    """The newest image of each camera; safe to use from several threads.

    Making one takes a few milliseconds here, and nothing of a run. Who asks while one is made gets
    the one before: images are left out, none waits.
    """

    def __init__(self) -> None:
        """No run is watched."""
        self._busy = threading.Lock()
        self._rig: Rig | None = None
        self._places: dict[str, tuple[int, int]] = {}
        self._readers: dict[tuple[int, int], ImageReader] = {}
        self._made: dict[str, bytes] = {}

    def watch(self, status: dict[str, Any] | None, rig: Rig) -> None:
        """Takes in which cameras measure now; it opens and waits for nothing.

        Args:
            status: Of a run; None where nothing moves.
            rig: The robot with its cameras.
        """
        cameras = [] if status is None else status["cameras"]
        self._rig = rig
        self._places = {
            camera["name"]: (status["process"], camera["live_image"])
            for camera in cameras
            if status is not None and camera["live_image"] is not None
        }

    def jpeg(self, name: str) -> bytes | None:
        """The newest image of a camera as a JPEG file; None where there is none."""
        if not self._busy.acquire(blocking=False):
            return self._made.get(name)
        try:
            self._forget_others()
            place, rig = self._places.get(name), self._rig
            if place is None or rig is None:
                return None
            with suppress(OSError):
                if place not in self._readers:
                    self._readers[place] = ImageReader(*place)
                newest = self._readers[place].newest()
                if newest is not None:
                    self._made[name] = _compressed(newest, rig, name)
            return self._made.get(name)
        finally:
            self._busy.release()

    def close(self) -> None:
        """Lets go of the images."""
        with self._busy:
            self._places = {}
            self._forget_others()

    def _forget_others(self) -> None:
        """Of runs that ended nothing is kept."""
        places = dict(self._places)
        for place in [one for one in self._readers if one not in places.values()]:
            self._readers.pop(place).close()
        for name in [one for one in self._made if one not in places]:
            del self._made[name]


def _compressed(newest: LiveImage, rig: Rig, name: str) -> bytes:
    import cv2  # a console that shows no image does not load it

    from tracking.overlay import outlined

    drawn = outlined(newest.image, rig, rig.camera(name), newest.found)
    height, width = newest.image.shape
    if width > WIDEST:
        size = (WIDEST, round(height * WIDEST / width))
        drawn = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    _, file = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return file.tobytes()
