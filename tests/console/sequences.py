"""Random sequences of what happens at consoles, in simulated time, against a session that moves.

The console is the real one, with its command socket; so is the session of jogs, with drives that
are simulated in this process. Pages hold and let go, two at once, take control and lose it, are cut
off, reloaded with a clock that jumped, send again what is over, change what they do, and STOP. What
the pages truly held is kept apart; every cycle is judged by it. A session moves the platform, or
one cable at a time, which only pages in service mode may.
"""

from __future__ import annotations

import json
import os
import random
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cdpr.console import watch
from cdpr.console.commands import Held, LetGo, parse_message
from cdpr.console.session import Console, ConsoleFiles
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
#: Of a jog, [m/s].
SPEED = 0.020
#: What two processes may be apart, [cycles].
CYCLES_LATE = 3
#: The console waits so long for the session's answers, [s] of real time.
PATIENCE = 60.0
#: A page says that it holds every so many cycles of 10 ms.
SAID_EVERY = 5
DIRECTIONS = [[*row] for sign in (1.0, -1.0) for row in (sign * np.eye(3)).tolist()]


@dataclass
class PageAtHand:
    """One page as the operator at it sees it."""

    number: int
    hold: int
    said: int = 0  # the highest number that it named
    motion: dict[str, object] = field(default_factory=dict)
    step: float | None = None
    speed: float = 20.0
    pressed: bool = False
    silent: int = 0
    is_over: bool = False
    over: list[str] = field(default_factory=list)

    def word(self, hold: int | None = None) -> str:
        """What it says as long as it holds."""
        said = {"kind": "held", "hold": self.hold if hold is None else hold, "seq": 1}
        return json.dumps(said | self.motion | {"step_mm": self.step, "speed_mm_s": self.speed})


@dataclass
class Figures:
    """What was done, and what was wrong."""

    sequences: int = 0
    cycles: int = 0
    sessions: int = 0
    presses: int = 0
    moving_cycles: int = 0
    did: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def report(self) -> str:
        """In a few lines."""
        did = ", ".join(f"{name} {count}" for name, count in sorted(self.did.items()))
        return (
            f"{self.sequences} sequences in {self.sessions} sessions: {self.presses} presses,"
            f" {self.cycles} cycles, {self.moving_cycles} of them in motion\n{did}\n"
            f"wrong: {len(self.wrong)}" + "".join(f"\n  {text}" for text in self.wrong[:20])
        )


class Judge:
    """Holds every cycle against what was truly held."""

    def __init__(self, figures: Figures, rig: Rig) -> None:
        self._figures = figures
        self._last: CycleRecord | None = None
        self._ahead = 0.0
        self._rig = rig
        self._model = ClearanceModel(self._rig, load_scene(SCENE))
        self._required = load_scene(SCENE).obstacle_clearance
        self.heard = float("-inf")
        """When a press was truly held last, [s]."""
        self.heard_of: dict[tuple[int, bool], float] | None = None
        """The same of each cable, from 1, and whether it was paid out; None of the platform."""
        limits = self._rig.motion
        # To rest, [s], from the jog speed and still speeding up at the limit of acceleration.
        self._ramp = SPEED / limits.acceleration + 2.0 * limits.acceleration / limits.jerk
        cycle = self._rig.document.bus.cycle_ms / 1000.0
        # The anchor of a cable moves with the platform; nothing is wound in faster than it moves.
        self._step = [
            1.5 * SPEED * cycle * winch.counts_per_metre + 2 for winch in self._rig.winches
        ]

    def begin(self) -> None:
        """A new session, with the drives at rest."""
        self._last, self.heard = None, float("-inf")
        if self.heard_of is not None:
            self.heard_of = {}

    def release(self, now: float) -> None:
        """What was held is not any more: as if it had been silent for long enough."""
        self.heard = min(self.heard, now - TIMEOUT)

    def judge(self, record: CycleRecord) -> None:
        """One cycle."""
        self._figures.cycles += 1
        before, self._last = self._last, record
        if before is None:
            return
        ahead = np.subtract(record.targets, before.targets)
        late = CYCLES_LATE * self._rig.document.bus.cycle_ms / 1000.0
        since = record.at - self.heard
        if ahead.any():
            self._figures.moving_cycles += 1
            if since > TIMEOUT + self._ramp + late:
                self._say(record, f"moves though nothing was held for {since:.3f} s")
            self._judge_cables(record, ahead, late)
            if np.any(np.abs(ahead) > self._step):
                self._say(record, f"a set-point is {np.abs(ahead).max()} counts ahead")
        # With limited jerk it still speeds up for a moment, and less and less.
        ahead_before, self._ahead = self._ahead, record.rate - before.rate
        if self._ahead > max(ahead_before, 0.0) + 1e-9 and since > TIMEOUT + late:
            self._say(record, f"speeds up though nothing was held for {since:.3f} s")
        if record.state is State.LATCHED:
            self._say(record, "latched")

    def _judge_cables(self, record: CycleRecord, ahead: Array, late: float) -> None:
        """Only the cable moves that was held, in its sense, and no tension is beyond the limit."""
        if self.heard_of is None:
            return
        for cable in np.flatnonzero(ahead):
            pays_out = bool(ahead[cable] * self._rig.winches[cable].counts_per_metre > 0.0)
            since = record.at - self.heard_of.get((int(cable) + 1, pays_out), float("-inf"))
            if since > TIMEOUT + self._ramp + late:
                sense = "paid out" if pays_out else "wound in"
                self._say(record, f"cable {cable + 1} is {sense}, held {since:.3f} s ago")
        most = float(np.max(self._rig.tensions_by(record.torques)))
        if most > limit_of(self._rig, None):
            self._say(record, f"a cable carries {most:.1f} N")

    def look_around(self, console: Console) -> None:
        """Where the platform is keeps what the scene asks for."""
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

    def _say(self, record: CycleRecord, text: str) -> None:
        self._figures.wrong.append(
            f"at {record.at:.2f} s of session {self._figures.sessions}: {text}"
        )


