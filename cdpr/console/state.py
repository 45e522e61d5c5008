"""Data sent to every page: stored state, control, jog session, files to choose from."""

from __future__ import annotations

import asyncio
import math
import os
import pwd
import re
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cdpr.console.commands import PageControl, Seen
from cdpr.console.view import RobotReport, measured_view
from drivers.can_bus import BusSettings
from executor.drives import is_simulated
from executor.interlock.fault_latch import FaultLatch, LatchedFault
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.interlock.locks import ControlLock, SetUpLock
from executor.jogging import FASTEST
from model.errors import BadInput, CdprError
from model.rig import Rig

#: States in transit to a page at a time: more would queue in a slow connection, each older.
MOST_IN_TRANSIT = 2
#: Time for which the page shows that a press did not begin, [s].
NOT_BEGUN_SHOWN = 5.0
_IF_IT_MOVES = "press the emergency stop if the robot moves"
#: Folder of the plans and scenes that the console writes.
MADE = Path("console")


class BusControl:
    """Gives a page control only while no other console of this robot has a page with control."""

    def __init__(self, rig: Rig, pages: PageControl, guard: threading.Lock) -> None:
        """No page has control.

        Args:
            rig: The robot and its bus.
            guard: Held while they change.
        """
        self._pages, self._guard = pages, guard
        self._lock = ControlLock(BusSettings.of(rig))
        self.close = self._lock.release

    def take(self, page: int, *, moving: bool, force: bool) -> str:
        """See `PageControl.take`; another console is asked for control first."""
        name = f"{self._pages.name(page)} (console {os.getpid()} of {_user()})"
        if why_not := self._lock.take(name, force=force and not moving):
            return why_not
        with self._guard:
            if not self._lock.is_held:  # released since, as no page had control
                return "control was released meanwhile: take it again"
            return self._pages.take(page, moving=moving, force=force)

    def update(self, *, moving: bool) -> int | None:
        """Gives control up if no page has it, or at rest if another console asks for it.

        Returns:
            The press that a page held, if any.
        """
        press = None
        with self._guard:
            holder = self._pages.holder
            if holder is not None and not moving and self._lock.is_wanted():
                press, holder = self._pages.give(holder), None
            if holder is None:
                self._lock.release()
                self._pages.elsewhere = self._lock.holder()
        return press


def _user() -> str:
    with suppress(KeyError):
        return pwd.getpwuid(os.getuid()).pw_name
    return f"user {os.getuid()}"


def local_file(name: str) -> Path:
    """A file below the console's working folder.

    Raises:
        BadInput: It is elsewhere.
    """
    path = Path(name)
    if not path.resolve().is_relative_to(Path.cwd().resolve()):
        raise BadInput(
            f"{name} is not below the console's working folder",
            where="console",
            next_step="copy it there, or start the console in another folder",
        )
    return path


def plans_and_scenes() -> dict[str, list[str]]:
    """Files to choose from, in the console's working folder, and those that cannot be named."""
    here = Path()
    plans = sorted({*here.glob("*.json"), *here.glob("plans/*.json"), *MADE.glob("*.plan.json")})
    folders = (here, here / "scenes", here / "configs")
    endings = ("*.yaml", "*.yml")
    scenes = sorted({path for folder in folders for end in endings for path in folder.glob(end)})
    found = {
        "plans": [str(path) for path in plans if _contains(path, r'"kind"\s*:\s*"cdpr-plan"')],
        "scenes": [str(path) for path in scenes if _contains(path, r"(?m)^goal\s*:")],
    }
    named = {kind: [name for name in names if _is_text(name)] for kind, names in found.items()}
    others = [name for names in found.values() for name in names if not _is_text(name)]
    return {**named, "left_out": [os.fsencode(name).decode("utf-8", "replace") for name in others]}


