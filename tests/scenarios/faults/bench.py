"""A run on simulated drives behind a bus with faults, in simulated time or in real time.

In simulated time executor and drives share a thread (python-can's `virtual`). In real time the
executor is a process of its own, which can be killed and suspended (`udp_multicast`, `socketcan`).
"""

from __future__ import annotations

import gc
import itertools
import json
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import can

from drivers.can_bus import BusSettings, open_bus
from drivers.factory import make_drive_group
from executor.recording.recorder import Recorder
from executor.recording.run_folder import RunEvent, RunFolder
from executor.remote.status import RunStatus
from executor.state_machine import State
from executor.supervision import LocalRequests
from executor.trajectory.setpoints import PreparedRun
from model.files.rig_file import Cia402Document
from model.rig import Rig, rig_from_document
from simulation.drives.behaviour import STRICT, DriveBehaviour
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.eds_file import profile_path
from tests.scenarios.faults.fault_bus import FaultBus, lose
from tests.scenarios.faults.masters import StartsMasters, gone
from tests.scenarios.faults.samples import Limits, Stopped, WatchedRehearsal, stopped, violations
from tests.scenarios.stage import CRUISING, Stage

_CHANNELS = itertools.count()
FINE = 0.001
ARMED_AFTER = 15
"""SYNCs before the first set-point that moves."""
EVERY_ID = range(0x800)
ENDS_WITHIN_S = 240.0  # answers that come late make the set-up last minutes

Script = Callable[["Bench"], object]


class Killed(BaseException):
    """The executor was killed."""


class Bench(ABC):
    """One run.

    Attributes:
        prepared: The run.
        rehearsal: Drives and platform.
        line: The drives' end of the bus.
        folder: The run folder.
        since: When the fault happened, on the drives' clock; None before.
        fault_cycle: SYNCs from the beginning until the fault.
        lost: Drives that were broken on purpose, from 0.
        blur: Accuracy of times, [s].
        real_time: The executor's cycles may begin late without a fault.
        missed_start: See `samples.violations`.
    """

    blur = 1e-6
    real_time = False
    prepared: PreparedRun
    rehearsal: WatchedRehearsal
    line: FaultBus
    folder: RunFolder

    def __init__(self) -> None:
        self.since: float | None = None
        self.fault_cycle = CRUISING
        self.lost: frozenset[int] = frozenset()
        self.missed_start = False

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return self.rehearsal.drives

    @property
    def cycle(self) -> int:
        """SYNCs so far."""
        return self.rehearsal.cycles

    def happens(self) -> None:
        """Marks the beginning of the fault."""
        if self.since is None:
            self.since = self.rehearsal.now

    def breaks(self, *drives: int) -> None:
        """These drives fail, from 0; the others have to stop."""
        self.happens()
        self.lost |= set(drives)

    def stop(self) -> Stopped:
        """How the drives stopped since the fault."""
        assert self.since is not None, "the fault never happened"
        return stopped(self.rehearsal, self.prepared.rig, self.since, self.lost)

    def violations(self, mixed_cycles: float = 4.0, rows: float = 1.0) -> list[str]:
        """See `samples.violations`."""
        limits = Limits.of(self.prepared, mixed_cycles, rows)
        return violations(self.rehearsal, limits, lost=self.lost, missed_start=self.missed_start)

    def events(self) -> list[RunEvent]:
        return self.folder.events()

    def codes(self) -> list[str]:
        return [event.code for event in self.events()]

    @abstractmethod
    def kill(self) -> None:
        """`kill -9` of the executor."""

    @abstractmethod
    def ask_stop(self) -> None:
        """Requests a stop as the operator."""

    @abstractmethod
    def run(self) -> State | None:
        """Arms and moves to the end; None when the executor was killed."""