class Sequences:
    """Pages at one console, and the sessions that it jogs."""

    def __init__(self, seed: int, *, cables: bool = False) -> None:
        self._random, self._cables = random.Random(seed), cables
        rig = with_soft_cables(load_rig(RIG)) if cables else load_rig(RIG)
        files = ConsoleFiles(RIG, rig, (), (), (), SCENE, True, False)
        self.console = Console(files)
        self._started: list[str] = []
        self.console.verbs.start = self._start  # type: ignore[method-assign]
        self.figures = Figures()
        self._judge = Judge(self.figures, rig)
        if cables:
            self._judge.heard_of = {}
        self._pages: list[PageAtHand] = []
        self._goal = self._left = self._cycle = 0
        self._now = 0.0

    def run(self, count: int) -> Figures:
        """So many sequences, in as many sessions as STOP and mode changes make of them."""
        self._goal = count
        while self.figures.sequences < count and not self.figures.wrong:
            self.figures.sessions += 1
            self._judge.begin()
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

    def _start(self, verb: str, _arguments: object) -> None:
        self._started.append(verb)

    def _on_cycle(self, record: CycleRecord, board: PressBoard, _: object) -> None:
        self._judge.judge(record)
        self._cycle, self._now = self._cycle + 1, record.at
        if record.state is not State.MOVING:
            return
        if self._cycle % SAID_EVERY == 0:
            self.console.update()
            self._words()
        if self._cycle % 50 == 0:
            self._judge.look_around(self.console)
        self._left -= 1
        if self._left <= 0:
            self._act(board)

    def _words(self) -> None:
        """What pages say that hold a control, unless they are held up."""
        for page in self._pages:
            page.silent = max(0, page.silent - SAID_EVERY)
            if page.pressed and not page.silent:
                self._hold(page)

    def _hold(self, page: PageAtHand) -> None:
        control = self.console.control
        mine = control.holder == page.number
        if not mine or (self._cables and not control.is_service):
            page.is_over = True  # it has to be pressed again
        elif not page.is_over:
            self._judge.heard = self._now
            if self._judge.heard_of is not None:
                cable, sense = page.motion["cable"], page.motion["sense"]
                assert isinstance(cable, int)
                self._judge.heard_of[cable, sense == "pay_out"] = self._now
        self._held(page, page.word())

    def _held(self, page: PageAtHand, text: str) -> None:
        message = parse_message(text)
        assert isinstance(message, Held)
        page.said = max(page.said, message.hold)
        self.console.held(page.number, message)

    def _command(self, page: PageAtHand, command: str, **values: object) -> str:
        text = json.dumps({"kind": "command", "id": 1, "command": command, **values})
        message = parse_message(text)
        assert not isinstance(message, Held | LetGo)
        return self.console.command(page.number, message)

    def _act(self, board: PressBoard) -> None:
        """The next thing that happens; a sequence is about a handful of them."""
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
        page = PageAtHand(self.console.control.join("test"), base)
        page.motion = self._motion()
        self._pages.append(page)

    def _motion(self) -> dict[str, object]:
        if not self._cables:
            return {"direction": self._random.choice(DIRECTIONS), "frame": "world"}
        sense = self._random.choice(("wind_in", "pay_out"))
        return {"cable": self._random.randint(1, 8), "sense": sense}

    # What happens.

    def _press(self, page: PageAtHand) -> None:
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

    def _let_go(self, page: PageAtHand) -> None:
        if page.pressed:
            page.over.append(page.word())
            self._release(page)
        page.pressed = False
        message = parse_message(json.dumps({"kind": "let_go", "hold": page.hold}))
        assert isinstance(message, LetGo)
        page.said = max(page.said, message.hold)
        self.console.let_go(page.number, message)

    def _release(self, page: PageAtHand) -> None:
        if self.console.control.holder == page.number:
            self._judge.release(self._now)

    def _take(self, page: PageAtHand) -> None:
        self._command(page, "take_control", force=self._random.random() < 0.5)
        if self._cables and self._random.random() < 0.8:
            self._change_mode(page, "service_begin")

    def _give(self, page: PageAtHand) -> None:
        self._release(page)
        self._command(page, "give_control")

    def _cut(self, page: PageAtHand) -> None:
        """The socket is lost, and the page may come back as another one."""
        self._release(page)
        self.console.leave(page.number)
        self._pages.remove(page)

    def _held_up(self, page: PageAtHand) -> None:
        page.silent = self._random.choice((10, 20, 60))
        if page.silent > 100.0 * TIMEOUT:
            page.pressed = False  # as hold.js does
            page.over.append(page.word())

    def _replay(self, page: PageAtHand) -> None:
        """Words of presses that are over, from any page's memory."""
        over = [text for other in self._pages for text in other.over[-5:]]
        for text in self._random.sample(over, min(3, len(over))):
            message = json.loads(text)
            # A higher number would be a new press: of this page such words are over by now.
            message["hold"] = min(message["hold"], page.said - page.pressed)
            if message["hold"] > 0:
                self._held(page, json.dumps(message))

    def _mode(self, page: PageAtHand) -> None:
        """What else a page may want; nothing of it is done while the session is there."""
        verbs = ("home", "reset", "release", "run", "jog_begin", "cable_begin", "resume")
        command = self._random.choice(verbs)
        self._command(page, command)
        if self._started:
            self.figures.wrong.append(f"{self._started.pop()} was started during a session")

    def _service(self, page: PageAtHand) -> None:
        """In and out of service mode, which ends what the page holds, and out of it the session."""
        enters = not self._cables or self._random.random() < 0.95
        self._change_mode(page, "service_begin" if enters else "service_end")

    def _change_mode(self, page: PageAtHand, command: str) -> None:
        if not self._command(page, command):
            self._release(page)
            page.is_over |= page.pressed

    def _feed(self, page: PageAtHand) -> None:
        self._command(page, "speed", percent=self._random.choice((1, 50, 100)))
        self._command(page, self._random.choice(("hold", "resume")))

    def _stop(self, page: PageAtHand) -> None:
        self._command(page, "stop")

    def _end(self, page: PageAtHand) -> None:
        self._command(page, "jog_end")


