"""The next steps that the program prints can be done: each command is run here."""

from __future__ import annotations

import os
import shlex
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from calibration.geometry.pose_selection import MeasurementPlan
from calibration.results import write_result
from cdpr.cli.operate.run import show
from cdpr.cli.options import run_command
from cdpr.cli.output import progress_bar
from drivers.can_bus import BusSettings
from drivers.plausibility import HOMING_OPTIONS
from executor import service
from executor.cameras.sources import choose_cameras
from executor.drives import DriveStatus, is_simulated
from executor.interlock import locks
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.locks import SetUpLock
from executor.interlock.reference import ReferenceStatus
from executor.recording.run_folder import BEGUN, RunFolder
from executor.remote.client import request_run as request
from executor.remote.command_server import commands_from_start
from executor.remote.status import identity
from executor.run_result import RunResult
from executor.safety.fault_messages import page_text
from executor.service import StatusResult
from executor.state_machine import State
from executor.supervision import Supervisor
from model.errors import BadInput, Fault
from model.rig import Rig, load_rig, rig_from_document
from model.scene import load_scene
from planner.planning import plan_path
from planner.settings import OptimalSettings, PlannerSettings
from tests.calibration.results import camera_result_of
from tests.cli.plans import CONFIGS, GOAL_MM, RIG, START_MM, free_scene, straight_plan
from tests.cli.program import call, one_message

SCENE = CONFIGS / "environment_1.yaml"


def commands_in(line: str) -> list[list[str]]:
    """The words of each `cdpr …` of a sentence, without `cdpr`."""
    parts = [part.split(", then ")[0] for part in line.split("cdpr ")[1:]]
    return [shlex.split(part.rstrip(" ,")) for part in parts]


def test_after_a_plan_with_a_calibration_its_next_step_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my rig").mkdir()
    monkeypatch.chdir(tmp_path / "my rig")
    result = write_result(tmp_path / "my rig", camera_result_of())
    plan = tmp_path / "my rig" / "plan.json"
    goal = ("--goal-mm", "170", "180", "300")
    answer = call("plan", RIG, SCENE, "-o", plan, "--calibration", result, *goal)
    assert answer.code == 0, answer
    (line,) = (line for line in answer.out.splitlines() if line.split()[:1] == ["next"])
    check, run = commands_in(line)
    assert call(*check).code == 0
    done = call(*run, "--fast", "--no-camera")
    assert done.code == 0, done
    assert (tmp_path / "my rig" / "RUNDIR" / "report.html").is_file()


def test_the_next_step_after_a_plan_of_a_new_rig_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its file has no camera and no tags yet."""
    monkeypatch.chdir(tmp_path)
    made = call("new", "rig.yaml", answers="\n" * 50)
    assert made.code == 0, made
    *_, plan = commands_in(made.out.splitlines()[-1])
    words = [str(SCENE) if word == "SCENE" else word for word in plan]
    answer = call(*words, "--goal-mm", "170", "180", "300")
    assert answer.code == 0, answer
    (line,) = (line for line in answer.out.splitlines() if line.split()[:1] == ["next"])
    assert "--no-camera" in line
    for words in commands_in(line):
        assert call(*words, *(("--fast",) if words[0] == "run" else ())).code == 0


def test_the_next_step_after_homing_is_a_jog_with_the_same_bus_and_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was refused without a scene, and moved the drives of the rig file, which may be others."""
    monkeypatch.chdir(tmp_path)
    result = write_result(tmp_path, camera_result_of())
    same = ("--interface", "virtual", "--channel", "my bus", "--calibration", str(result))
    homed = call("home", RIG, "--at-home", "--fast", *same)
    assert homed.code == 0, homed
    _, jog, *parts = homed.out.splitlines()[-1].split("`")
    (words,) = commands_in(jog)
    assert words == ["jog", str(RIG), *same, "--to-home", "--scene", "SCENE"]
    assert "--no-scene" in parts
    jogged = call(*words[:-1], SCENE, "--fast")
    assert jogged.code == 0, jogged


WITHOUT = load_rig(RIG).document.model_copy(update={"cameras": [], "tags": None})


@pytest.mark.parametrize(
    ("rig", "interface", "options"),
    [
        (load_rig(RIG), "virtual", ()),
        (load_rig(RIG), "socketcan", ("--camera", "SOURCE")),
        (rig_from_document(WITHOUT), "virtual", ("--no-camera",)),
        (rig_from_document(WITHOUT), "socketcan", ("--no-camera",)),
    ],
)
def test_a_run_as_the_next_step_names_the_cameras_that_it_needs(
    rig: Rig, interface: str, options: tuple[str, ...]
) -> None:
    on_bus = rig.with_bus(interface, "can0")
    line = run_command(Path("my plan.json"), Path("rig.yaml"), on_bus, [Path("a"), Path("b")])
    ((verb, *words),) = commands_in(line)
    files = ["my plan.json", "--rig", "rig.yaml", "--calibration", "a", "--calibration", "b"]
    assert (verb, words) == ("run", [*files, *options, "-o", "RUNDIR"])
    cameras = ["0" for word in words if word == "SOURCE"]
    choose_cameras(on_bus, cameras, "--no-camera" in words, is_simulated(on_bus))


