"""Random sequences of console events, in simulated time, during a jog session.

The console and its command socket are real; so is the jog session, with drives simulated in this
process. Pages press and release controls, two at once, take control and lose it, lose their
connection, are reloaded with a clock that jumped, repeat old messages, change modes, and STOP. The
test records separately which controls were pressed and checks every cycle against this record. A
session moves the platform, or one cable at a time, for which a page must be in service mode.
"""

from __future__ import annotations

import json
import os
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cdpr.console import watch
from cdpr.console.commands import Held, LetGo, parse_message
from cdpr.console.session import Console
from cdpr.console.verbs import ConsoleFiles
from executor.hold_to_run.presses import TIMEOUT, PressBoard
from executor.hold_to_run.session import cable_session, jog_session
from executor.state_machine import CycleRecord, State
from executor.winch_runs import limit_of
from model.clearance import ClearanceModel
from model.errors import Fault, StoppedByOperator
from model.pose import Array, Pose
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_scene
from tests.cli.plans import RIG

SCENE = RIG.parent / "environment_1.yaml"
#: Jog speed, [m/s].
SPEED = 0.020
#: Delay allowed between two processes, [cycles].
CYCLES_LATE = 3
#: How long the console waits for the session's answers, [s] of real time.
PATIENCE = 60.0
#: A page with a pressed control sends a message every 5 cycles of 10 ms.
SEND_EVERY = 5
DIRECTIONS = [[*row] for sign in (1.0, -1.0) for row in (sign * np.eye(3)).tolist()]