Act = Callable[[Sequences, PageAtHand], None]
_WEIGHTED: list[tuple[Act, float]] = [
    (Sequences._press, 8.0),
    (Sequences._let_go, 3.0),
    (Sequences._take, 2.0),
    (Sequences._give, 0.7),
    (Sequences._cut, 0.7),
    (Sequences._held_up, 1.5),
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
    """Descriptors of this process, without the one that keeps the cache of machine code."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # the one by which the folder was read
            found.add(f"{name} {os.readlink(f'/proc/self/fd/{name}')}")
    return {file for file in found if "/kernels/" not in file}


def children() -> set[str]:
    """Processes that this one started and that are there still."""
    tasks = Path("/proc/self/task")
    found = ""
    for task in tasks.iterdir():
        with suppress(OSError):  # a thread that ended meanwhile
            found += (task / "children").read_text()
    return {f"process {number}" for number in found.split()}


def held() -> set[str]:
    """What this process would leave behind; what an earlier test left may end meanwhile."""
    threads = {f"thread {thread.ident} {thread.name}" for thread in threading.enumerate()}
    return threads | open_files() | children()


def with_soft_cables(rig: Rig) -> Rig:
    """On which one cable moves by more than steel stretches."""
    cables = rig.document.cables
    soft = cables.model_copy(update={"stiffness_n": 0.002 * cables.stiffness_n})
    return rig_from_document(rig.document.model_copy(update={"cables": soft}))


def sequences(count: int, seed: int, *, cables: bool = False) -> Figures:
    """So many sequences; threads, sockets and processes that are left count as wrong."""
    before, interval = held(), sys.getswitchinterval()
    patience = watch.PATIENCE, watch.ANSWERED_WITHIN
    sys.setswitchinterval(1e-4)  # the session and its socket's thread take turns all the time
    # Time stops while the session is queried, so that a busy computer delays no message.
    watch.PATIENCE = watch.ANSWERED_WITHIN = PATIENCE
    try:
        figures = Sequences(seed, cables=cables).run(count)
    finally:
        sys.setswitchinterval(interval)
        watch.PATIENCE, watch.ANSWERED_WITHIN = patience
    if left := held() - before:
        figures.wrong.append(f"left behind: {sorted(left)}")
    return figures
