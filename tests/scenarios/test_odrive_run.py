"""The whole program on simulated ODrives: a run, its faults, and rigs that are not armed."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drivers.can_bus import BusSettings, open_bus
from drivers.factory import make_drive_group
from drivers.odrive.messages import AxisError, AxisState
from executor.recording.run_folder import RunFolder
from executor.recording.verdict import tensions
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import Refused
from model.plan import load_plan, save_plan
from model.rig import load_rig, rig_from_document
from planner.check import verify
from simulation.drives.odrive import SimulatedOdriveRig
from tests.cli.plans import CONFIGS, GOAL_MM, START_MM, free_scene, straight_plan
from tests.cli.program import call, nothing_written
from tests.scenarios.stage import CRUISING, Stage, at, concluded

ODRIVE = CONFIGS / "gachon_8_6_odrive.yaml"
HELD_CYCLES = 10
"""Under torque before the brakes close."""


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A straight path of 58 mm."""
    path = tmp_path_factory.mktemp("odrive") / "plan.json"
    scene = free_scene(START_MM, GOAL_MM)
    save_plan(straight_plan(load_rig(ODRIVE), scene, [START_MM, GOAL_MM]), path)
    return path


@pytest.fixture(scope="module")
def prepared(plan: Path) -> PreparedRun:
    return prepare(verify(load_plan(plan)), load_rig(ODRIVE))


@dataclass
class Seen:
    """Every cycle of a run: which axes are enabled, and their set-points."""

    enabled: list[tuple[bool, ...]] = field(default_factory=list)
    targets: list[tuple[int, ...]] = field(default_factory=list)

    def look(self, stage: Stage) -> None:
        self.enabled.append(tuple(drive.torque_on for drive in stage.drives))
        self.targets.append(tuple(stage.group.targets.tolist()))


@contextmanager
def staged(
    prepared: PreparedRun, path: Path, script: Callable[[Any], None]
) -> Iterator[tuple[Any, Seen]]:
    """As `tests.scenarios.stage.staged`, with ODrives at the other end."""
    settings = BusSettings("virtual", f"odrive-{path}")
    seen = Seen()

    def each_cycle(stage: Stage) -> None:
        script(stage)
        seen.look(stage)

    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal: Any = SimulatedOdriveRig(prepared.rig, far, prepared.scene.start)
        group = make_drive_group(prepared.rig, near, rehearsal.pump)
        group.configure()
        yield Stage(prepared, rehearsal, group, RunFolder.create(path), each_cycle), seen
        group.close()