def _is_text(name: str) -> bool:
    """Whether a file name is UTF-8, as all names in messages and plans are."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


def _contains(path: Path, pattern: str) -> bool:
    with suppress(OSError), path.open(encoding="utf-8", errors="replace") as stream:
        return re.search(pattern, stream.read(100_000)) is not None
    return False


@dataclass(frozen=True, slots=True)
class StoredState:
    """Stored state of a bus.

    Attributes:
        latched: Cause of the latched fault, if any.
        referenced: Whether the drives are homed.
        why_not: Reason if they are not.
        moved_by: Process of another user that moves or resets the drives, if any.
    """

    latched: str | None
    referenced: bool
    why_not: str | None
    moved_by: int | None = None


def stored_state(stored: StoredState, seen: RobotReport) -> dict[str, Any]:
    """The fault latch, a motion of another user, and the homing reference.

    Args:
        stored: From their files.
        seen: The drives, as read.
    """
    why_not = stored.why_not or seen.why_lost
    is_known = why_not is not None or not seen.is_unread
    reference = {
        "counts": stored.referenced and is_known and why_not is None,
        "known": is_known,
        "why_not": why_not if is_known else seen.why_not,
    }
    return {"latched": stored.latched, "moved_by": stored.moved_by, "reference": reference}


def read_stored(rig: Rig, *, is_moving: bool) -> StoredState:
    """Reads the fault latch and the homing reference of a bus from their files."""
    if is_simulated(rig):
        return StoredState(None, True, None)
    fault = moved_by = None
    try:
        fault, moved_by = _read_latch(rig)
        why = reference_status(MotionInterlock(rig)).why_not
    except CdprError as error:
        why = error.what
    cause = None if fault is None or is_moving else fault.cause
    return StoredState(cause, not why, why, moved_by)


def _read_latch(rig: Rig) -> tuple[LatchedFault | None, int | None]:
    """The latched fault, or the process of another user that moves or resets the drives."""
    fault, process = FaultLatch(BusSettings.of(rig)).read_in_motion()
    if process:
        try:
            os.kill(process, 0)  # only asks whether it may be signalled
        except ProcessLookupError:  # it has just ended
            return fault, None
        except PermissionError:
            return fault, process
    return fault, None


def not_stopped(rig: Rig, at_rest: threading.RLock | None) -> str:
    """What a stop of this user's runs leaves moving on a rig's bus; empty if nothing is found.

    Args:
        rig: The robot and its bus.
        at_rest: Held while this console reads the drives; None while it may use them otherwise.
    """
    if is_simulated(rig):
        return ""
    try:
        _, process = _read_latch(rig)
        is_set_up = process is None and _is_set_up_elsewhere(rig, at_rest)
    except CdprError as error:
        return f"whether another user moves the robot is unknown: {error.what}"
    if process is not None:
        return (
            f"a motion of another user, process {process}, is not stopped from here:"
            " press the emergency stop"
        )
    if is_set_up:
        return f"another program sets up or reads the drives and is not stopped: {_IF_IT_MOVES}"
    return ""


def _is_set_up_elsewhere(rig: Rig, at_rest: threading.RLock | None) -> bool:
    """Whether another program sets up the drives for a motion, or reads them."""
    if at_rest is None or not at_rest.acquire(blocking=False):
        return False
    try:
        with SetUpLock(BusSettings.of(rig)).tried() as is_free:
            return not is_free
    finally:
        at_rest.release()


def none_found(rig: Rig, seen: RobotReport) -> str:
    """Answer to a stop that found no motion; one of another user may be unknown here.

    Args:
        rig: The robot and its bus.
        seen: The drives, as read.
    """
    if is_simulated(rig):
        return "nothing moves"
    if seen.in_use:
        return f"as last read, {seen.why_not}: {_IF_IT_MOVES}"
    return f"no motion of this user was found: {_IF_IT_MOVES}"


def jog_state(status: dict[str, Any] | None) -> dict[str, Any]:
    """Whether the platform can be jogged, and how far.

    Args:
        status: Of the run, see `executor.remote.status`; None at rest.
    """
    why_not = "the drives are not enabled for jogging"
    if status is not None and "cable_jog" in status:
        why_not = "single cables are being jogged: end that first"
    jog = None if status is None else status.get("jog")
    ahead = {
        "limit": None,
        "room_mm": None,
        "not_begun": None if jog is None else _not_begun(status),
    }
    if jog and jog["limit"]:
        short = jog["limit"].partition(" with the platform at ")[0]
        ahead |= {"limit": short, "room_mm": jog["room_mm"]}
    return {**_session_state(status, jog, why_not), **ahead}


def _not_begun(status: dict[str, Any] | None) -> str | None:
    """Why the newest press did not begin, for a few seconds after it; None if it did."""
    if status is None or not status["events"]:
        return None
    event = status["events"][-1]
    is_recent = status["elapsed_s"] - event["time_s"] <= NOT_BEGUN_SHOWN
    return event["text"] if event["code"] == "jog_not_begun" and is_recent else None


def cable_state(status: dict[str, Any] | None) -> dict[str, Any]:
    """Whether single cables can be jogged, which one moved, and how far.

    Args:
        status: As for `jog_state`.
    """
    why_not = "the drives are not enabled for single cables"
    if status is not None and "jog" in status:
        why_not = "the platform is being jogged: end that first"
    jog = None if status is None else status.get("cable_jog")
    names = ("cable", "press_mm", "session_mm", "limit", "limit_n")
    shown = {name: jog[name] if jog else None for name in names}
    return {**_session_state(status, jog, why_not), **shown}


def _session_state(
    status: dict[str, Any] | None, jog: dict[str, Any] | None, why_not: str
) -> dict[str, Any]:
    """State of a jog session, or why there is none."""
    if status is None or jog is None:
        return {"ready": False, "why_not": why_not, "moving": False, "speed_mm_s": 1e3 * FASTEST}
    ready = status["state"] == "moving"
    is_latched = status["state"] == "latched"
    why_not = "a fault is latched" if is_latched else f"the drives are {status['state']}"
    return {
        "ready": ready,
        "why_not": None if ready else why_not,
        "moving": bool(status["feed_percent"]),
        "speed_mm_s": jog["speed_mm_s"],
    }


def measured_state(status: dict[str, Any] | None, age: float) -> dict[str, Any] | None:
    """The pose measured by the cameras of a run.

    Args:
        status: As for `jog_state`.
        age: Of the status, [s].
    """
    measured = None if status is None else status["measured"]
    if status is None or measured is None or status["elapsed_s"] is None:
        return None
    return measured_view(measured, max(0.0, status["elapsed_s"] - measured["time_s"]) + age)


# States in transit to the pages.


class StateTimes:
    """Numbers of the states, and when the newest were made."""

    def __init__(self, kept: int) -> None:
        """Before any state; keeps the times of that many."""
        self.seq = 0
        """Number of the newest; 0 before any."""
        self._made: deque[float] = deque(maxlen=kept)

    @property
    def newest(self) -> float:
        """When the newest one was made, [s]."""
        return self._made[-1]

    def add(self, now: float) -> None:
        """Counts a state made now, [s]."""
        self.seq += 1
        self._made.append(now)

    def behind(self, seq: int, now: float) -> float:
        """How long ago the state was made that follows a page's newest one, [s]; 0 if none.

        By this computer's clock alone: it bounds the delay of the connection, there and back.
        """
        missed = self.seq - seq
        if missed <= 0:  # or a state of another server
            return 0.0 if missed == 0 else math.inf
        return now - self._made[max(-missed, -len(self._made))]


class StateFlow:
    """States in transit to a page, and what the page needs to know how old they are.

    A state has the time when it was made, and names the newest acknowledgement before it: when the
    page sent it, by the page's clock, and when it arrived here. As it was sent before it arrived,
    the difference of the clocks, and with it the age of a state, is known on one side.
    """

    def __init__(self) -> None:
        self._sent: list[int] = []
        self._has_room = asyncio.Event()
        self._has_room.set()
        self.echo: dict[str, float] | None = None
        """The newest acknowledgement: ``at_ms`` of the page, and when it was ``received_ms``."""

    async def room(self) -> None:
        """Waits until another state may be sent."""
        await self._has_room.wait()

    def send(self, seq: int) -> None:
        """Notes a state as sent."""
        self._sent.append(seq)
        if len(self._sent) >= MOST_IN_TRANSIT:
            self._has_room.clear()

    def take(self, message: Seen, now: float) -> None:
        """Takes an acknowledgement, of this state and those before it, received now [s]."""
        left = [seq for seq in self._sent if seq > message.seq]
        if len(left) < len(self._sent):  # one that was sent and not acknowledged before
            self._sent = left
            self.echo = {"at_ms": message.at_ms, "received_ms": 1e3 * now}
            self._has_room.set()