def test_the_next_steps_after_the_choice_of_poses_fit_a_rig_without_a_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They left out `--calibration`, without which `cdpr run` refuses the plan, and the camera."""
    monkeypatch.chdir(tmp_path)
    rig = rig_from_document(WITHOUT)
    document = straight_plan(rig, free_scene(START_MM, GOAL_MM), [START_MM, GOAL_MM])
    made = MeasurementPlan((rig.home,), document)
    monkeypatch.setattr("cdpr.cli.calibrate.rig.calibrated_rig", lambda *_: rig)
    monkeypatch.setattr("cdpr.cli.calibrate.rig.measurement_poses", lambda *_, **_options: made)
    Path("result.yaml").touch()
    options = ("-o", "measure.json", "--calibration", "result.yaml")
    answer = call("calibrate", "poses", RIG, SCENE, *options)
    assert answer.code == 0, answer
    run, calibrate = commands_in(answer.out.splitlines()[-1])
    assert run[run.index("--calibration") + 1] == "result.yaml"
    assert "--no-camera" in run
    assert calibrate == ["calibrate", "rig", str(RIG), "RUNDIR", "--without-poses"]


def test_the_next_step_after_calibration_results_were_applied_states_the_pose(
    tmp_path: Path,
) -> None:
    result = write_result(tmp_path, camera_result_of())
    applied = call("calibrate", "apply", RIG, result, "-o", tmp_path / "new.yaml")
    assert applied.code == 0, applied
    _, home, then = applied.out.splitlines()[-1].split("`")
    one_message(call(*commands_in(home)[0], "--fast"), 2, "state the platform pose")
    assert HOMING_OPTIONS in then


def test_a_plan_that_was_made_for_calibrated_numbers_is_refused_with_that_as_a_reason(
    short_plan: Path, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.read_text().replace("mass_kg:", "mass_kg: 0.5 # "))
    answer = call("run", short_plan, "--rig", rig, "-o", tmp_path / "run", "--fast")
    one_message(answer, 2, "was made for the rig", "pass the same --calibration")


@pytest.mark.parametrize(
    ("state", "interface", "says"),
    [
        ("latched", "socketcan", "cdpr reset RIG"),
        ("latched", "virtual", "run again into a new folder"),
        ("finished", "socketcan", "check the report"),
    ],
)
def test_a_run_that_failed_has_a_next_step_and_its_faults_explained(
    capsys: pytest.CaptureFixture[str], state: str, interface: str, says: str
) -> None:
    summary = {
        "verdict": "FAILED",
        "sentence": "The run ended with a fault before the goal.",
        "reasons": [],
        "final_state": state,
        "interface": interface,
        "events": [{"code": "moving"}, {"code": "drive_silent"}],
    }
    show(RunResult(Path("run"), summary), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert says in lines[-1]
    assert lines[-1].startswith("  next: ")
    (explained,) = (commands_in(line)[0] for line in lines if "details" in line)
    assert call(*explained).out.strip() == page_text("drive_silent").strip()


@pytest.mark.parametrize("verdict", ["PASSED", "STOPPED"])
def test_a_run_that_went_well_points_to_no_fault(
    capsys: pytest.CaptureFixture[str], verdict: str
) -> None:
    """A lost reply without effect is not reported."""
    events = [{"code": "pass"}, {"code": "reply_lost"}]
    summary = {"verdict": verdict, "sentence": "", "reasons": [], "events": events}
    show(RunResult(Path("run"), summary), as_json=False)
    assert "details" not in capsys.readouterr().out


REFERENCED = ReferenceStatus(counts=True, why_not=None, made=None, how=None, file=None)
STANDING = StatusResult(
    rig="rig",
    bus="bus",
    run=None,
    preparing=(),
    latched=None,
    being_set_up=False,
    reference=REFERENCED,
)


def test_status_says_what_has_to_be_done_before_a_run() -> None:
    rig = Path("my rig.yaml")
    assert STANDING.next_step(rig) == ""
    lost = replace(STANDING, reference=replace(REFERENCED, counts=False, why_not="never homed"))
    assert lost.next_step(rig).startswith("cdpr home 'my rig.yaml'")
    assert lost.next_step().startswith("cdpr home RIG with")
    assert lost.next_step(rig).endswith("cdpr.home() with at_home=True, pose= or camera=")
    both = replace(lost, latched="cable 3 is slack").next_step(rig)
    assert both.index("cdpr reset 'my rig.yaml'") < both.index("cdpr home 'my rig.yaml'")
    assert replace(lost, run=17).next_step(rig) == ""


def test_status_names_who_prepares_a_motion_and_does_not_read_its_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also while it waits for the operator's answer, and its drives are free."""
    for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(service, "open_bus", lambda _: pytest.fail("the bus is opened"))
    rig = load_rig(CONFIGS / "gachon_8_6.yaml").with_bus("udp_multicast", "239.74.9.10")
    for channel, who in (("239.74.9.10", (os.getpid(),)), ("239.74.9.11", ())):
        other, is_free = rig.with_bus("udp_multicast", channel), bool(who)
        monkeypatch.setattr(SetUpLock, "tried", lambda _, free=is_free: nullcontext(free))
        with commands_from_start("run", other, Supervisor(), realtime=False):
            result = service.status(rig)
        assert (result.run, result.preparing, result.being_set_up) == (None, who, True)
        said = [text for name, text in result.facts(Path("rig.yaml")) if name == "motion"]
        assert said == [f"process {n} is preparing one; `cdpr stop` cancels it" for n in who]


