"""Follows whatever moves on the rig's bus, over its command socket, and its cameras' images.

It reconnects to the next motion. Images are outlined with what is seen in them.
"""

from __future__ import annotations

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

#: While nothing moves, a new run is looked for this often, [s].
LOOK = 0.2
#: A run that answers later is silent: its last status stays, and grows old, [s].
PATIENCE = 0.1
#: What an operator asks for is answered within this, [s].
ANSWERED_WITHIN = 0.5
#: Sent to a silent run as well: obeyed late, they make nothing move.
_ALWAYS = frozenset({"let_go", "hold", "end"})
_SILENT = "the run does not answer"
_MOVES = "the robot moves; wait, or stop it"


@dataclass(frozen=True, slots=True)
class Look:
    """What a run said.

    Attributes:
        status: See `executor.remote.status`; None when nothing moves.
        at: When, on the monotonic clock, [s].
    """

    status: dict[str, Any] | None
    at: float


class RunWatch:
    """Of the runs on one bus; safe to use from several threads."""

    def __init__(self, bus: str) -> None:
        """Not connected yet; the bus as a run's status names it."""
        self._bus = bus
        self._lock = threading.Lock()
        self._links = ExitStack()
        self._run: RunLink | None = None
        self._looked = float("-inf")
        self._count = 0
        self.last = Look(None, time.monotonic())

    @property
    def number(self) -> int:
        """Of the motion that is followed, rising with each; 0 while nothing moves."""
        return 0 if self._run is None else self._count

    def look(self) -> Look:
        """Asks the run that moves; finds one where none did."""
        if not self._lock.acquire(timeout=PATIENCE):
            return self.last  # somebody waits for an answer
        try:
            now = time.monotonic()
            if self._run is None and now - self._looked >= LOOK:
                self._looked = now
                self._connect()
            if self._run is None:
                self.last = Look(None, now)
            elif self._run.owed:
                self._take(self._run.hear(PATIENCE))
            else:
                self._take(self._run.ask(make_line("status"), PATIENCE))
            return self.last
        finally:
            self._lock.release()

    def why_busy(self) -> str:
        """Why nothing may be started now, looked up afresh; or nothing.

        A run that does not say which bus it moves may be one on this bus.
        """
        with self._lock:
            silent = self._connect() if self._run is None else []
            if self._run is not None:
                return _MOVES
            if silent:
                numbers = ", ".join(map(str, silent))
                return f"process {numbers} moves a robot and does not answer; wait, or stop it"
            return ""

    def say(self, command: str, **values: Any) -> str:
        """Sends the run a command; why it was not taken, or nothing.

        A run that is silent is sent nothing that it could obey when it wakes up, long after.
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
            answer = self._run.ask(make_line(command, **values), ANSWERED_WITHIN)
            if answer.what:
                return answer.what
            self._take(answer)
            return "" if answer.status is not None else _SILENT

    def close(self) -> None:
        """Lets go of the connection."""
        with self._lock:
            self._let_go()

    def _take(self, answer: Answer) -> None:
        """An answer counts as new data; silence leaves the old, which then becomes stale."""
        if answer.status is not None:
            self.last = Look(answer.status, time.monotonic())
        elif answer.ended:
            self._let_go()
            self.last = Look(None, time.monotonic())

    def _connect(self) -> list[int]:
        """Finds the run on this bus; where there is none, which runs did not say how they stand."""
        links, silent = self._links.enter_context(ExitStack()), []
        for run in links.enter_context(find_runs()):
            link = RunLink(run)
            answer = link.ask(make_line("status"), PATIENCE)
            if answer.status is not None and answer.status["bus"] == self._bus:
                self._run = link
                self._count += 1
                return []
            if answer.status is None and not answer.ended:
                silent.append(run.process)
        self._let_go()
        return silent

    def _let_go(self) -> None:
        self._run = None
        self._links.close()


# Images of the cameras that measure a run, with outlines of what is seen in them.


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

    from tracking.track import draw_outline

    drawn = draw_outline(newest.image, rig, rig.camera(name), newest.found)
    height, width = newest.image.shape
    if width > WIDEST:
        size = (WIDEST, round(height * WIDEST / width))
        drawn = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    _, file = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return file.tobytes()
