"""The newest picture of a camera that takes them faster than anybody asks for them.

A camera's pictures wait in queues: of the network, of its driver, of the decoder. Whoever takes one
of three falls behind by the other two, and measures an ever older platform. So a thread takes them
all, as they come, and keeps the last.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

#: Pictures a camera may fail to give in a row before it counts as gone.
LOST_PICTURES = 5
#: A camera that is being read is waited for no longer than this when it is let go of, [s].
END_TIMEOUT = 2.0


class Capture(Protocol):
    """What gives pictures, such as `cv2.VideoCapture`."""

    def read(self) -> tuple[bool, Any]:
        """The next picture in the queue, waited for; False and nothing where there is none."""
        ...

    def release(self) -> None:
        """Lets go of the camera."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """A picture as it came.

    Attributes:
        number: Of the camera's pictures, from 0; those that nobody asked for count.
        time: When it arrived, on the reader's clock, [s].
        picture: As the camera gave it.
    """

    number: int
    time: float
    picture: NDArray[np.generic]


class PictureReader:
    """Takes all pictures of a camera in a thread of its own."""

    def __init__(self, capture: Capture, clock: Callable[[], float]) -> None:
        """Begins to read.

        Args:
            capture: Read and let go of by the thread alone.
            clock: Monotonic time, [s].
        """
        self._capture, self._clock = capture, clock
        self._changed = threading.Condition()
        self._newest: Arrived | None = None
        self._ended = self._told_to_end = False
        self._thread = threading.Thread(target=self._read, name="cdpr-pictures", daemon=True)
        self._thread.start()

    def newest(self) -> Arrived | None:
        """The newest picture, each only once; waited for.

        Returns:
            None when the camera gives no more.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._ended)
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        """Ends the reading; a camera that hangs is left to the end of this process."""
        self._told_to_end = True
        if threading.current_thread() is not self._thread:
            self._thread.join(END_TIMEOUT)

    def _read(self) -> None:
        number = failed = 0
        try:
            while failed < LOST_PICTURES and not self._told_to_end:
                good, picture = self._capture.read()
                now = self._clock()
                failed = 0 if good else failed + 1
                if good:
                    self._put(Arrived(number, now, np.asarray(picture)))
                    number += 1
        finally:
            self._capture.release()
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _put(self, arrived: Arrived) -> None:
        with self._changed:
            self._newest = arrived
            self._changed.notify_all()