@pytest.mark.parametrize("state", ["preparing", "releasing", "enabling", "securing", "finished"])
def test_a_motion_that_has_not_the_latch_yet_or_no_longer_is_named_and_its_drives_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    """While its devices are opened, status read the drives, for which the run had to wait."""
    for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    read: list[Rig] = []
    monkeypatch.setattr(service, "_read", lambda rig, _, known: read.append(rig) or known)
    rig = load_rig(CONFIGS / "gachon_8_6.yaml").with_bus("udp_multicast", "239.74.9.13")
    moving: Any = SimpleNamespace(as_dict=lambda: {**identity(rig, None), "state": state})
    started = commands_from_start("run", rig, Supervisor(), realtime=False)
    with started as commands, commands.during_motion(moving):
        result = service.status(rig)
    here, is_ahead, is_over = os.getpid(), state == "preparing", state == "finished"
    assert result.preparing == ((here,) if is_ahead else ())
    assert result.run == (None if is_ahead or is_over else here)
    assert len(read) == is_over, "its drives may be read once it is over"


def test_status_names_no_reset_that_would_be_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fault is of another rig on the bus, or of drives that this rig file no longer has."""
    monkeypatch.setattr(locks, "SHARED", tmp_path / "absent")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(SetUpLock, "tried", lambda _: nullcontext(False))
    rig = load_rig(CONFIGS / "gachon_8_6.yaml").with_bus("udp_multicast", "239.74.9.12")
    for name, nodes, wanted in (
        ("RIG 2", rig.drive_names, "with the rig file of 'RIG 2'"),
        (rig.name, (*rig.drive_names, 99), "with the rig file it happened with"),
        (rig.name, rig.drive_names, "then run cdpr reset 'my rig.yaml'"),
    ):
        latch = FaultLatch(BusSettings.of(rig), nodes)
        latch.engage(name, tmp_path)
        latch.settle(name, State.LATCHED, "cable 3 is slack", tmp_path)
        stored = replace(service.status(rig), being_set_up=False)
        assert wanted in stored.next_step(Path("my rig.yaml"))
        assert ("cdpr reset 'my" in stored.next_step(Path("my rig.yaml"))) == ("my" in wanted)
        latch.disengage()


def test_a_drive_set_up_for_another_cycle_is_not_said_to_have_lost_power() -> None:
    state = "quick stop active"
    drive = DriveStatus(1, state, position=0, tension=5.0, has_torque=True, set_up=False)
    (line,) = replace(STANDING, drives=(drive,)).drive_lines({1: "cable 1 (drive 1)"})
    assert line.endswith("not set up, or for another cycle")
    (line,) = replace(STANDING, drives=(replace(drive, set_up=True),)).drive_lines({1: "cable 1"})
    assert line.endswith(" N")


def test_status_states_the_error_of_a_drive_in_fault() -> None:
    over_voltage = "DC link over-voltage (error 3210h)"
    flags = {"has_torque": False, "set_up": True}
    drive = DriveStatus(1, "fault", position=0, tension=5.0, error=over_voltage, **flags)
    shown = replace(STANDING, drives=(drive,))
    (line,) = shown.drive_lines({1: "cable 1 (drive 1)"})
    assert line.endswith(over_voltage)
    assert shown.as_dict()["drives"][0]["error"] == over_voltage


@pytest.mark.parametrize("state", ["fault", "fault reaction active", "idle, in error"])
def test_a_drive_in_fault_is_named_and_has_to_be_reset_before_it_is_homed(state: str) -> None:
    """A script saw neither the cause nor the step without which homing is refused."""
    error = "over-current (error 2310h)"
    failed = DriveStatus(21, state, 0, 5.0, False, True, error, in_fault=True)
    waits = DriveStatus(22, "switch on disabled", 0, 5.0, False, True, error="its STO is active")
    lost = replace(REFERENCED, counts=False, why_not="never homed")
    shown = dict(replace(STANDING, drives=(failed, waits), reference=lost).facts())
    assert f"drive 21 {state}: over-current (error 2310h)" in shown["drives"]
    steps = shown["next"].split("; then ")
    assert steps[:2] == ["remove the cause shown for drive 21, 22", "run cdpr reset RIG"]
    assert steps[2].startswith("cdpr home RIG")
    assert "reset" not in replace(STANDING, drives=(waits,)).next_step()


def test_monitor_calls_itself_by_its_name() -> None:
    with pytest.raises(Fault, match="no active run") as caught:
        request("status", None, verb="monitor")
    assert caught.value.where == "cdpr monitor"
    assert "cdpr status" not in str(caught.value)
    answer = call("monitor", "--once")
    assert answer.code == 1
    assert "cdpr monitor: no active run" in answer.err


def test_a_jig_has_no_uncertainty_of_nothing() -> None:
    homed = call("home", RIG, "--at-home", "--fast")
    assert homed.code == 0, homed
    assert "0.000" not in homed.out
    assert "that of the jig (not measured)" in homed.out


def test_no_coordinate_is_a_negative_zero(short: Path, tmp_path: Path) -> None:
    answer = call("run", short, "--rig", RIG, "-o", tmp_path / "run", "--fast", "--no-camera")
    assert answer.code == 0, answer
    assert "-0.0" not in answer.out


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """A plan that begins slightly below zero."""
    scene = load_scene(SCENE)
    path = tmp_path / "plan.json"
    start = [-0.00001, 0.0, float(scene.start.position[2]) * 1000.0]
    goal = [30.0, -0.00002, start[2]]
    options = ("--start-mm", *map(str, start), "--goal-mm", *map(str, goal))
    answer = call("plan", RIG, SCENE, "-o", path, *options)
    assert answer.code == 0, answer
    return path


@pytest.mark.parametrize("settings", [OptimalSettings(rounds=40), PlannerSettings(seed=3)])
def test_compiling_is_no_part_of_planning(
    monkeypatch: pytest.MonkeyPatch, settings: OptimalSettings | PlannerSettings
) -> None:
    """New machine code is first used for a short plan that is discarded."""
    made: list[Any] = []

    @contextmanager
    def not_compiled(*_: object) -> Iterator[bool]:
        yield False

    def make(_rig: object, _scene: object, wanted: Any, **_options: object) -> Any:
        made.append(wanted)
        return len(made)

    monkeypatch.setattr("planner.planning.planner_compilation", not_compiled)
    monkeypatch.setattr("planner.planning.make_plan", make)
    document: Any = plan_path(load_rig(RIG), load_scene(SCENE), settings)
    assert document == 2
    first, second = made
    assert second == settings
    assert first != settings


def test_the_bar_says_what_the_run_does(monkeypatch: pytest.MonkeyPatch) -> None:
    told_of: list[dict[str, Any]] = []
    monkeypatch.setattr(
        "cdpr.cli.output.Progress.update", lambda *_, **options: told_of.append(options)
    )
    with progress_bar("preparing, row", 10.0, shown=False) as advance:
        advance(3.0, "", "holding, row")
        advance(4.0)
    assert told_of[0]["description"] == "holding, row"
    assert told_of[1]["description"] is None


SPACED = Path("my runs; first")


def test_paths_in_printed_commands_are_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    SPACED.mkdir()
    result = RunResult(SPACED, {}, missing={"report.html": "No space left on device"})
    with pytest.raises(BadInput) as caught:
        RunFolder.open(folder_begun(SPACED))
    (SPACED / "rig.yaml").touch()
    calibrated = SPACED / "calibrated.yaml"
    camera = write_result(SPACED, camera_result_of())
    applied = call("calibrate", "apply", RIG, camera, "-o", calibrated)
    for said in (result.missing_text(), caught.value.next_step, applied.out):
        assert shlex.quote(str(SPACED)) in said or shlex.quote(str(calibrated)) in said, said


def folder_begun(path: Path) -> Path:
    """A run folder with the files that are written before anything moves."""
    for name in BEGUN:
        (path / name).write_text("{}\n")
    return path
