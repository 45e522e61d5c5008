"""Data sent to every page: started verbs, stored state, jog session, files to choose from."""

from __future__ import annotations

import asyncio
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cdpr.console.commands import Seen
from cdpr.console.view import measured_data
from drivers.can_bus import BusSettings
from executor.drives import is_simulated
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.jogging import FASTEST
from executor.recording.record_files import RUNS
from model.errors import BadInput, CdprError, Refused
from model.pose import Pose
from model.rig import Rig

#: Length of a verb's output that is shown, [characters].
SHOWN = 4000
#: Exit code of a verb that the operator stopped.
STOPPED = 130
#: States in transit to a page at a time: more would queue in a slow connection, each older.
MOST_IN_TRANSIT = 2
#: Time for which the page shows that a press did not begin, [s].
NOT_BEGUN_SHOWN = 5.0
BEFORE_MOTION = "Stopped during the preparation: nothing was moved."
#: Folder of the plans and scenes that the console writes.
MADE = Path("console")
#: Verbs after which drives move, or let go.
MOVING = frozenset({"home", "jog", "release", "run"})
_REPORT = re.compile(r"(\S+/report\.html)")
_HELP = re.compile(r"docs/faults/(\w+)\.md")


@dataclass(frozen=True, slots=True)
class VerbOutcome:
    """The result of a verb.

    Attributes:
        verb: Name.
        exit_code: Of the process.
        text: The end of its output.
        report: Path of the run's report, if one was written.
        fault: Code of the fault whose help page the output names.
    """

    verb: str
    exit_code: int
    text: str
    report: Path | None
    fault: str | None


class StartedVerb:
    """Runs one verb at a time, with output to a file: a pipe would break with the console."""

    def __init__(self) -> None:
        """Before any verb."""
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._output = Path()
        self.verb: str | None = None
        """Name of the running verb."""
        self.outcome: VerbOutcome | None = None
        """Result of the last verb."""
        self.is_under_way = False
        """Whether the running verb has answered as a run, and takes its requests."""

    def start(self, verb: str, arguments: Sequence[str]) -> None:
        """Starts a verb without a terminal.

        Raises:
            Refused: Another verb is running.
        """
        with self._lock:
            self._update()
            if self.verb is not None:
                raise Refused(
                    f"`cdpr {self.verb}` is still running",
                    where="console",
                    next_step="wait until it ends, or stop it",
                )
            self._start(verb, arguments)

    def fail(self, error: CdprError) -> None:
        """Notes that the last verb's result cannot be used, unless another one was started."""
        with self._lock:
            if self.outcome is not None:
                self.outcome = replace(self.outcome, exit_code=error.exit_code, text=str(error))

    def stop_before_motion(self) -> bool:
        """Ends a verb that would move drives but is still being prepared; returns whether it did.

        One that has just begun to move takes the signal as a request to stop.
        """
        with self._lock:
            if self._process is None or self.verb not in MOVING or self.is_under_way:
                return False
            self._process.terminate()
            return True

    def update(self) -> str:
        """The last line of the verb's output; records its end."""
        with self._lock:
            return self._update()

    def _start(self, verb: str, arguments: Sequence[str]) -> None:
        descriptor, name = tempfile.mkstemp(prefix=f"cdpr-{verb}-", suffix=".log")
        command = [sys.executable, "-c", "from cdpr.cli import main; main()", verb, *arguments]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=descriptor,
                stderr=subprocess.STDOUT,
                env={**os.environ, "NO_COLOR": "1", "COLUMNS": "100"},
                start_new_session=True,
            )
        finally:
            os.close(descriptor)
        self._output, self.verb, self.outcome = Path(name), verb, None
        self.is_under_way = False

    def _update(self) -> str:
        if self._process is None or self.verb is None:
            return ""
        text = self._output.read_text(encoding="utf-8", errors="replace")
        code = self._process.poll()
        if code is not None:
            self.outcome = _outcome(self.verb, code, text)
            self._output.unlink(missing_ok=True)
            self._process = self.verb = None
        lines = text.strip().splitlines()
        return lines[-1].strip() if lines else ""


