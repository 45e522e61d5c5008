"""The newest image of a camera that delivers them faster than they are used.

Images wait in queues of the network, the driver and the decoder. A reader slower than the camera
would measure ever older images, so a thread reads all of them and keeps the last.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

#: Consecutive failed reads after which a camera counts as lost.
LOST_IMAGES = 5
#: The same after copies of one image for this long, [s]. A video codec may repeat an image of a
#: platform at rest up to its next complete one, for 10 s and more.
FROZEN = 60.0
#: Longest wait for the reading thread when closing, and interval of checks for a stop, [s].
END_TIMEOUT, ROUND = 2.0, 0.1
NOT_OPENED = "cannot be opened"
"""Why a camera delivers no images, as a predicate."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """An image as delivered.

    Attributes:
        number: Number of the camera's image from 0, including skipped ones.
        time: Time of arrival on the reader's clock, [s].
        picture: As the camera delivered it.
    """

    number: int
    time: float
    picture: NDArray[np.generic]


class FrameReader:
    """Opens a camera and reads all its images in a thread.

    A copy of the image before is not a new one: noise makes images of a camera differ, but a
    decoder or driver that hangs may repeat its last one.

    Attributes:
        lost: Why the camera delivers no more, as a predicate of it.
    """

    def __init__(self, opened: Callable[[], cv2.VideoCapture], clock: Callable[[], float]) -> None:
        """Starts the thread.

        Args:
            opened: Opens the camera, called by the thread: it may take half a minute.
            clock: Monotonic time, [s].
        """
        self._opened, self._clock = opened, clock
        self._changed = threading.Condition()
        self._newest: Arrived | None = None
        self.lost = ""
        self._ended = self._is_closing = False
        self._thread = threading.Thread(target=self._read, name="cdpr-pictures", daemon=True)
        self._thread.start()

    def newest(self, stopped: Callable[[], bool]) -> Arrived | None:
        """Waits for the newest image not returned before.

        Args:
            stopped: Called repeatedly; True ends the wait.

        Returns:
            None once the camera delivers no more, or the wait was ended.
        """
        with self._changed:
            while not self._changed.wait_for(lambda: self._newest or self._ended, ROUND):
                if stopped():
                    break
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        """Stops the thread; a hanging camera keeps it until this process ends."""
        self._is_closing = True
        if threading.current_thread() is not self._thread:
            self._thread.join(END_TIMEOUT)

    def _read(self) -> None:
        try:
            capture = self._opened()
            try:
                self._read_all(capture)
            finally:
                capture.release()
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _read_all(self, capture: cv2.VideoCapture) -> None:
        """Puts each image of a camera until that is lost, or this closed."""
        number = failed = 0
        last: Arrived | None = None
        self.lost = "" if capture.isOpened() else NOT_OPENED
        while not (self.lost or self._is_closing):
            good, picture = capture.read()
            now = self._clock()
            failed = 0 if good else failed + 1
            if failed == LOST_IMAGES:
                self.lost = f"failed to deliver an image {LOST_IMAGES} times in a row"
            if not good:
                continue
            arrived = Arrived(number, now, np.asarray(picture))
            number += 1
            if last is None or not _is_copy(arrived.picture, last.picture):
                last = arrived
                self._put(arrived)
            elif now - last.time > FROZEN:
                self.lost = f"delivered the same image for {FROZEN:g} s"

    def _put(self, arrived: Arrived) -> None:
        with self._changed:
            self._newest = arrived
            self._changed.notify_all()


def _is_copy(picture: NDArray[np.generic], last: NDArray[np.generic]) -> bool:
    """Whether two images are equal; a few of their rows suffice for most that are not."""
    return np.array_equal(picture[::64], last[::64]) and np.array_equal(picture, last)