class SimulatedBench(Bench):
    """Executor and drives in one thread; time passes with SYNC.

    Attributes:
        line_time: Of the bus, [s].
    """

    def __init__(self, stage: Stage, line: FaultBus) -> None:
        super().__init__()
        self.line_time = 0.0
        self.stage, self.line = stage, line
        self.prepared, self.folder = stage.prepared, stage.folder
        assert isinstance(stage.rehearsal, WatchedRehearsal)
        self.rehearsal = stage.rehearsal
        self.cause = ""
        self.killed = False

    def kill(self) -> None:
        self.happens()
        self.line.incoming.append(lose(EVERY_ID))
        self.killed = True
        raise Killed

    def ask_stop(self) -> None:
        self.stage.board.ask_stop()

    def late(self, cycles: float) -> None:
        """Delays the next cycle; the drives' time advances."""
        self.pass_time(cycles * self.prepared.checked.table.cycle)
        self.stage.lateness = cycles

    def pass_time(self, seconds: float) -> None:
        """The executor sends nothing meanwhile; frames that wait for the bus reach the drives."""
        for _ in range(round(seconds / FINE)):
            self.rehearsal.advance(FINE)
            self.line_time += FINE
            while (message := self.line.recv(0.0)) is not None:
                self.rehearsal._handle(message)

    def run(self) -> State | None:
        try:
            outcome = self.stage.run()
        except Killed:
            self.pass_time(0.3)
            return None
        self.cause = outcome.cause
        self.pass_time(0.3)
        self.rehearsal.pump()
        return outcome.state


def with_profile(prepared: PreparedRun, profile: Mapping[str, object], path: Path) -> PreparedRun:
    """The same run of drives whose profile has other keys than ``cia402``; written to a file."""
    if not profile:
        return prepared
    path.write_text(json.dumps({"name": "of a test", "sources": ["a test"], **profile}))
    drives = Cia402Document(type="cia402", profile=str(path))
    rig = rig_from_document(prepared.rig.document.model_copy(update={"drives": drives}))
    return replace(prepared, rig=rig)


@contextmanager
def simulated(
    prepared: PreparedRun,
    path: Path,
    script: Script,
    *,
    bitrate: float | None = None,
    behaviour: DriveBehaviour = STRICT,
    eds: Path | None = None,
    profile: Mapping[str, object] = MappingProxyType({}),
) -> Iterator[SimulatedBench]:
    """A bench in simulated time; the script is asked at every cycle, from 0 after arming."""
    prepared = with_profile(prepared, profile, path.with_suffix(".yaml"))
    eds = eds or (profile_path("cia402") if profile else None)
    settings = BusSettings("virtual", f"fault-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        bench: SimulatedBench | None = None
        cycle = prepared.checked.table.cycle
        with FaultBus(far, lambda: bench.line_time if bench else 0.0, ahead=0.95 * cycle) as line:
            scene = prepared.scene
            rehearsal = WatchedRehearsal(
                prepared.rig, line, scene.start, scene.load, behaviour=behaviour, eds=eds
            )
            group = make_drive_group(prepared.rig, near, rehearsal.pump)
            group.configure()
            line.bitrate = bitrate

            def per_cycle(_stage: Stage) -> None:
                assert bench is not None
                bench.line_time += cycle
                script(bench)

            stage = Stage(prepared, rehearsal, group, RunFolder.create(path), per_cycle)
            bench = SimulatedBench(stage, line)
            yield bench
            group.close()


class LiveBench(Bench):
    """The executor in its own process, the drives in a thread of this one; real time."""

    real_time = True
    blur = 0.005  # the fault happens anywhere between two checks of a drive's time-outs

    def __init__(
        self,
        prepared: PreparedRun,
        folder: RunFolder,
        settings: BusSettings,
        masters: StartsMasters,
        line: FaultBus,
        rehearsal: WatchedRehearsal,
    ) -> None:
        super().__init__()
        self.prepared, self.folder, self.line, self.rehearsal = prepared, folder, line, rehearsal
        middle = ARMED_AFTER + len(prepared.checked.table.setpoints) // 2
        self.fault_cycle = min(CRUISING, middle)
        self._settings, self._masters = settings, masters
        self.process = 0
        self.resumes_after: float | None = None
        self.outcome: dict[str, Any] = {}

    def kill(self) -> None:
        self.happens()
        os.kill(self.process, signal.SIGKILL)

    def suspend(self) -> None:
        """The executor hangs."""
        self.happens()
        os.kill(self.process, signal.SIGSTOP)

    def ask_stop(self) -> None:
        os.kill(self.process, signal.SIGTERM)

    def run(self) -> State | None:
        over = threading.Event()
        drives = threading.Thread(target=self.rehearsal.serve_until, args=(over,))
        with _ahead_of_others():  # both threads: one waits for the other's lock
            drives.start()
            try:
                self.process = self._masters.start(self._settings, self.folder.path)
                self._wait()
            finally:
                if self.process and not gone(self.process):
                    os.kill(self.process, signal.SIGKILL)
                over.set()
                drives.join()
        outcome_file = self.folder.path / "outcome.json"
        if not outcome_file.is_file():
            return None
        self.outcome = json.loads(outcome_file.read_text())
        return State(self.outcome["state"])

    def _wait(self) -> None:
        for _ in range(round(ENDS_WITHIN_S / 0.02)):
            if gone(self.process):
                break
            signal.sigtimedwait([], 0.02)
            self._resume_when_due()
        cycle = self.prepared.checked.table.cycle
        signal.sigtimedwait([], max(0.3, 10.0 * cycle))  # the drives have their own time-outs

    def _resume_when_due(self) -> None:
        if self.resumes_after is None or self.since is None:
            return
        if self.rehearsal.now - self.since > self.resumes_after:
            self.resumes_after = None
            os.kill(self.process, signal.SIGCONT)


@contextmanager
def _ahead_of_others() -> Iterator[None]:
    """A real drive answers whatever else this computer does, and collects no garbage."""
    gc.collect()
    gc.freeze()
    gc.disable()
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameter)
        gc.enable()
        gc.unfreeze()