def arrived_now() -> float:
    """When a command arrived that arrives now, [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@dataclass
class SimulatedPage:
    """One page and what its operator does."""

    number: int
    hold: int
    highest: int = 0  # the highest press number that it sent
    motion: dict[str, object] = field(default_factory=dict)
    step: float | None = None
    speed: float = 20.0
    pressed: bool = False
    silent: int = 0
    is_over: bool = False
    over: list[str] = field(default_factory=list)
    seq: int = 0

    def report(self) -> str:
        """The next message that it sends as long as its control is pressed."""
        self.seq += 1
        return self.message()

    def message(self) -> str:
        """The last of these messages."""
        message = {"kind": "held", "hold": self.hold, "seq": self.seq, "state": 1} | self.motion
        return json.dumps(message | {"step_mm": self.step, "speed_mm_s": self.speed})


@dataclass
class Figures:
    """What happened, and which errors were found."""

    sequences: int = 0
    cycles: int = 0
    sessions: int = 0
    presses: int = 0
    moving_cycles: int = 0
    did: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def report(self) -> str:
        """A few lines of text."""
        did = ", ".join(f"{name} {count}" for name, count in sorted(self.did.items()))
        return (
            f"{self.sequences} sequences in {self.sessions} sessions: {self.presses} presses,"
            f" {self.cycles} cycles, {self.moving_cycles} of them in motion\n{did}\n"
            f"wrong: {len(self.wrong)}" + "".join(f"\n  {text}" for text in self.wrong[:20])
        )


class CycleCheck:
    """Checks every cycle against the controls that were pressed."""

    def __init__(self, figures: Figures, rig: Rig) -> None:
        self._figures = figures
        self._last: CycleRecord | None = None
        self._ahead = 0.0
        self._rig = rig
        self._model = ClearanceModel(self._rig, load_scene(SCENE))
        self._required = load_scene(SCENE).obstacle_clearance
        self.pressed_at = float("-inf")
        """When a control was last pressed, [s]."""
        self.pressed_cables: dict[tuple[int, bool], float] | None = None
        """The same for each cable (from 1) and direction (True: out); None in platform jogs."""
        limits = self._rig.motion
        # Time to stop, [s], from the jog speed while still accelerating at the limit.
        self._ramp = SPEED / limits.acceleration + 2.0 * limits.acceleration / limits.jerk
        cycle = self._rig.document.bus.cycle_ms / 1000.0
        # The anchor of a cable moves with the platform; nothing is wound in faster than it moves.
        self._step = [
            1.5 * SPEED * cycle * winch.counts_per_metre + 2 for winch in self._rig.winches
        ]

    def begin(self) -> None:
        """A new session, with the drives at rest."""
        self._last, self.pressed_at = None, float("-inf")
        if self.pressed_cables is not None:
            self.pressed_cables = {}

    def release(self, now: float) -> None:
        """The control was released: as if no message had come for the timeout."""
        self.pressed_at = min(self.pressed_at, now - TIMEOUT)

    def check(self, record: CycleRecord) -> None:
        """One cycle."""
        self._figures.cycles += 1
        before, self._last = self._last, record
        if before is None:
            return
        ahead = np.subtract(record.targets, before.targets)
        late = CYCLES_LATE * self._rig.document.bus.cycle_ms / 1000.0
        since = record.at - self.pressed_at
        if ahead.any():
            self._figures.moving_cycles += 1
            if since > TIMEOUT + self._ramp + late:
                self._report(record, f"moves though nothing was pressed for {since:.3f} s")
            self._check_cables(record, ahead, late)
            if np.any(np.abs(ahead) > self._step):
                self._report(record, f"a set-point is {np.abs(ahead).max()} counts ahead")
        # With limited jerk the rate still rises for a moment, ever more slowly.
        ahead_before, self._ahead = self._ahead, record.rate - before.rate
        if self._ahead > max(ahead_before, 0.0) + 1e-9 and since > TIMEOUT + late:
            self._report(record, f"speeds up though nothing was pressed for {since:.3f} s")
        if record.state is State.LATCHED:
            self._report(record, "latched")

    def _check_cables(self, record: CycleRecord, ahead: Array, late: float) -> None:
        """Only the selected cable moves, in its direction, and no tension exceeds the limit."""
        if self.pressed_cables is None:
            return
        for cable in np.flatnonzero(ahead):
            pays_out = bool(ahead[cable] * self._rig.winches[cable].counts_per_metre > 0.0)
            since = record.at - self.pressed_cables.get((int(cable) + 1, pays_out), float("-inf"))
            if since > TIMEOUT + self._ramp + late:
                sense = "paid out" if pays_out else "wound in"
                self._report(
                    record, f"cable {cable + 1} is {sense}, last pressed {since:.3f} s ago"
                )
        most = float(np.max(self._rig.tensions_by(record.torques)))
        if most > limit_of(self._rig, None):
            self._report(record, f"a cable carries {most:.1f} N")

    def check_clearance(self, console: Console) -> None:
        """The platform keeps the clearance that the scene requires."""
        jog = (console.watch.last.status or {}).get("jog")
        if jog is not None:
            position = np.array(jog["position_mm"]) / 1000.0
            pose = Pose(position, self._rig.home.rotation)
            near = self._model.smallest(pose)
            if near is not None and near.distance < self._required - 1e-4:
                self._figures.wrong.append(f"only {1e3 * near.distance:.2f} mm at {position}")
        for event in (console.watch.last.status or {}).get("events", []):
            if event["code"] in ("gate_denied", "traceback", "broken"):
                self._figures.wrong.append(f"{event['code']}: {event['text']}")

    def _report(self, record: CycleRecord, text: str) -> None:
        self._figures.wrong.append(
            f"at {record.at:.2f} s of session {self._figures.sessions}: {text}"
        )


class Sequences:
    """Pages at one console, and its jog sessions."""

    def __init__(self, seed: int, *, cables: bool = False) -> None:
        self._random, self._cables = random.Random(seed), cables
        rig = with_soft_cables(load_rig(RIG)) if cables else load_rig(RIG)
        files = ConsoleFiles(RIG, rig, (), (), (), SCENE, True, False)
        self.console = Console(files)
        self._started: list[str] = []
        self.console.verbs.start = self._start  # type: ignore[method-assign]
        self.figures = Figures()
        self._check = CycleCheck(self.figures, rig)
        if cables:
            self._check.pressed_cables = {}
        self._pages: list[SimulatedPage] = []
        self._goal = self._left = self._cycle = 0
        self._now = 0.0

    def run(self, count: int) -> Figures:
        """Run `count` sequences; STOP and mode changes divide them into sessions."""
        self._goal = count
        while self.figures.sequences < count and not self.figures.wrong:
            self.figures.sessions += 1
            self._check.begin()
            try:
                self._session()
            except StoppedByOperator:
                self.figures.did["session stopped"] += 1
            except Fault as error:  # the platform moves with the cable that is paid out
                self.figures.did["session ended by slack"] += 1
                if not (self._cables and "went slack" in error.what):
                    self.figures.wrong.append(error.what)
            for page in self._pages:
                page.pressed = False
        for page in self._pages:
            self.console.leave(page.number)
        self.console.close()
        return self.figures

    def _session(self) -> None:
        rig, on_cycle = self.console.rig, self._on_cycle
        if self._cables:
            cable_session(rig, speed=SPEED, realtime=False, on_cycle=on_cycle)
        else:
            scene = load_scene(SCENE)
            jog_session(rig, scene, speed=SPEED, realtime=False, on_cycle=on_cycle)

    def _start(self, verb: str, _arguments: object, _require: object) -> None:
        self._started.append(verb)

    def _on_cycle(self, record: CycleRecord, board: PressBoard, _: object) -> None:
        self._check.check(record)
        self._cycle, self._now = self._cycle + 1, record.at
        if record.state is not State.MOVING:
            return
        if self._cycle % SEND_EVERY == 0:
            self.console.update()
            self._send_pressed()
        if self._cycle % 50 == 0:
            self._check.check_clearance(self.console)
        self._left -= 1
        if self._left <= 0:
            self._act(board)

    def _send_pressed(self) -> None:
        """Messages of the pages whose control is pressed, unless a page is delayed."""
        for page in self._pages:
            page.silent = max(0, page.silent - SEND_EVERY)
            if page.pressed and not page.silent:
                self._hold(page)

    def _hold(self, page: SimulatedPage) -> None:
        control = self.console.control
        mine = control.holder == page.number
        if not mine or (self._cables and not control.is_service):
            page.is_over = True  # it has to be pressed again
        elif not page.is_over:
            self._check.pressed_at = self._now
            if self._check.pressed_cables is not None:
                cable, sense = page.motion["cable"], page.motion["sense"]
                assert isinstance(cable, int)
                self._check.pressed_cables[cable, sense == "pay_out"] = self._now
        self._send(page, page.report())

    def _send(self, page: SimulatedPage, text: str) -> None:
        message = parse_message(text)
        assert isinstance(message, Held)
        page.highest = max(page.highest, message.hold)
        press = self.console.held(page.number, message)
        if press is not None:
            self.console.forward_held(press, message, watch.time.monotonic())

    def _command(self, page: SimulatedPage, command: str, **values: object) -> str:
        text = json.dumps({"kind": "command", "id": 1, "command": command, **values})
        message = parse_message(text)
        assert not isinstance(message, Held | LetGo)
        if command == "stop":
            return self.console.stop()
        return self.console.command(page.number, message, arrived_now())

    def _act(self, board: PressBoard) -> None:
        """The next event; a sequence has about four of them."""
        if self._random.random() < 0.25:
            self.figures.sequences += 1
            if self.figures.sequences >= self._goal:
                board.end()
        while len(self._pages) < 2:
            self._join()
        act = self._random.choices(ACTS, WEIGHTS)[0]
        self.figures.did[act.__name__.strip("_")] += 1
        act(self, self._random.choice(self._pages))
        self._left = self._random.choice((0, 0, 0, 1, 1, 3, 8, 20))

    def _join(self) -> None:
        base = self._random.choice((1, 1_000, 1_700_000_000_000))  # its clock jumped
        page = SimulatedPage(self.console.control.join("test"), base)
        page.motion = self._motion()
        self._pages.append(page)

    def _motion(self) -> dict[str, object]:
        if not self._cables:
            return {"direction": self._random.choice(DIRECTIONS), "frame": "world"}
        sense = self._random.choice(("wind_in", "pay_out"))
        return {"cable": self._random.randint(1, 8), "sense": sense}

    # The events.

    def _press(self, page: SimulatedPage) -> None:
        if page.pressed:
            return
        self.figures.presses += 1
        page.hold += 1
        page.motion = self._motion()
        page.step = self._random.choice((None, None, None, 0.1, 1.0, 10.0))
        page.speed = self._random.choice((1.0, 5.0, 20.0, 900.0))
        page.pressed, page.silent = True, 0
        page.is_over = False
        self._hold(page)

    def _let_go(self, page: SimulatedPage) -> None:
        if page.pressed:
            page.over.append(page.message())
            self._release(page)
        page.pressed = False
        message = parse_message(json.dumps({"kind": "let_go", "hold": page.hold}))
        assert isinstance(message, LetGo)
        page.highest = max(page.highest, message.hold)
        self.console.end_press(self.console.let_go(page.number, message))

    def _release(self, page: SimulatedPage) -> None:
        if self.console.control.holder == page.number:
            self._check.release(self._now)

    def _take(self, page: SimulatedPage) -> None:
        force, holder = self._random.random() < 0.5, self.console.control.holder_name()
        self._command(page, "take_control", force=force, held_by=holder)
        if self._cables and self._random.random() < 0.8:
            self._change_mode(page, "service_begin")

    def _give(self, page: SimulatedPage) -> None:
        self._release(page)
        self._command(page, "give_control")

    def _cut(self, page: SimulatedPage) -> None:
        """The connection is lost; the page may come back as a new one."""
        self._release(page)
        self.console.leave(page.number)
        self._pages.remove(page)

    def _delay(self, page: SimulatedPage) -> None:
        page.silent = self._random.choice((10, 20, 60))
        if page.silent > 100.0 * TIMEOUT:
            page.pressed = False  # as hold.js does
            page.over.append(page.message())

    def _replay(self, page: SimulatedPage) -> None:
        """Messages of finished presses, of any page."""
        over = [text for other in self._pages for text in other.over[-5:]]
        for text in self._random.sample(over, min(3, len(over))):
            message = json.loads(text)
            # Higher numbers would be a new press or report, so they are limited to finished ones.
            message["hold"] = min(message["hold"], page.highest - page.pressed)
            message["seq"] = min(message["seq"], page.seq)
            if message["hold"] > 0 and message["seq"] > 0:
                self._send(page, json.dumps(message))

    def _mode(self, page: SimulatedPage) -> None:
        """Other commands of a page; none may start during the session."""
        verbs = ("home", "reset", "release", "run", "jog_begin", "cable_begin", "resume")
        command = self._random.choice(verbs)
        shown = {"run": {"plan": "none"}, "reset": {"cause": None}}
        self._command(page, command, **shown.get(command, {}))
        if self._started:
            self.figures.wrong.append(f"{self._started.pop()} was started during a session")

    def _service(self, page: SimulatedPage) -> None:
        """Enter or leave service mode: this ends a press, and leaving also ends the session."""
        enters = not self._cables or self._random.random() < 0.95
        self._change_mode(page, "service_begin" if enters else "service_end")

    def _change_mode(self, page: SimulatedPage, command: str) -> None:
        if not self._command(page, command):
            self._release(page)
            page.is_over |= page.pressed

    def _feed(self, page: SimulatedPage) -> None:
        self._command(page, "speed", percent=self._random.choice((1, 50, 100)))
        self._command(page, self._random.choice(("hold", "resume")))

    def _stop(self, page: SimulatedPage) -> None:
        self._command(page, "stop")

    def _end(self, page: SimulatedPage) -> None:
        self._command(page, "jog_end")


Act = Callable[[Sequences, SimulatedPage], None]
_WEIGHTED: list[tuple[Act, float]] = [
    (Sequences._press, 8.0),
    (Sequences._let_go, 3.0),
    (Sequences._take, 2.0),
    (Sequences._give, 0.7),
    (Sequences._cut, 0.7),
    (Sequences._delay, 1.5),
    (Sequences._replay, 2.0),
    (Sequences._mode, 1.0),
    (Sequences._service, 1.0),
    (Sequences._feed, 0.5),
    (Sequences._stop, 0.01),
    (Sequences._end, 0.01),
]
ACTS = [act for act, _ in _WEIGHTED]
WEIGHTS = [weight for _, weight in _WEIGHTED]


def open_files() -> set[str]:
    """File descriptors of this process, except those of the cache of machine code."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # the one that listed the folder
            found.add(f"{name} {os.readlink(f'/proc/self/fd/{name}')}")
    return {file for file in found if "/kernels/" not in file}


