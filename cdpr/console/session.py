"""State and commands of the console, independent of the web server."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cdpr.console.commands import (
    AWAITED,
    TO_RUN,
    CompareCommand,
    FileCommand,
    ForgetCommand,
    Held,
    LetGo,
    Message,
    MoveCommand,
    NameCommand,
    PageControl,
    PickCommand,
    PlanCommand,
    RenameCommand,
    ResetCommand,
    RunPlanCommand,
    SpeedCommand,
    TakeCommand,
)
from cdpr.console.state import (
    MADE,
    BusControl,
    StoredState,
    cable_state,
    jog_state,
    local_file,
    measured_state,
    none_found,
    not_stopped,
    read_stored,
    stored_state,
)
from cdpr.console.teach import TaughtPoses, picked_pose, scene_text
from cdpr.console.verbs import ConsoleFiles, StartedVerb, busy_state, outcome_state
from cdpr.console.view import LoadedPlan, RobotView, nearest_data, plan_id, pose_data
from cdpr.console.watch import CameraImages, RobotWatch, RunWatch
from executor.drives import is_simulated
from executor.hold_to_run.presses import press_clock
from executor.remote.client import stop_runs
from executor.remote.command_socket import is_stopped_since
from executor.remote.status import bus_name
from executor.service import StatusResult
from executor.service import status as read_status
from model.errors import CdprError, Refused, without_passwords
from model.files.documents import write_atomic
from model.pose import Pose
from model.scene import empty_scene, load_scene

#: Shortest period of reading the fault latch and the reference, [s].
STORED_EVERY = 0.5
#: A command that waited longer is not begun, [s]: a page reports after 5 s that it got no answer.
LONGEST_WAIT = 4.0


class Console:
    """The console of one rig; thread-safe."""

    def __init__(self, files: ConsoleFiles) -> None:
        """Loads the scene and the taught poses.

        Raises:
            BadInput: The scene, or the file of taught poses, cannot be read.
        """
        self.files, self.rig = files, files.rig
        self.scene = load_scene(files.scene_file) if files.scene_file else None
        self.control = PageControl(press_clock)
        self.verbs = StartedVerb([files.rig_file, *map(Path, files.calibration_options[1::2])])
        self.watch = RunWatch(self.rig)
        self.view = RobotView(files.rig, self.scene)
        self.pictures = CameraImages()
        self.poses = TaughtPoses(MADE / "poses.json")
        self.plan = LoadedPlan(self.rig)
        self._control_lock, self._one_at_a_time = threading.Lock(), threading.RLock()
        self._bus_control = BusControl(self.rig, self.control, self._control_lock)
        self._stopped = -math.inf  # when STOP was last pressed
        self._require_wanted: Callable[[], None]  # of the command that is being executed
        self._line = ""
        self._planned: Path | None = None
        self._asks = ThreadPoolExecutor(1, "cdpr-drives")
        read = None if is_simulated(self.rig) else self._read_drives
        self.robot = RobotWatch(self.view, read, self._asks)
        if is_simulated(self.rig):
            self.robot.simulate_at(self.rig.home)
        self._stored = StoredState(None, False, None)
        self._stored_for: tuple[float, str | None] = (float("-inf"), None)

    # State.
    def update(self) -> dict[str, Any]:
        """The state that all pages show; to be called about 20 times a second."""
        report = self.watch.update()
        self.end_press(self._bus_control.update(moving=report.status is not None))
        self._line = self.verbs.update()
        self._load_planned()
        if report.status is not None:
            self.verbs.follow(report.status)
        is_busy = report.status is not None or self.verbs.verb is not None
        self.robot.update(report.status, is_busy=is_busy)
        self.pictures.watch(report.status, self.view.rig)
        self._read_stored()
        return self._state(report.status, time.monotonic() - report.at)

    def close(self) -> None:
        """Ends jogs begun here and a verb in preparation, and closes all connections.

        A run that moves continues.
        """
        if self.verbs.verb == "jog":
            self.watch.send("end")
        self.verbs.stop_before_motion()
        self._asks.shutdown()
        self.pictures.close()
        self.watch.close()
        self._bus_control.close()

    def _load_planned(self) -> None:
        """Loads the plan that was made here, once it is there; its check takes a moment."""
        if self._planned is None or self.verbs.verb is not None:
            return
        path, self._planned = self._planned, None
        if self.verbs.has_succeeded:
            self._asks.submit(self._load_at_rest, path)

    def _load_at_rest(self, path: Path) -> None:
        try:
            with self._one_at_a_time:
                self.plan.load(path)
        except CdprError as error:  # replaced or removed meanwhile
            self.verbs.fail(error)

    def _read_drives(self) -> StatusResult:
        """Reads the drives; no verb is started meanwhile, as it would find them in use."""
        with self._one_at_a_time:
            return read_status(self.rig)

    def _state(self, status: dict[str, Any] | None, age: float) -> dict[str, Any]:
        seen, rig, verb = self.robot.now, self.view.rig, self.verbs.verb
        robot = seen.robot
        loaded, compared = self.plan.preview, self.plan.compared
        near = None if robot is None else robot.nearest
        return {
            "kind": "state",
            "read_only": self.files.read_only,
            "rig": rig.name,
            "bus": bus_name(rig),
            "simulated": is_simulated(rig),
            "homes_by": without_passwords(self.files.cameras[0]) if self.files.cameras else None,
            "home_mm": np.round(1e3 * rig.home.position, 3).tolist(),
            **stored_state(self._stored, seen),
            "busy": busy_state(verb, self._line, self.plan.loading),
            "outcome": outcome_state(self.verbs.outcome),
            "motion": None if status is None else {**status, "age_s": round(age, 3)},
            "platform": None if robot is None else pose_data(rig, robot.pose, "drives"),
            "tensions_n": seen.tensions,
            "drives_read": seen.as_dict(),
            "tension_limits_n": [rig.min_tension, rig.max_tension],
            "clearance_mm": near and nearest_data(near, self.view.required_clearance),
            "measured": measured_state(status, age),
            "next_stop": None if status is None else status["next_stop"],
            "preview": loaded and plan_id(loaded),
            "plan_start_off_mm": self.plan.off_mm(None if robot is None else robot.pose),
            "compared": compared and plan_id(compared),
            "jog": jog_state(status),
            "cable": cable_state(status),
            "poses": self.poses.as_dicts(),
        }

    def _read_stored(self) -> None:
        """Reads the bus's fault latch and reference from their files, at once when a verb ends."""
        now, verb = time.monotonic(), self.verbs.verb
        homed = self._stored_for[1] == "home" != verb and self.verbs.has_succeeded
        if homed and is_simulated(self.rig):
            self.robot.simulate_at(self.rig.home)
        if verb == self._stored_for[1] and now - self._stored_for[0] < STORED_EVERY:
            return
        self._stored_for = now, verb
        stored = read_stored(self.rig, is_moving=self.watch.last.status is not None)
        if stored != self._stored:  # changed by another program, such as `cdpr reset`
            self.robot.ask()
        self._stored = stored

    # Commands.

    def stop(self) -> str:
        """Stops every run of this user, and a verb in preparation; returns why not, or nothing.

        Commands that arrived before, and have started nothing yet, will start nothing.
        """
        self._stopped = time.clock_gettime(time.CLOCK_BOOTTIME)
        result, ended = stop_runs(), self.verbs.stop_before_motion()
        if result.silent:
            return "a run does not answer: press the emergency stop"
        is_found = ended or bool(result.stopped)
        is_using = is_found or self.verbs.verb not in (None, "plan")
        if why_not := not_stopped(self.rig, None if is_using else self._one_at_a_time):
            return why_not
        return "" if is_found else none_found(self.rig, self.robot.now)

    def command(self, page: int, message: Message, arrived: float) -> str:
        """Executes a page's command except STOP; returns why not, or an empty text.

        Args:
            page: Number of the page.
            arrived: When, [s] of `CLOCK_BOOTTIME`; a later stop cancels it unless it has begun.
        """
        if self.files.read_only:
            return "this console is read-only"
        try:
            return self._command(page, message, arrived)
        except CdprError as error:
            return str(error)
        except Exception as error:  # such as a full disk; the page's next command is executed
            return f"{message.command} failed: {type(error).__name__}: {error}"

    def begin_with(self, path: Path) -> None:
        """Loads a plan; a platform with drives simulated by each run begins at its start.

        Raises:
            BadInput: It cannot be read, or is for another rig.
        """
        self.plan.load(path)
        if is_simulated(self.rig) and self.plan.start is not None:
            self.robot.simulate_at(self.plan.start)

    def _command(self, page: int, message: Message, arrived: float) -> str:
        if isinstance(message, TakeCommand):
            if message.force and message.held_by != self.control.holder_name():
                return "another page has taken control: check which one"
            moving = self.watch.last.status is not None
            why_not = self._bus_control.take(page, moving=moving, force=message.force)
            if not why_not:
                self.robot.ask()  # who operates sees the present drives
            return why_not
        if message.command == "give_control":
            with self._control_lock:
                press = self.control.give(page)
            self.end_press(press)
            return ""
        if self.control.holder != page:
            return "take control first"
        require = partial(self._require, page, arrived)
        if message.command in TO_RUN:
            require(LONGEST_WAIT)
            percent = {"percent": message.percent} if isinstance(message, SpeedCommand) else {}
            return self.watch.send(message.command, **percent)
        if not self._one_at_a_time.acquire(timeout=LONGEST_WAIT):
            return "another command is not finished yet"
        try:
            require(LONGEST_WAIT)
            longest = math.inf if message.command in AWAITED else LONGEST_WAIT
            self._require_wanted = partial(require, longest)
            return self._operate(message)
        finally:
            self._one_at_a_time.release()

    def _require(self, page: int, arrived: float, longest: float) -> None:
        """Requires no stop since a command, control, and a wait of at most ``longest`` [s]."""
        if self._stopped >= arrived or is_stopped_since(arrived):
            raise Refused(
                "STOP was pressed before this command began",
                where="console",
                next_step="give it again when ready; nothing was moved",
            )
        if self.control.holder != page:
            raise Refused("the page lost control before this command began", where="console")
        waited = time.clock_gettime(time.CLOCK_BOOTTIME) - arrived
        if waited > longest:
            raise Refused(
                f"the command waited {waited:.1f} s and was not begun",
                where="console",
                why="a plan was being loaded, or the drives were being read",
                next_step="give it again if it is still wanted; nothing was moved",
            )

    def _operate(self, message: Message) -> str:
        match message:
            case RunPlanCommand():
                return self._run(message.plan)
            case ResetCommand():
                return self._reset(message.cause)
            case FileCommand():
                self.plan.load(local_file(message.file))
            case CompareCommand():
                self.plan.compare(None if message.file is None else local_file(message.file))
            case PlanCommand():
                self._plan(message)
            case NameCommand():
                self.poses.teach(message.name, self._pose_now())
            case PickCommand():
                picked = picked_pose(self.view.rig, message.position_mm, self._pose_now())
                self.poses.teach(message.name, picked)
            case RenameCommand():
                self.poses.rename(message.pose, message.name)
            case MoveCommand():
                self.poses.move(message.pose, message.to)
            case ForgetCommand():
                self.poses.forget(message.pose)
            case _:
                return self._plain(message.command)
        return ""

    def _plain(self, command: str) -> str:
        if command == "read_drives":
            self.robot.ask()
            return ""
        if command in ("service_begin", "service_end"):
            return self._service(on=command == "service_begin")
        verbs: dict[str, Callable[[], str]] = {
            "home": partial(self._start_verb, "home", self.files.home_arguments()),
            "release": partial(self._start_verb, "release", [str(self.files.rig_file)]),
            "jog_begin": self._jog_begin,
            "cable_begin": self._cable_begin,
            "jog_end": self._jog_end,
        }
        return verbs[command]()

    def _reset(self, shown: str | None) -> str:
        stored = read_stored(self.rig, is_moving=self.watch.last.status is not None)
        if stored.latched != shown:
            return "another fault is latched now: read its cause first"
        return self._start_verb("reset", [str(self.files.rig_file)], real_time=False)

    def _run(self, shown: str) -> str:
        if self.plan.preview is None or not self.plan.preview["passed"]:
            return "load a plan that passes its check first"
        if self.plan.preview["hash"] != shown:
            return "a different plan is loaded: review it first"
        if (here := self.robot.pose_at_rest()) is not None and (off := self.plan.off_start(here)):
            return f"the platform is {off} from the plan's start: plan from its current pose"
        arguments = self.files.run_arguments(self.plan.preview["name"], shown)
        return self._start_verb("run", arguments)

    def _jog_begin(self) -> str:
        robot = self.robot.now.robot
        at = None if robot is None else robot.pose
        return self._start_verb("jog", self.files.jog_arguments(at))

    def _cable_begin(self) -> str:
        if not self.control.is_service:
            return "enter service mode first"
        return self._start_verb("jog", self.files.cable_arguments())

    def _jog_end(self) -> str:
        """Ends the session of jogs; one that is being prepared takes only a stop."""
        if self.verbs.verb == "jog" and self.verbs.stop_before_motion():
            return ""
        return self.watch.send("end")

    def _service(self, *, on: bool) -> str:
        """Enters or leaves service mode, the only mode that jogs single cables."""
        status = self.watch.last.status
        jogs_cables = status is not None and "cable_jog" in status
        if on and not jogs_cables and (why_not := self.watch.why_busy()):
            return why_not
        page = self.control.holder
        with self._control_lock:
            press = None if page is None else self.control.set_service(page, on)
        self.end_press(press)
        return self._jog_end() if not on and (jogs_cables or self.verbs.prepares_cable_jog) else ""

    def _start_verb(self, verb: str, arguments: Sequence[str], *, real_time: bool = True) -> str:
        if why_not := self.watch.why_busy():
            return why_not
        relaxed = ["--without-real-time"] if real_time and self.files.without_real_time else []
        rig = (*self.files.bus_options, *self.files.calibration_options)
        self.verbs.start(verb, [*arguments, *rig, *relaxed, "--yes"], self._require_wanted)
        return ""

    def _plan(self, message: PlanCommand) -> None:
        MADE.mkdir(exist_ok=True)
        scene = self._taught_scene(message) if message.scene is None else local_file(message.scene)
        output = MADE / f"{scene.stem}.plan.json"
        arguments = self.files.plan_arguments(scene, output, message.objective)
        self.verbs.start("plan", arguments, self._require_wanted)
        self.plan.forget()
        self._planned = output

    def _taught_scene(self, message: PlanCommand) -> Path:
        around = empty_scene(self.rig) if self.scene is None else self.scene
        begin = self._pose_now() if message.from_here or message.pose is not None else None
        document = self.poses.scene(around, "taught", begin=begin, only=message.pose)
        path = MADE / "taught.yaml"
        write_atomic(path, scene_text(document))
        return path

    def _pose_now(self) -> Pose:
        return self.robot.pose(self.watch.last.status)

    # Jogging.

    def held(self, page: int, message: Held) -> int | None:
        """The press of a held control; None if the page may not move what it controls."""
        motion = 0 if self.files.read_only else self.watch.number
        with self._control_lock:
            if message.cable is not None and not self.control.is_service:
                motion = 0
            return self.control.hold(page, message.hold, message.seq, motion)

    def forward_held(self, press: int, message: Held, received: float) -> None:
        """Passes a report of a press on, with its age; received at a monotonic time, [s]."""
        status = self.watch.last.status or {}
        jog = status.get("jog") or status.get("cable_jog")
        fastest = 1e3 * self.view.rig.motion.speed if jog is None else float(jog["speed_mm_s"])
        percent = min(max(round(100.0 * message.speed_mm_s / fastest), 1), 100)
        what: dict[str, Any] = {"cable": message.cable, "sense": message.sense}
        if message.direction is not None:
            length = math.hypot(*message.direction)
            direction = [v / length for v in message.direction]
            what = {"direction": direction, "frame": message.frame}
        what |= {"press": press, "step_mm": message.step_mm, "percent": percent}
        self.watch.send("held", received, **what)

    def let_go(self, page: int, message: LetGo) -> int | None:
        """Ends the press of a page's jog control, and returns it for `end_press`, if any."""
        with self._control_lock:
            return self.control.let_go(page, message.hold)

    def leave(self, page: int) -> None:
        """Removes a page, and ends its press."""
        with self._control_lock:
            press = self.control.leave(page)
        self.end_press(press)

    def end_press(self, press: int | None) -> None:
        """Reports to the run that a press is over."""
        if press is not None:
            self.watch.send("let_go", press=press)
