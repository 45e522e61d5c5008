"""Follows the run on the rig's bus over its command socket, its robot, and its cameras' images.

It reconnects to the next run, and follows a motion in preparation while there is no run. At rest
the drives are read. Detections are outlined in the images.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

from cdpr.console.view import RobotReport, RobotView, commanded_pose
from drivers.can_errors import ForeignMaster, OtherMaster
from executor.cameras.live_image import ImageReader, LiveImage
from executor.drives import is_simulated
from executor.remote.client import Answer, RunLink, cable_tension
from executor.remote.command_socket import find_runs
from executor.remote.protocol import make_line
from executor.remote.status import bus_name
from executor.service import StatusResult
from model.errors import CdprError, Refused
from model.pose import Pose
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
#: Commands for the rest of a path, and states after it.
_ON_PATH = frozenset({"hold", "resume", "speed"})
_OVER = {
    "stopping": "is stopping",
    "securing": "is over",
    "finished": "is over",
    "stopped": "is over: it was stopped",
    "latched": "is over: a fault stopped it",
}
_NONE = "no motion of this user is in progress"
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
    """Follows the runs on the bus of a rig; thread-safe."""

    def __init__(self, rig: Rig) -> None:
        """Starts unconnected."""
        self._rig = rig
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
        """
        with self._lock:
            if self._run is None:
                return _NONE
            if self._run.owed:
                self._take(self._run.hear(PATIENCE))
                if self._run is None:
                    return _NONE
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
            if answer.status is None:
                return _SILENT
            over = _OVER.get(answer.status["state"]) if command in _ON_PATH else None
            return f"the run {over}; `{command}` has no effect" if over else ""

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
        """Whether a run is on this bus, whose serial adapter may have another number since."""
        if status["bus"] != bus_name(self._rig):
            return False
        # Drives simulated by each run share no bus: other robots' runs have the same bus name.
        return not is_simulated(self._rig) or status["rig"] == self._rig.name

    def _disconnect(self) -> None:
        self._run = None
        self._links.close()


# Pose and tensions of the robot.
#: Drives that another program used are read again after this time, [s].
USED_FOR = 1.0


class RobotWatch:
    """The robot of the run that reports; at rest, from the last reading of its drives.

    At rest the drives are read after each motion and when `ask` is called, not repeatedly: a drive
    answers one reader at a time, which may be a program of another computer, and a serial adapter
    has one user.
    """

    def __init__(
        self, view: RobotView, read: Callable[[], StatusResult] | None, pool: ThreadPoolExecutor
    ) -> None:
        """Before any status.

        Args:
            read: Reads the drives; None if each run simulates its own.
            pool: Reads them without blocking.
        """
        self._view, self._read, self._pool = view, read, pool
        self._lock = threading.Lock()
        self._answer: Future[StatusResult] | None = None
        self._due = 0.0  # when to read the drives, on the monotonic clock; at the start
        why_not = "the drives have not been read yet"
        self.now = RobotReport(None, None, why_not=why_not, is_unread=True)

    def simulate_at(self, pose: Pose) -> None:
        """Places the robot where simulated drives start."""
        robot = self._view.simulated_at(pose)
        self.now = RobotReport(robot, [round(tension, 2) for tension in robot.tensions])

    def ask(self) -> None:
        """Requests a reading of the drives, at rest."""
        self._due = 0.0

    def pose(self, status: dict[str, Any] | None) -> Pose:
        """The pose commanded by a jog, or else from the encoders, which are read at rest.

        Args:
            status: See `executor.remote.status`; None at rest.

        Raises:
            Refused: It is unknown, or the drives are elsewhere than commanded.
        """
        if status is None:
            self._read_now()
        seen = self.now
        if seen.robot is None or (status is None and seen.why_not):
            raise Refused(
                "the platform's pose is not known",
                where="console",
                why=seen.why_not or "no run has reported it",
                next_step="read the drives; home those that lost their reference",
            )
        jog = (status or {}).get("jog")
        return seen.robot.pose if jog is None else commanded_pose(self._view.rig, jog, seen.robot)

    def pose_at_rest(self) -> Pose | None:
        """The pose from the encoders, read now; None if unknown, or if a run simulates the drives.

        An old reading must not refuse a run: the platform may have been moved since.
        """
        if self._read is None:
            return None
        self._read_now()
        seen = self.now
        return None if seen.robot is None or seen.why_not else seen.robot.pose

    def _read_now(self) -> None:
        """Reads the drives at rest in this thread."""
        if self._read is not None:
            self._take_reading(self._read)

    def update(self, status: dict[str, Any] | None, *, is_busy: bool) -> None:
        """Takes a run's status, or what was read at rest.

        Args:
            status: See `executor.remote.status`; None at rest.
            is_busy: A motion is in progress or being prepared.
        """
        if status is not None and status["drives"]:
            robot = self._view.take(status)
            why_not = None if robot else "the cables fit no pose; some may be slack"
            tensions = [cable_tension(drive) for drive in status["drives"]]
            self.now = RobotReport(robot, tensions, why_not=why_not)
        elif self._read is not None:
            with self._lock:
                if self.now.at is None and self.now.tensions is not None:
                    self.now = replace(self.now, at=_local_time())  # the run reports no more
        if self._answer is not None and self._answer.done():
            answer, self._answer = self._answer, None
            if not is_busy:
                self._take_reading(answer.result)
        if is_busy:
            self._due = 0.0
        elif self._read is not None and self._answer is None and time.monotonic() >= self._due:
            self._due = math.inf
            self._answer = self._pool.submit(self._read)

    def _take_reading(self, read: Callable[[], StatusResult]) -> None:
        """Takes a reading; silent drives leave nothing known but a loss of the reference."""
        try:
            result = read()
            if result.missing is not None:
                raise result.missing
        except Exception as error:  # such as an adapter that was unplugged
            why = error.what if isinstance(error, CdprError) else f"{type(error).__name__}: {error}"
            seen = RobotReport(
                robot=None,
                tensions=None,
                at=_local_time(),
                why_not=why,
                why_lost=self.now.why_lost,
                is_unread=True,
                in_use=isinstance(error, (ForeignMaster, OtherMaster)),
            )
        else:
            if result.drives is None:
                self._due = time.monotonic() + USED_FOR
                used = "another program uses the drives"
                at = _local_time() if self.now.tensions is None else self.now.at
                seen = replace(self.now, at=at, why_not=used, in_use=True)
            else:
                robot, reference = self._view.at_rest(result), result.reference
                why_not = result.why_no_pose or reference.why_not
                tensions = [
                    round(drive.tension, 2) if drive.has_torque else None for drive in result.drives
                ]
                seen = RobotReport(robot, tensions, _local_time(), why_not, reference.why_lost)
        with self._lock:
            self.now = seen


def _local_time() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")


# Images of the cameras that measure a run, with outlines of the detections.
#: Largest width of an image, [px], and its JPEG quality.
WIDEST, QUALITY = 640, 70


class CameraImages:
    """The newest image of each camera; thread-safe.

    Compression takes a few milliseconds of this process, none of the run's. A request during a
    compression gets the previous image.
    """

    def __init__(self) -> None:
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