def children() -> set[str]:
    """Child processes that still run."""
    tasks = Path("/proc/self/task")
    found = ""
    for task in tasks.iterdir():
        with suppress(OSError):  # a thread that ended meanwhile
            found += (task / "children").read_text()
    return {f"process {number}" for number in found.split()}


def resources() -> set[str]:
    """Threads, open files and child processes; those of an earlier test may end meanwhile."""
    threads = {f"thread {thread.ident} {thread.name}" for thread in threading.enumerate()}
    return threads | open_files() | children()


def with_soft_cables(rig: Rig) -> Rig:
    """The rig with cables so soft that moving one alone does not overload the others."""
    cables = rig.document.cables
    soft = cables.model_copy(update={"stiffness_n": 0.002 * cables.stiffness_n})
    return rig_from_document(rig.document.model_copy(update={"cables": soft}))


def sequences(count: int, seed: int, *, cables: bool = False) -> Figures:
    """Run `count` sequences; remaining threads, sockets and processes count as errors."""
    before, interval = resources(), sys.getswitchinterval()
    patience = watch.PATIENCE, watch.ANSWERED_WITHIN
    sys.setswitchinterval(1e-4)  # the session and its socket's thread take turns all the time
    # Time stops while the session is queried, so that a busy computer delays no message.
    watch.PATIENCE = watch.ANSWERED_WITHIN = PATIENCE
    try:
        figures = Sequences(seed, cables=cables).run(count)
    finally:
        sys.setswitchinterval(interval)
        watch.PATIENCE, watch.ANSWERED_WITHIN = patience
    if left := resources() - before:
        figures.wrong.append(f"left behind: {sorted(left)}")
    return figures