@contextmanager
def live(
    prepared: PreparedRun,
    path: Path,
    script: Script,
    settings: BusSettings,
    masters: StartsMasters,
    *,
    behaviour: DriveBehaviour = STRICT,
    eds: Path | None = None,
) -> Iterator[LiveBench]:
    """A bench in real time; the script is asked at every SYNC."""
    document = prepared.rig.document.bus.model_copy(
        update={"interface": settings.interface, "channel": settings.channel}
    )
    rig: Rig = rig_from_document(prepared.rig.document.model_copy(update={"bus": document}))
    with open_bus(settings) as bus, FaultBus(bus) as line:
        scene = prepared.scene
        rehearsal = WatchedRehearsal(
            rig, line, scene.start, scene.load, behaviour=behaviour, eds=eds
        )
        folder = RunFolder.create(path)
        bench = LiveBench(prepared, folder, settings, masters, line, rehearsal)
        rehearsal.on_cycle = lambda: _asked(script, bench)
        yield bench


def _asked(script: Script, bench: LiveBench) -> None:
    with suppress(Killed):
        script(bench)


def once(happens: Callable[[Any], object]) -> Script:
    """A script with one thing in it, at the cycle of the fault."""
    done = False

    def script(bench: Bench) -> None:
        nonlocal done
        if not done and bench.cycle >= bench.fault_cycle:
            done = True
            happens(bench)

    return script


def recorder_for(prepared: PreparedRun, folder: RunFolder, board: LocalRequests) -> Recorder:
    """Writes events as they happen, and keeps the cycles."""
    return Recorder(
        prepared,
        folder,
        RunStatus(prepared, folder.path, board, simulated_time=False),
        trigger=None,
        every=10,
        progress=lambda _row: None,
        announce=lambda _text: None,
    )


def a_message(can_id: int, data: bytes = b"", *, error: bool = False) -> can.Message:
    """A frame of another node."""
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False, is_error_frame=error)
