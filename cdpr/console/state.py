"""Data sent to every page: started verbs, stored state, jog session, files to choose from."""

from __future__ import annotations

import os
import pwd
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cdpr.console.commands import PageControl
from cdpr.console.view import measured_data
from drivers.can_bus import BusSettings
from executor.drives import is_simulated
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock, reference_status
from executor.interlock.locks import ControlLock
from executor.jogging import FASTEST
from executor.recording.record_files import RUNS
from model.errors import BadInput, CdprError, Refused
from model.pose import Pose
from model.rig import Rig

#: Length of a verb's output that is shown, [characters].
SHOWN = 4000
#: Exit code of a verb that the operator stopped.
STOPPED = 130
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
    """Runs one verb at a time, with output to memory: a pipe would break with the console.

    A file could not be written on a full disk, nor be removed after the end of the console.
    """

    def __init__(self) -> None:
        """Before any verb."""
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._output = -1
        self.verb: str | None = None
        """Name of the running verb."""
        self.outcome: VerbOutcome | None = None
        """Result of the last verb."""
        self.is_under_way = False
        """Whether the running verb's drives may move."""

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

    def follow(self, status: dict[str, Any]) -> None:
        """Notes from a run's status whether the running verb's drives may move."""
        with self._lock:
            is_own = self._process is not None and self._process.pid == status["process"]
            if is_own and status["state"] != "preparing":
                self.is_under_way = True

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
        output = os.memfd_create(f"cdpr-{verb}")
        if verb == "jog":  # ends with the console, also if that is killed
            arguments = [*arguments, "--end-with", str(os.getpid())]
        command = [sys.executable, "-c", "from cdpr.cli import main; main()", verb, *arguments]
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, "NO_COLOR": "1", "COLUMNS": "100"},
                start_new_session=True,
            )
        except BaseException:
            os.close(output)
            raise
        self._output, self.verb, self.outcome = output, verb, None
        self.is_under_way = False

    def _update(self) -> str:
        if self._process is None or self.verb is None:
            return ""
        code = self._process.poll()
        written = os.pread(self._output, os.fstat(self._output).st_size, 0)
        text = written.decode(encoding="utf-8", errors="replace")
        if code is not None:
            self.outcome = _outcome(self.verb, code, text)
            os.close(self._output)
            self._process = self.verb = None
        lines = text.strip().splitlines()
        return lines[-1].strip() if lines else ""


class BusControl:
    """Gives a page control only while no other console of this robot has a page with control."""

    def __init__(self, rig: Rig, pages: PageControl, guard: threading.Lock) -> None:
        """No page has control.

        Args:
            rig: The robot and its bus.
            pages: Of this console.
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


def _outcome(verb: str, code: int, text: str) -> VerbOutcome:
    if code == -signal.SIGTERM:
        code, text = STOPPED, f"{text}\n{BEFORE_MOTION}"
    if code and not text.strip():
        text = f"`cdpr {verb}` ended with exit code {code} and no message."
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
    """Files to choose from, in the console's working folder, and those that cannot be named."""
    here = Path()
    plans = sorted({*here.glob("*.json"), *here.glob("plans/*.json"), *MADE.glob("*.plan.json")})
    folders = (here, here / "scenes", here / "configs")
    scenes = sorted({path for folder in folders for path in folder.glob("*.yaml")})
    found = {
        "plans": [str(path) for path in plans if _contains(path, '"kind": "cdpr-plan"')],
        "scenes": [str(path) for path in scenes if _contains(path, "\ngoal:")],
    }
    named = {kind: [name for name in names if _is_text(name)] for kind, names in found.items()}
    others = [name for names in found.values() for name in names if not _is_text(name)]
    return {**named, "left_out": [os.fsencode(name).decode("utf-8", "replace") for name in others]}


def _is_text(name: str) -> bool:
    """Whether a file name is UTF-8, as all names in messages and plans are."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


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
    ahead = {"limit": None, "room_mm": None}
    if jog and jog["limit"]:
        short = jog["limit"].partition(" with the platform at ")[0]
        ahead = {"limit": short, "room_mm": jog["room_mm"]}
    return {**_session_state(status, jog, why_not), **ahead}


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
