"""The verbs of `cdpr` that the console starts, one at a time, and their results."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from executor.drives import is_simulated
from executor.jogging import FASTEST
from executor.recording.record_files import RUNS
from model.errors import CdprError, Refused
from model.pose import Pose
from model.rig import Rig
from model.scene import load_scene

#: Length of a verb's output that is shown, [characters].
SHOWN = 4000
#: Exit code of a verb that the operator stopped.
STOPPED = 130
BEFORE_MOTION = "Stopped during the preparation: nothing was moved."
#: Verbs after which drives move, or let go.
MOVING = frozenset({"home", "jog", "release", "run"})
_HELD = ("--hold-to-run", "--speed-mm-s", f"{1e3 * FASTEST:g}")
_REPORT = re.compile(r"(\S+/report\.html)")
_HELP = re.compile(r"details: cdpr explain (\w+)")


@dataclass(frozen=True, slots=True, eq=False)
class ConsoleFiles:
    """Files and options of a console.

    Attributes:
        rig_file: Path passed to verbs.
        rig: The robot and its bus.
        bus_options: Command-line options for that bus.
        calibration_options: Command-line options for the rig's calibration results.
        cameras: Sources that measure runs, the first also homing; may be empty.
        scene_file: Obstacles and payload, if given.
        without_real_time: Verbs move even if real-time scheduling is denied.
        read_only: Only STOP is accepted.
    """

    rig_file: Path
    rig: Rig
    bus_options: tuple[str, ...]
    calibration_options: tuple[str, ...]
    cameras: tuple[str, ...]
    scene_file: Path | None
    without_real_time: bool
    read_only: bool

    # Arguments of verbs, without options of the bus and of real time.

    def home_arguments(self) -> list[str]:
        """Of `cdpr home`: with the first camera, else on the jig at the rig's home pose."""
        how = ["--camera", self.cameras[0]] if self.cameras else ["--at-home"]
        return [str(self.rig_file), *how]

    def run_arguments(self, plan: str, plan_hash: str) -> list[str]:
        """Of `cdpr run` for a plan file, if it has this hash."""
        cameras = [text for source in self.cameras for text in ("--camera", source)]
        if not (cameras or (is_simulated(self.rig) and self.rig.is_tracked)):
            cameras = ["--no-camera"]
        return [plan, "--rig", str(self.rig_file), "--plan-hash", plan_hash, *cameras]

    def jog_arguments(self, pose: Pose | None) -> list[str]:
        """Of a session of `cdpr jog`; one that simulates the drives itself begins at a pose."""
        at: list[str] = []
        if pose is not None and is_simulated(self.rig):
            position = [f"{v:.4f}" for v in 1e3 * pose.position]
            rotation = [f"{v:.9f}" for v in pose.quaternion]
            at = ["--simulated-start-mm", *position, "--simulated-start-wxyz", *rotation]
        scene = self.scene_file
        around = ["--no-scene"] if scene is None else ["--scene", str(scene)]
        return [str(self.rig_file), *_HELD, *around, *at]

    def cable_arguments(self) -> list[str]:
        """Of a session of `cdpr jog` for single cables."""
        return [str(self.rig_file), *_HELD, "--one-cable"]

    def plan_arguments(self, scene: Path, output: Path, objective: str) -> list[str]:
        """Of `cdpr plan` for a scene file.

        Raises:
            BadInput: The scene cannot be read.
        """
        cost = [] if objective == "shortest" else ["--cost", objective]
        if load_scene(scene).rotation_limits is not None:
            cost.append("--free-rotation")
        options = ["-o", str(output), "--force", *cost, *self.calibration_options]
        return [str(self.rig_file), str(scene), *options]


@dataclass(frozen=True, slots=True)
class VerbOutcome:
    """The result of a verb.

    Attributes:
        verb: Name.
        exit_code: Of the process.
        text: The end of its output.
        report: Path of the run's report, if one was written.
        fault: Code of the first fault that the output explains.
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

    def __init__(self, files: Sequence[Path]) -> None:
        """Before any verb.

        Args:
            files: That describe the robot, to the console and to the verbs, which read them again.
        """
        self._contents = {file: _content(file) for file in files}
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._output = -1
        self.verb: str | None = None
        """Name of the running verb."""
        self.outcome: VerbOutcome | None = None
        """Result of the last verb."""
        self.is_under_way = False
        """Whether the running verb's drives may move."""
        self._jogs_cables = False

    def start(self, verb: str, arguments: Sequence[str], require: Callable[[], None]) -> None:
        """Starts a verb without a terminal.

        Args:
            arguments: On its command line.
            require: Raises `Refused` if it is not to be started any more. A stop after this check
                finds the verb started, and ends it.

        Raises:
            Refused: Another verb is running, a file changed that describes the robot, or the verb
                is not to be started.
        """
        with self._lock:
            require()
            self._require_same_robot()
            self._update()
            if self.verb is not None:
                raise Refused(
                    f"`cdpr {self.verb}` is still running",
                    where="console",
                    next_step="wait until it ends, or stop it",
                )
            self._start(verb, arguments)

    def _require_same_robot(self) -> None:
        for file, content in self._contents.items():
            if _content(file) != content:
                raise Refused(
                    f"{file} changed since the console began",
                    where="console",
                    why="the page shows the robot as it was described then",
                    next_step="restart the console; nothing was started",
                )

    def fail(self, error: CdprError) -> None:
        """Notes that the last verb's result cannot be used, unless another one was started."""
        with self._lock:
            if self.outcome is not None:
                self.outcome = replace(self.outcome, exit_code=error.exit_code, text=str(error))

    @property
    def has_succeeded(self) -> bool:
        """Whether the last verb ended without an error."""
        return self.outcome is not None and self.outcome.exit_code == 0

    @property
    def prepares_cable_jog(self) -> bool:
        """Whether a session of single cables is being prepared."""
        return self._jogs_cables and self.verb is not None and not self.is_under_way

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
        self.is_under_way, self._jogs_cables = False, "--one-cable" in arguments

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


def _content(file: Path) -> bytes | None:
    """Content of a file; None if it cannot be read."""
    try:
        return file.read_bytes()
    except OSError:
        return None


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
        fault=fault[0] if fault else None,  # those that stop no run are last
    )


def _without_commands(text: str) -> str:
    """Output without the commands that a terminal would need next: the page has buttons."""
    return re.sub(r"(?m)^\s*next:?\s+cdpr .*\n?", "", text)


def busy_state(verb: str | None, line: str, loading: str | None) -> dict[str, str] | None:
    """What the console is doing, if anything.

    Args:
        verb: That is running.
        line: The last one of its output.
        loading: The plan that is being read and checked.
    """
    if verb is not None:
        return {"verb": verb, "text": line}
    return None if loading is None else {"verb": "load", "text": loading}


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