def _outcome(verb: str, code: int, text: str) -> VerbOutcome:
    if code == -signal.SIGTERM:
        code, text = STOPPED, f"{text}\n{BEFORE_MOTION}"
    report, fault = _REPORT.findall(text), _HELP.findall(text)
    return VerbOutcome(
        verb=verb,
        exit_code=code,
        text=_without_commands(text).strip()[-SHOWN:],
        report=Path(report[-1]) if report else None,
        fault=fault[-1] if fault else None,
    )


def _without_commands(text: str) -> str:
    """Output without the commands that a terminal would need next: the page has buttons."""
    return re.sub(r"(?m)^\s*next:?\s+cdpr .*\n?", "", text)


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
    """Files to choose from, in the console's working folder."""
    here = Path()
    plans = sorted({*here.glob("*.json"), *here.glob("plans/*.json"), *MADE.glob("*.plan.json")})
    folders = (here, here / "scenes", here / "configs")
    scenes = sorted({path for folder in folders for path in folder.glob("*.yaml")})
    return {
        "plans": [str(path) for path in plans if _contains(path, '"kind": "cdpr-plan"')],
        "scenes": [str(path) for path in scenes if _contains(path, "\ngoal:")],
    }


def _contains(path: Path, text: str) -> bool:
    with suppress(OSError), path.open(encoding="utf-8", errors="replace") as stream:
        return text in stream.read(100_000)
    return False


@dataclass(frozen=True, slots=True)
class StoredState:
    """Stored state of a bus.

    Attributes:
        latched: Cause of the latched fault, if any.
        referenced: Whether the drives are homed.
        why_not: Reason if they are not.
    """

    latched: str | None
    referenced: bool
    why_not: str | None


def stored_state(stored: StoredState) -> dict[str, Any]:
    """The fault latch and the homing reference."""
    reference = {"counts": stored.referenced, "why_not": stored.why_not}
    return {"latched": stored.latched, "reference": reference}


def read_stored(rig: Rig, *, is_moving: bool) -> StoredState:
    """Reads the fault latch and the homing reference of a bus from their files."""
    if is_simulated(rig):
        return StoredState(None, True, None)
    fault = None
    try:
        fault = FaultLatch(BusSettings.of(rig)).read()
        why = reference_status(MotionInterlock(rig)).why_not
    except CdprError as error:
        why = error.what
    return StoredState(None if fault is None or is_moving else fault.cause, not why, why)


def start_options(rig: Rig, pose: Pose | None) -> list[str]:
    """Options of `cdpr jog` that begin at a pose, where it simulates the drives itself."""
    if pose is None or not is_simulated(rig):
        return []
    position = [f"{v:.4f}" for v in 1e3 * pose.position]
    rotation = [f"{v:.9f}" for v in pose.quaternion]
    return ["--simulated-start-mm", *position, "--simulated-start-wxyz", *rotation]


def outcome_state(ended: VerbOutcome | None) -> dict[str, Any] | None:
    """The last verb's result, with addresses of its report and help page."""
    if ended is None:
        return None
    return {
        "verb": ended.verb,
        "ok": ended.exit_code == 0,
        "stopped": ended.exit_code == STOPPED,
        "text": ended.text,
        "report": None if ended.report is None else _address_of(ended.report),
        "fault_page": None if ended.fault is None else f"/help/{ended.fault}",
    }


def _address_of(report: Path) -> str | None:
    """Address of a report on this server; None outside the folder of runs."""
    path, root = report.resolve(), RUNS.resolve()
    return f"/runs/{path.relative_to(root)}" if path.is_relative_to(root) else None


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
    return {
        "ready": ready,
        "why_not": None if ready else f"the drives are {status['state']}",
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
    return measured_data(measured, max(0.0, status["elapsed_s"] - measured["time_s"]) + age)


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
        """Starts with nothing in transit."""
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
