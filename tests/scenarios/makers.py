"""A rig with eight drives of one maker, from `cdpr doctor --drives` to `cdpr release`.

Every step is the real command line; the drives are simulated from the EDS file of their profile.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from drivers.can_bus import BusSettings
from drivers.cia402.state_machine import DriveState
from executor.trajectory.setpoints import PreparedRun
from model.plan import save_plan
from model.rig import load_rig
from model.scene import Scene
from simulation.ground_truth import PowerLoss
from tests.cli.plans import GOAL_MM, RIG, START_MM, free_scene, straight_plan
from tests.cli.program import Answer, call
from tests.scenarios.faults.samples import WatchedRehearsal, emergencies
from tests.scenarios.test_processes import program, waited_for
from tests.scenarios.test_real_time import send

MAKERS = ("epos4", "nanotec-c5e", "akd")
STEPS = ["doctor", "home", "run", "stop", "fault", "reset", "home again", "release"]
HOLDING = DriveState.QUICK_STOP_ACTIVE
OVERCURRENT = 0x2310
_BUS = "  interface: virtual\n  channel: cdpr\n"
_YES = ("--yes", "--without-real-time")


def rig_of(profile: str, settings: BusSettings, folder: Path) -> Path:
    """The paper's rig on a bus, with drives of a profile without absolute encoders."""
    text = RIG.read_text().replace("encoder: absolute, ", "")
    bus = f"  interface: {settings.interface}\n  channel: '{settings.channel}'\n"
    assert text.count(_BUS) == 1
    text = text.replace(_BUS, bus)
    file = folder / f"{profile}.yaml"
    file.write_text(f"{text}\ndrives: {{type: cia402, profile: {profile}}}\n")
    return file


def plan_back(folder: Path) -> Path:
    """The short plan in reverse."""
    scene: Scene = free_scene(GOAL_MM, START_MM)
    path = folder / "back.json"
    save_plan(straight_plan(load_rig(RIG), scene, [GOAL_MM, START_MM]), path)
    return path


@dataclass
class Day:
    """One day with a rig: each step leaves drives and bus in the right state.

    Attributes:
        rig: Its file.
        rehearsal: Its drives.
        folder: For what the steps write.
    """

    rig: Path
    rehearsal: WatchedRehearsal
    folder: Path
    steps: list[str] = field(default_factory=list)

    def does(self, code: int, *arguments: str | Path) -> Answer:
        """A command with its exit code; no drive reports anything because of it."""
        answer = call(*arguments)
        assert answer.code == code, (arguments, answer)
        self.is_quiet(str(arguments[0]))
        return answer

    def is_quiet(self, step: str) -> None:
        self.steps.append(step)
        assert emergencies(self.rehearsal) == [], self.steps

    def states(self) -> set[DriveState]:
        return {drive.state for drive in self.rehearsal.drives}

    def doctor(self) -> None:
        """Nothing is missing; a virtual machine may have one processor only."""
        answer = call("doctor", self.rig, "--drives")
        missing = [line for line in answer.out.splitlines() if line.startswith("miss")]
        assert all("processors" in line for line in missing), answer
        assert answer.code == (4 if missing else 0), answer
        self.is_quiet("doctor")

    def home(self) -> None:
        pose = [f"{x:.6f}" for x in self.rehearsal.pose.position * 1000.0]
        self.does(0, "home", self.rig, "--pose-mm", *pose, "--speed-mm-s", "10", *_YES)
        assert self.states() == {HOLDING}

    def run(self, plan: Path, name: str, *, stops: bool) -> None:
        """A run with a feed hold, then resumed to the end, or stopped."""
        run = self.folder / name
        words = ("run", plan, "--rig", self.rig, "-o", run, "--no-camera", *_YES)
        with program(*words) as process:
            events = run / "events.jsonl"
            for code, word in (("moving", "hold"), ("hold", "resume"), ("resume", "")):
                waited_for(events, code, process)
                if word:
                    send(word)
            if stops:
                process.send_signal(signal.SIGINT)
            out, err = process.communicate()
        assert process.returncode == (130 if stops else 0), (out, err)
        assert self.states() == {HOLDING}
        self.is_quiet(name)


def a_day(day: Day, prepared: PreparedRun, plan: Path, back: Path) -> Iterator[str]:
    """Doctor, home, run, hold, resume, stop, fault, reset, home, release; step by step."""
    rehearsal = day.rehearsal
    loss = PowerLoss.drawn(prepared.rig, 4, 0.0005, on_a_stand=True)
    loss.apply_to(prepared.rig, rehearsal.plant, [drive.motor for drive in rehearsal.drives])
    day.doctor()
    yield "doctor"
    start = [f"{x:.6f}" for x in prepared.scene.start.position * 1000.0]
    day.does(0, "home", day.rig, "--pose-mm", *start, "--speed-mm-s", "10", *_YES)
    assert day.states() == {HOLDING}
    yield "home"
    day.run(plan, "there", stops=False)
    assert rehearsal.pose.distance_to(prepared.scene.goal) < 0.5e-3
    yield "run"
    day.run(back, "stopped", stops=True)
    yield "stop"
    failing = rehearsal.drives[2]
    rehearsal.on_cycle = lambda: _fails_when_moving(rehearsal)
    jog = ("jog", day.rig, "--by-mm", "0", "0", "8", "--no-scene", *_YES)
    jogged = call(*jog)
    assert jogged.code == 1, jogged
    assert failing.state is DriveState.FAULT, jogged
    assert "drive 3" in jogged.said, jogged
    assert [d.state for d in rehearsal.drives if d is not failing] == [HOLDING] * 7
    yield "fault"
    rehearsal.on_cycle = lambda: None
    refused = call("reset", day.rig, "--yes")
    assert refused.code != 0
    assert "cannot be reset while other drives hold" in refused.said
    for drive in rehearsal.drives:  # the operator supports the platform and cuts the power
        if drive is not failing:
            drive._power_off(DriveState.SWITCH_ON_DISABLED)
    rehearsal.emergencies.clear()
    reset = day.does(0, "reset", day.rig, "--yes", "--json")
    assert json.loads(reset.out)["reference"]["counts"] is False
    assert DriveState.FAULT not in day.states()
    yield "reset"
    day.home()
    yield "home again"
    day.does(0, "release", day.rig, *_YES)
    assert day.states() == {DriveState.READY_TO_SWITCH_ON}
    yield "release"


def _fails_when_moving(rehearsal: WatchedRehearsal) -> None:
    """The third drive, once all follow and it rotates."""
    drive = rehearsal.drives[2]
    if drive.state is DriveState.OPERATION_ENABLED and drive.motor.speed != 0.0:
        drive.fail(OVERCURRENT)