def test_a_plan_is_run_on_odrives_from_the_rig_file_alone(plan: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    answer = call(*("run", plan, "--rig", ODRIVE, "-o", run, "--fast", "--no-camera", "--json"))
    assert answer.code == 0, answer
    assert "were not read back" in answer.said
    summary = json.loads((run / "summary.json").read_text())
    assert summary["verdict"] == "PASSED"
    assert summary["lost_replies"] == 0
    events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    assert [event["code"] for event in events] == ["enabled", "moving", "held"]
    assert events[-1]["text"] == "at rest; the brakes of the winches hold"
    assert "odrive, 1000 kbit/s" in (run / "report.html").read_text()


@pytest.mark.parametrize("drives", [{"torques_ms": 50}, {"heartbeat_ms": 20}])
def test_a_jog_begins_when_the_motors_carry_the_cables(
    tmp_path: Path, drives: dict[str, int]
) -> None:
    rig, run = changed_rig(tmp_path, **drives), tmp_path / "jog"
    answer = call("jog", rig, "--by-mm", "0", "0", "-2", "--no-scene", "--fast", "-o", run)
    assert answer.code == 0, answer
    cycles = RunFolder(run).cycles()
    assert np.nanmin(cycles.tensions) > load_rig(rig).min_tension
    enabling = np.array(cycles.state) == State.ENABLING.value
    assert np.isnan(cycles.tensions[enabling][:-1]).all()


def test_rare_heartbeats_of_which_some_are_lost_are_waited_for_at_the_end(
    plan: Path, tmp_path: Path
) -> None:
    """The brakes have closed; only the heartbeat says so."""
    document = load_rig(ODRIVE).document
    drives = document.drives.model_copy(update={"heartbeat_ms": 1000})
    rig = rig_from_document(document.model_copy(update={"drives": drives}))
    disarmed: list[int] = []

    def lost(stage: Any) -> None:
        if stage.cycle > 300 and not stage.drives[4].torque_on:
            disarmed.append(stage.cycle)
        stage.drives[4].silent = {"heartbeat"} if 0 < len(disarmed) < 310 else set()

    with staged(prepare(verify(load_plan(plan), rig), rig), tmp_path / "run", lost) as (stage, _):
        outcome = stage.run()
    assert outcome.state is State.FINISHED, outcome.cause
    assert len(disarmed) >= 310


def test_measurements_are_compared_with_the_plan_of_the_same_moment(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """A set-point of an ODrive acts on arrival: no cycle passes until its position is reported."""
    with staged(prepared, tmp_path / "run", lambda _: None) as (stage, _):
        log = stage.run().log
    cycles = log.table()
    moving = np.array(cycles.state) == State.MOVING.value
    step = prepared.rig.motion.speed * prepared.rig.cycle
    assert cycles.encoder_error[moving].max() < 0.1 * step
    assert cycles.path_index[-1] == len(prepared.checked.table) - 1
    part = log.table(100, 200)
    np.testing.assert_array_equal(part.path_index, cycles.path_index[100:200])
    np.testing.assert_array_equal(part.encoder, cycles.encoder[100:200])


def test_targets_move_by_steps_of_the_path_and_all_axes_change_together(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", lambda _: None) as (stage, seen):
        outcome = stage.run()
        assert outcome.state is State.FINISHED
        assert {drive.state for drive in stage.drives} == {AxisState.IDLE}
        assert stage.rehearsal.pose.distance_to(prepared.scene.goal) < 1e-4
    assert all(len(set(row)) == 1 for row in seen.enabled), "never one alone"
    steps = np.abs(np.diff(np.array(seen.targets[3:]), axis=0))
    per_metre = np.abs([w.counts_per_metre for w in prepared.rig.winches])
    assert (steps <= prepared.rig.motion.speed * 0.01 * per_metre + 1.0).all()


def deaf(stage: Any) -> None:
    stage.drives[2].deaf = True


def test_an_operators_stop_ends_on_the_brakes(prepared: PreparedRun, tmp_path: Path) -> None:
    script = at(CRUISING, lambda stage: stage.board.ask_stop())
    with staged(prepared, tmp_path / "run", script) as (stage, seen):
        assert stage.run().state is State.STOPPED
        assert {drive.state for drive in stage.drives} == {AxisState.IDLE}
    assert all(len(set(row)) == 1 for row in seen.enabled)


@dataclass(frozen=True)
class Case:
    """A fault of drive 3 in cycle `CRUISING`, and the required report.

    Attributes:
        happens: Called at the beginning of the cycle.
        code: Of the event that reports the drive's fault, or its silence.
        words: In it.
        within: Cycles from there until the others are commanded to hold.
    """

    happens: Callable[[Any], object]
    code: str
    words: str
    within: int


CASES = {
    "axis error": Case(
        lambda stage: stage.drives[2].fail(0x1000), "drive_fault", "motor current above", 7
    ),
    "watchdog": Case(
        lambda stage: stage.drives[2].fail(AxisError.WATCHDOG_TIMER_EXPIRED),
        "drive_fault",
        "watchdog: no set-point in time",
        7,
    ),
    "emergency stop of one": Case(
        lambda stage: stage.drives[2].receive(2, b""), "drive_fault", "emergency stop", 7
    ),
    "restarts": Case(
        lambda stage: stage.drives[2].power_on(), "drive_fault", "(drive 3) disarmed itself", 7
    ),
    "no heartbeat": Case(
        lambda stage: stage.drives[2].silent.add("heartbeat"),
        "drive_fault",
        "heartbeat missing",
        18,
    ),
    "no position": Case(
        lambda stage: stage.drives[2].silent.add("estimates"), "drive_silent", "drive 3", 4
    ),
    "no torque": Case(
        lambda stage: stage.drives[2].silent.add("torques"), "drive_fault", "its torque", 8
    ),
    "cable pulled": Case(deaf, "drive_silent", "drive 3", 4),
}


def test_a_drive_whose_position_is_often_overdue_ends_the_run_along_the_path(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """It sends one in every third cycle, and may be a cycle late: it is overdue in one of three."""

    def rarely(stage: Any) -> None:
        is_due = stage.cycle < CRUISING or stage.cycle % 3 == 0
        stage.drives[2].silent = set() if is_due else {"estimates"}

    with staged(prepared, tmp_path / "run", rarely) as (stage, _):
        outcome = stage.run()
    assert outcome.state is State.LATCHED
    said = "cable 3 (drive 3) did not answer in 10 of the last 50 cycles; stopped along the path"
    assert outcome.cause == said


@pytest.mark.parametrize(
    ("holding", "said"),
    [
        (
            False,
            "did not move for 2 cycles while its set-points advanced: it may be jammed or disarmed",
        ),
        (True, "all 8 cables carry no tension: they are broken or slack, or their drives are dis"),
    ],
)
def test_an_emergency_stop_is_no_broken_cable(
    prepared: PreparedRun, tmp_path: Path, holding: bool, said: str
) -> None:
    """Motion and tensions are missed before the next heartbeats give the reason."""

    def press(stage: Any) -> None:
        for drive in stage.drives:
            drive.fail(AxisError.ESTOP_REQUESTED)

    def script(stage: Any) -> None:
        at(CRUISING - 50, lambda stage: stage.board.ask_hold(holding))(stage)
        at(CRUISING, press)(stage)

    with staged(prepared, tmp_path / "run", script) as (stage, _):
        outcome = stage.run()
        events = stage.events()
    assert said in outcome.cause
    assert any("emergency stop" in e.text for e in events if e.code == "drive_fault")


@pytest.mark.parametrize(("drive", "estimates_ms"), [(2, 10), (4, 10), (2, 30), (2, 50)])
def test_a_drive_that_jams_stops_the_run_before_its_cable_is_overloaded(
    plan: Path, tmp_path: Path, drive: int, estimates_ms: float
) -> None:
    """Detected by its second position since; without the jam the same run reaches the goal."""
    document = load_rig(ODRIVE).document
    drives = document.drives.model_copy(update={"estimates_ms": estimates_ms})
    rig = rig_from_document(document.model_copy(update={"drives": drives}))
    prepared = prepare(verify(load_plan(plan), rig), rig)

    def jam(stage: Any) -> None:
        stage.drives[drive].motor.jammed = True

    def with_a_hold(stage: Any) -> None:
        at(CRUISING - 50, lambda stage: stage.board.ask_hold(True))(stage)
        at(CRUISING, lambda stage: stage.board.ask_hold(False))(stage)
        at(CRUISING + 20, lambda stage: stage.board.ask_speed(50))(stage)

    with staged(prepared, tmp_path / "jammed", at(CRUISING, jam)) as (stage, _):
        outcome = stage.run()
        (stuck,) = (event for event in stage.events() if event.code == "drive_stuck")
    period = round(estimates_ms / 10)
    name, cycles = f"cable {drive + 1} (drive {drive + 1})", max(2, period)
    assert outcome.cause.startswith(f"{name} did not move for {cycles} cycles"), outcome.cause
    assert round(stuck.time_s / 0.01) - CRUISING <= 2 * period + 2
    assert np.nanmax(outcome.log.table().tensions) < 102.0
    with staged(prepared, tmp_path / "sound", with_a_hold) as (stage, _):
        assert stage.run().state is State.FINISHED
        codes = [event.code for event in stage.events()]
    assert codes == ["enabled", "moving", "hold", "resume", "speed", "held"]


@pytest.mark.parametrize("name", CASES)
def test_a_fault_of_one_drive_is_a_hold_of_all_and_then_their_brakes(
    prepared: PreparedRun, tmp_path: Path, name: str
) -> None:
    case = CASES[name]
    with staged(prepared, tmp_path / "run", at(CRUISING, case.happens)) as (stage, seen):
        outcome = stage.run()
        assert outcome.state is State.LATCHED
        assert "drive 3" in outcome.cause or "cable 3" in outcome.cause
        # The loss of tension is detected before the drive's next heartbeat gives the reason.
        first = next(event for event in stage.events() if event.time_s >= CRUISING * 0.01)
        assert any(e.code == case.code and case.words in e.text for e in stage.events())
        # A drive whose bus cable is pulled is disarmed by its own watchdog.
        stage.rehearsal.advance(0.2)
        assert {drive.state for drive in stage.drives} == {AxisState.IDLE}
    noticed = round(first.time_s / 0.01)
    assert noticed - CRUISING <= case.within
    targets = np.array(seen.targets)
    assert (targets[noticed + 2 :] == targets[noticed + 2]).all(), "nothing moves on"
    cycles = outcome.log.table()
    stopped = np.array(cycles.state) == State.LATCHED.value
    assert np.isnan(cycles.tensions[stopped]).all(), "states lag behind torques"
    (check,) = tensions(cycles, prepared.rig)
    assert "known only until" in check.text
    others = np.delete(np.array(seen.enabled), 2, axis=1)
    assert (others.all(axis=1) | ~others.any(axis=1)).all(), "the others never one alone"
    held = int(others[noticed:].all(axis=1).sum())
    assert HELD_CYCLES <= held <= HELD_CYCLES + 3


def reports_no_number(stage: Any) -> None:
    drive = stage.drives[2]
    sent = drive._send

    def send(layout: Any, *values: float) -> None:
        is_position = layout is drive._layouts.get_encoder_estimates
        sent(layout, *([math.nan] * 2 if is_position else values))

    drive._send = send


DISARMED = ("watchdog", "restarts", "emergency stop of one")


@pytest.mark.parametrize("happens", [CASES[name].happens for name in DISARMED], ids=DISARMED)
def test_an_axis_that_is_idle_at_the_end_is_held_by_its_brake(
    prepared: PreparedRun, tmp_path: Path, happens: Callable[[Any], object]
) -> None:
    with staged(prepared, tmp_path / "run", at(CRUISING, happens)) as (stage, _):
        outcome = stage.run()
        summary = concluded(stage, outcome)
    assert "drive_fault" in [event["code"] for event in summary["events"]]
    assert not [reason for reason in summary["reasons"] if "may not hold" in reason]


SILENT = "cable 3 (drive 3) does not answer"


@pytest.mark.parametrize(
    ("happens", "faults", "words"),
    [
        (reports_no_number, 1, ""),
        (CASES["no heartbeat"].happens, 1, SILENT),
        (CASES["cable pulled"].happens, None, ""),
    ],
)
def test_an_axis_whose_state_is_not_heard_at_the_end_is_named_once(
    prepared: PreparedRun,
    tmp_path: Path,
    happens: Callable[[Any], object],
    faults: int | None,
    words: str,
) -> None:
    """Unless the cause states it; the bus is not lost."""
    with staged(prepared, tmp_path / "run", at(CRUISING, happens)) as (stage, _):
        outcome = stage.run()
        codes = [event.code for event in stage.events()]
        summary = concluded(stage, outcome)
    assert faults is None or codes.count("drive_fault") == faults
    assert "bus_lost" not in codes
    held = [check["text"] for check in summary["checks"] if check["name"] == "held"]
    assert [words in text for text in held] == ([True] if words else [])


def changed_rig(tmp_path: Path, brake: bool = True, **drives: Any) -> Path:
    data = yaml.safe_load(ODRIVE.read_text())
    data["drives"].update(drives)
    data["drives"] = {key: value for key, value in data["drives"].items() if value is not None}
    data["winches"][4]["brake"] = brake
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"brake": False}, "winches with brakes (winches[].brake of all"),
        ({"watchdog_ms": None}, "hold when the master is lost"),
        ({"watchdog_ms": 25}, "stay armed for 3 cycles without a set-point"),
    ],
)
def test_a_rig_whose_drives_would_drop_the_platform_is_not_armed(
    plan: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    rig = changed_rig(tmp_path, **changes)
    with nothing_written(tmp_path):
        answer = call("run", plan, "--rig", rig, "-o", tmp_path / "run", "--fast", "--no-camera")
    assert answer.code == Refused.exit_code, answer
    assert words in answer.said


def test_an_unfit_dbc_file_is_refused_before_anything_moves(plan: Path, tmp_path: Path) -> None:
    rig = changed_rig(tmp_path, dbc=str(tmp_path / "none.dbc"))
    with nothing_written(tmp_path):
        answer = call("run", plan, "--rig", rig, "-o", tmp_path / "run", "--fast", "--no-camera")
    assert answer.code == 2, answer
    assert "no such file" in answer.said


def test_a_bus_that_the_drives_messages_would_fill_is_refused(plan: Path, tmp_path: Path) -> None:
    rig = changed_rig(tmp_path, estimates_ms=1, torques_ms=1)
    answer = call("run", plan, "--rig", rig, "-o", tmp_path / "run", "--fast", "--no-camera")
    assert answer.code == Refused.exit_code, answer
    assert "the limit is 70%" in answer.said
    assert "drives.*_ms" in answer.said


def test_the_doctor_names_the_extra_and_the_files_that_odrives_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(rig: Path) -> dict[str, Any]:
        checks = json.loads(call("doctor", rig, "--json").out)
        return next(entry for entry in checks if entry["name"] == "drives")

    assert answer(ODRIVE)["good"]
    lost = answer(changed_rig(tmp_path, endpoints=str(tmp_path / "none.json")))
    assert not lost["good"]
    assert "no such file" in lost["text"]
    for module in [name for name in sys.modules if name.partition(".")[0] == "cantools"]:
        monkeypatch.setitem(sys.modules, module, None)
    without = answer(ODRIVE)
    assert not without["good"]
    assert "cdpr[odrive]" in without["fix"]
