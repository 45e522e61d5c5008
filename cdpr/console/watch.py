"""Follows the run on the rig's bus over its command socket, and its cameras' images.

It reconnects to the next run, and follows a motion in preparation while there is no run. Detections
are outlined in the images.
"""

from __future__ import annotations

import math
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Any

from executor.cameras.live_image import ImageReader, LiveImage
from executor.remote.client import Answer, RunLink
from executor.remote.command_socket import find_runs
from executor.remote.protocol import make_line
from model.rig import Rig

#: Period of the search for a run at rest, [s].
SEARCH_PERIOD = 0.2
#: Time-out of a status; a silent run's last status is kept, and becomes stale, [s].
PATIENCE = 0.1
#: Time-out of a command, [s].
ANSWERED_WITHIN = 0.5
#: Largest age of the report of a held control that is sent, [s].
FRESH = 0.1
#: Commands sent to a silent run too: executed late, they move nothing.
_ALWAYS = frozenset({"let_go", "hold", "end"})
_SILENT = "the run does not answer"
_MOVES = "the robot moves; wait, or stop it"
_PREPARED = "a motion is being prepared; wait, or stop it"


def is_ahead(status: dict[str, Any]) -> bool:
    """Whether a motion has not begun to open its devices, and takes only a stop."""
    return "verb" in status


@dataclass(frozen=True, slots=True)
class RunReport:
    """Last status of a run.

    Attributes:
        status: See `executor.remote.status`; None at rest.
        at: Time of receipt on the monotonic clock, [s].
    """

    status: dict[str, Any] | None
    at: float


class RunWatch:
    """Follows the runs on one bus; thread-safe."""

    def __init__(self, bus: str, rig: str | None = None) -> None:
        """Starts unconnected; ``bus`` and ``rig`` as in a run's status, None for any rig."""
        self._bus, self._rig = bus, rig
        self._lock = threading.Lock()
        self._links = ExitStack()
        self._run: RunLink | None = None
        self._looked = float("-inf")
        self._count = 0
        self._is_ahead = False
        self.last = RunReport(None, time.monotonic())

    @property
    def number(self) -> int:
        """Number of the run that is followed, rising with each; 0 at rest and before the motion."""
        return 0 if self._run is None or self._is_ahead else self._count

    def update(self) -> RunReport:
        """Asks the run for its status, or searches for a run."""
        if not self._lock.acquire(timeout=PATIENCE):
            return self.last  # another thread waits for an answer
        try:
            now = time.monotonic()
            is_waiting = self._run is None or self._is_ahead
            if is_waiting and now - self._looked >= SEARCH_PERIOD:
                self._looked = now
                self._connect()
            if self._run is None:
                self.last = RunReport(None, now)
            elif self._run.owed:
                self._take(self._run.hear(PATIENCE))
            else:
                self._take(self._run.ask(make_line("status"), PATIENCE))
            return self.last
        finally:
            self._lock.release()

    def why_busy(self) -> str:
        """Why no verb may be started now, or an empty text; searches for runs again.

        A silent run may be one on this bus.
        """
        with self._lock:
            silent = self._connect() if self._run is None or self._is_ahead else []
            if self._run is not None:
                return _PREPARED if self._is_ahead else _MOVES
            if silent:
                numbers = ", ".join(map(str, silent))
                return f"process {numbers} moves a robot and does not answer; wait, or stop it"
            return ""

    def send(self, command: str, received: float | None = None, **values: Any) -> str:
        """Sends the run a command; returns why it was refused, or an empty text.

        A silent run gets only commands of `_ALWAYS`, as it might execute others much later.

        Args:
            command: See `executor.remote.protocol`.
            received: Time of a report's arrival on the monotonic clock, [s]: one that is too old,
                because others were sent first, is not sent.
            values: Of the command.
        """
        with self._lock:
            if self._run is None:
                return "nothing moves"
            if self._run.owed:
                self._take(self._run.hear(PATIENCE))
                if self._run is None:
                    return "nothing moves"
                if self._run.owed and command not in _ALWAYS:
                    return _SILENT
            if received is not None:
                age = time.monotonic() - received
                if age > FRESH:
                    return "the report is too old"
                values["age_ms"] = math.ceil(1e3 * age)
            answer = self._run.ask(make_line(command, **values), ANSWERED_WITHIN)
            if answer.what:
                return answer.what
            self._take(answer)
            return "" if answer.status is not None else _SILENT

    def close(self) -> None:
        """Closes the connection."""
        with self._lock:
            self._disconnect()

    def _take(self, answer: Answer) -> None:
        """Takes a status from an answer; without an answer the last one becomes stale."""
        if answer.status is not None:
            self.last = RunReport(answer.status, time.monotonic())
            self._is_ahead = is_ahead(answer.status)
        elif answer.ended:
            self._disconnect()
            self.last = RunReport(None, time.monotonic())

    def _connect(self) -> list[int]:
        """Connects to the run on this bus, else to a motion in preparation.

        If there is neither, returns the processes of silent runs.
        """
        self._disconnect()
        links, silent = self._links.enter_context(ExitStack()), []
        ahead: RunLink | None = None
        for run in links.enter_context(find_runs(ahead=True)):
            link = RunLink(run)
            answer = link.ask(make_line("status"), PATIENCE)
            if answer.status is not None and self._is_here(answer.status):
                if not is_ahead(answer.status):
                    self._follow(link, is_ahead=False)
                    return []
                ahead = ahead or link
            elif answer.status is None and not (answer.ended or run.is_ahead):
                silent.append(run.process)
        if ahead is None:
            self._disconnect()
            return silent
        self._follow(ahead, is_ahead=True)
        return []

    def _follow(self, link: RunLink, *, is_ahead: bool) -> None:
        self._run, self._is_ahead = link, is_ahead
        self._count += 1

    def _is_here(self, status: dict[str, Any]) -> bool:
        return status["bus"] == self._bus and self._rig in (None, status["rig"])

    def _disconnect(self) -> None:
        self._run = None
        self._links.close()


# Images of the cameras that measure a run, with outlines of the detections.
#: Largest width of an image, [px], and its JPEG quality.
WIDEST, QUALITY = 640, 70


class CameraPictures:
    """The newest image of each camera; thread-safe.

    Compression takes a few milliseconds of this process, none of the run's. A request during a
    compression gets the previous image.
    """

    def __init__(self) -> None:
        """Starts without a run."""
        self._busy = threading.Lock()
        self._rig: Rig | None = None
        self._sources: dict[str, tuple[int, int]] = {}
        self._readers: dict[tuple[int, int], ImageReader] = {}
        self._made: dict[str, bytes] = {}

    def watch(self, status: dict[str, Any] | None, rig: Rig) -> None:
        """Takes the list of measuring cameras from a status; does not block.

        Args:
            status: Of a run; None at rest.
            rig: The robot with its cameras.
        """
        cameras = [] if status is None else status["cameras"]
        self._rig = rig
        self._sources = {
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
            source, rig = self._sources.get(name), self._rig
            if source is None or rig is None:
                return None
            with suppress(OSError):
                if source not in self._readers:
                    self._readers[source] = ImageReader(*source)
                newest = self._readers[source].newest()
                if newest is not None:
                    self._made[name] = _compressed(newest, rig, name)
            return self._made.get(name)
        finally:
            self._busy.release()

    def close(self) -> None:
        """Closes the image readers."""
        with self._busy:
            self._sources = {}
            self._forget_others()

    def _forget_others(self) -> None:
        """Drops readers and images of runs that ended."""
        sources = dict(self._sources)
        for source in [one for one in self._readers if one not in sources.values()]:
            self._readers.pop(source).close()
        for name in [one for one in self._made if one not in sources]:
            del self._made[name]


def _compressed(newest: LiveImage, rig: Rig, name: str) -> bytes:
    import cv2  # loaded only when an image is shown

    from tracking.track import draw_outline

    drawn = draw_outline(newest.image, rig, rig.camera(name), newest.found)
    height, width = newest.image.shape
    if width > WIDEST:
        size = (WIDEST, round(height * WIDEST / width))
        drawn = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    _, file = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return file.tobytes()
