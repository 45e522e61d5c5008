"""`cdpr release`: brakes close, then the torque of all drives is switched off together."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from cdpr.cli.options import rig_on_bus
from drivers.can_bus import BusSettings
from drivers.cia402.state_machine import TORQUE_ON, DriveState
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import as_in_the_file
from executor.trajectory.setpoints import PreparedRun
from model.rig import Rig
from simulation.drives.cia402 import SimulatedDrive
from simulation.ground_truth import PowerLoss
from tests.cli.program import call
from tests.scenarios.test_processes import program
from tests.scenarios.test_real_time import drives_on


def watched(drives: tuple[SimulatedDrive, ...], words: list[int]) -> None:
    """Keeps every control word that a drive takes."""
    for drive in drives:
        takes = drive._take_control_word

        def take(word: int, takes: object = takes) -> None:
            words.append(word)
            takes(word)  # type: ignore[operator]

        drive._take_control_word = take  # type: ignore[method-assign]


def hold(drives: tuple[SimulatedDrive, ...]) -> None:
    """As after a run."""
    for drive in drives:
        drive.objects[0x605A, 0] = 6  # else it lets go at the end of its ramp
        drive.state = DriveState.QUICK_STOP_ACTIVE


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("braked", [True, False])
def test_no_drive_has_torque_afterwards_and_nothing_has_moved(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path, braked: bool
) -> None:
    channel = f"239.74.163.30:{20000 + (os.getpid() * 29 + braked) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rig = tmp_path / "rig.yaml"
    text = slow_rig.read_text()
    rig.write_text(text.replace("encoder: absolute", "encoder: absolute, brake: true"))
    file = rig if braked else slow_rig
    with drives_on(channel, slow_run) as rehearsal:
        stood = [round(drive.motor.position) for drive in rehearsal.drives]
        interlock = MotionInterlock(_on(channel, file))
        interlock.file.write(
            as_in_the_file(_on(channel, file)).model_copy(update={"stands_at": stood})
        )
        words: list[int] = []
        hold(rehearsal.drives)
        watched(rehearsal.drives, words)
        assert call("release", file, *bus, answers="n\n").code == 130
        assert call("reset", file, *bus, "--yes").code == 0
        answer = call("release", file, *bus, "--yes", "--without-real-time", "--json")
        assert answer.code == 0, answer
        result = json.loads(answer.out)
        assert result["drives"] == ["ready to switch on"] * 8
        assert {drive.state for drive in rehearsal.drives} == {DriveState.READY_TO_SWITCH_ON}
        assert [round(drive.motor.position) for drive in rehearsal.drives] == stood
        assert all(word & 0x02 for word in words), "disable voltage frees cables at once"
        assert result["reference"]["counts"] is braked
        if not braked:
            assert "released by the operator" in result["reference"]["why_not"]
    FaultLatch(BusSettings("udp_multicast", channel)).require_disengaged()


@pytest.mark.slow
@pytest.mark.real_time
def test_drives_that_count_from_anywhere_stay_where_they_are(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.33:{20000 + (os.getpid() * 29) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rig = tmp_path / "rig.yaml"
    rig.write_text(slow_rig.read_text().replace("encoder: absolute, ", ""))
    with drives_on(channel, slow_run) as rehearsal:
        loss = PowerLoss.drawn(slow_run.rig, 3, 0.0, on_a_stand=True)
        loss.apply_to(slow_run.rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
        hold(rehearsal.drives)
        stood = [round(drive.motor.position) for drive in rehearsal.drives]
        reset = call("reset", rig, *bus, "--yes", "--json")
        assert reset.code == 0, reset
        assert json.loads(reset.out)["restarted"] == list(range(1, 9))
        assert all(_within_limits(drive) for drive in rehearsal.drives)
        aims: list[tuple[float, float]] = []
        for drive in rehearsal.drives:
            enable = drive._command_enable

            def aimed(drive: SimulatedDrive = drive, enable: Callable[[], None] = enable) -> None:
                aims.append((drive._target, drive.motor.position))
                enable()

            drive._command_enable = aimed  # type: ignore[method-assign]
        answer = call("release", rig, *bus, "--yes", "--without-real-time")
        assert answer.code == 0, answer
        assert len(aims) >= 8
        assert all(target == round(position) for target, position in aims)
        assert [round(drive.motor.position) for drive in rehearsal.drives] == stood


def _within_limits(drive: SimulatedDrive) -> bool:
    low, high = (drive.objects[0x607D, sub] for sub in (1, 2))
    return bool(low <= drive.motor.position <= high)


def _on(channel: str, file: Path) -> Rig:
    return rig_on_bus(file, "udp_multicast", channel)


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("latched", [True, False])
@pytest.mark.parametrize(  # brakes decide only where others hold
    ("braked", "holding"), [(True, True), (False, True), (True, False)]
)
def test_the_next_steps_after_a_drive_in_fault_lead_out_of_it(
    slow_run: PreparedRun,
    slow_rig: Path,
    tmp_path: Path,
    braked: bool,
    latched: bool,
    holding: bool,
) -> None:
    """Release and reset referred to each other, and neither could be done."""
    case = braked * 4 + latched * 2 + holding
    channel = f"239.74.163.37:{20000 + (os.getpid() * 29 + case) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rig = tmp_path / "rig.yaml"
    brake = "encoder: absolute, brake: true" if braked else "encoder: absolute"
    rig.write_text(slow_rig.read_text().replace("encoder: absolute", brake))
    latch = FaultLatch(BusSettings("udp_multicast", channel))
    if latched:
        latch.engage("gachon_8_6", tmp_path, "cable 4 (drive 4): DC link under-voltage")
        latch.let_go()
    fault = latch.read()
    with drives_on(channel, slow_run) as rehearsal:
        if holding:
            hold(rehearsal.drives)
        rehearsal.drives[3].state = DriveState.FAULT
        done: list[str] = []
        wants = ["status"] if latched or holding else ["reset"]
        while wants:
            step = wants.pop(0)
            done.append(step)
            assert len(done) < 8, f"the next steps do not end: {done}"
            if step == "emergency stop":
                for drive in rehearsal.drives:
                    drive.state = DriveState.SWITCH_ON_DISABLED
                continue
            arguments = {"release": ("--yes", "--without-real-time"), "reset": ("--yes",)}
            answer = call(step, rig, *bus, *arguments.get(step, ()))
            said = answer.said if step == "status" or answer.code else ""
            wants = steps_in(said) if said else wants
            if step == "release" and answer.code == 0:
                assert {drive.state for drive in rehearsal.drives} == {
                    DriveState.FAULT,
                    DriveState.READY_TO_SWITCH_ON,
                }
                assert latch.read() == fault, "a latched fault stays latched"
        assert done[-1] == "reset"
        assert ("release" in done) == (braked and holding)
        assert ("emergency stop" in done) == (holding and not braked)
        assert len(done) == len({*done}), "each step was done once"
        assert not {drive.state for drive in rehearsal.drives} & {*TORQUE_ON, DriveState.FAULT}
    latch.require_disengaged()


def steps_in(text: str) -> list[str]:
    """What the next step of an output asks for; of two alternatives the first."""
    step = re.split(r"\bnext:? ", text)[-1]
    found = re.findall(r"cdpr (release|reset)|(?<!or press the )(emergency stop)", step)
    return [verb or stop for verb, stop in found]


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("first", ["reset", "release"])
@pytest.mark.parametrize("braked", [True, False])
def test_no_refusal_after_a_drive_in_fault_refers_back(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path, first: str, braked: bool
) -> None:
    """Whichever command an operator tries first: reset names release or the emergency stop."""
    channel = f"239.74.163.38:{20000 + (os.getpid() * 29 + braked) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rig = tmp_path / "rig.yaml"
    brake = "encoder: absolute, brake: true" if braked else "encoder: absolute"
    rig.write_text(slow_rig.read_text().replace("encoder: absolute", brake))
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    with drives_on(channel, slow_run) as rehearsal:
        hold(rehearsal.drives)
        rehearsal.drives[3].state = DriveState.FAULT
        options = ("--without-real-time",) if first == "release" else ()
        answer = call(first, rig, *bus, *options, answers="n\n")
        if first == "release" and braked:
            assert answer.code == 130
            assert "cable 4 (drive 4): not enabled" in answer.said
        elif first == "release":
            assert answer.code == 3
            assert steps_in(answer.said) == ["emergency stop", "reset"]
        else:
            answer = call(first, rig, *bus, "--yes")
            assert answer.code == 3
            out = "release" if braked else "emergency stop"
            assert steps_in(answer.said) == [out, "reset"]
        assert rehearsal.drives[3].state is DriveState.FAULT
        others = {drive.state for k, drive in enumerate(rehearsal.drives) if k != 3}
        assert others == {DriveState.QUICK_STOP_ACTIVE}


@pytest.mark.slow
@pytest.mark.real_time
def test_a_drive_that_does_not_go_along_leaves_a_latched_fault(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.31:{20000 + (os.getpid() * 29) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    with drives_on(channel, slow_run) as rehearsal:
        hold(rehearsal.drives)
        stuck = rehearsal.drives[3]
        stuck._command_shutdown = lambda: None  # type: ignore[method-assign]
        answer = call("release", slow_rig, *bus, "--yes", "--without-real-time")
    assert answer.code == 1
    assert "cable 4 (drive 4) is in switched on instead of ready to switch on" in answer.err
    assert "`cdpr status RIG` shows whether to run" in " ".join(answer.err.split())
    latched = FaultLatch(BusSettings("udp_multicast", channel)).read()
    assert latched is not None
    assert "while releasing the drives" in latched.cause


@pytest.mark.slow
@pytest.mark.real_time
def test_ctrl_c_during_release_stops_all_and_says_what_is_left(
    slow_run: PreparedRun, slow_rig: Path
) -> None:
    channel = f"239.74.163.34:{20000 + (os.getpid() * 29) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    with drives_on(channel, slow_run) as rehearsal:
        hold(rehearsal.drives)
        for drive in rehearsal.drives:
            drive._command_shutdown = lambda: None  # type: ignore[method-assign]
        first = rehearsal.drives[0]
        with program("release", slow_rig, *bus, "--yes", "--without-real-time") as process:
            enable = first._command_enable

            def interrupted() -> None:
                enable()
                process.send_signal(signal.SIGINT)

            first._command_enable = interrupted  # type: ignore[method-assign]
            _, err = process.communicate(timeout=60)
        assert process.returncode == 130, err
        assert DriveState.OPERATION_ENABLED not in {drive.state for drive in rehearsal.drives}
    assert "a fault is latched, and the drives must be homed again" in err.replace("\n", " ")
    latched = FaultLatch(BusSettings("udp_multicast", channel)).read()
    assert latched is not None
    assert "stopped while releasing the drives" in latched.cause
    assert "next:" not in latched.cause


@pytest.mark.slow
@pytest.mark.real_time
def test_an_emergency_stop_between_two_programs_loses_the_reference(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.34:{20000 + (os.getpid() * 29) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rig = tmp_path / "rig.yaml"
    rig.write_text(slow_rig.read_text().replace("encoder: absolute, ", ""))
    jog = ("jog", rig, "--by-mm", "0", "0", "1", "--no-scene", "--without-real-time", "--yes")

    def reference() -> dict[str, object]:
        return json.loads(call("status", rig, *bus, "--json").out)["reference"]  # type: ignore[no-any-return]

    with drives_on(channel, slow_run) as rehearsal:
        assert call("reset", rig, *bus, "--yes").code == 0
        stood = [round(drive.motor.position) for drive in rehearsal.drives]
        homed = as_in_the_file(_on(channel, rig))
        update = {"made": "2026-01-01T00:00:00+00:00", "stands_at": stood, "released": []}
        MotionInterlock(_on(channel, rig)).file.write(homed.model_copy(update=update))
        hold(rehearsal.drives)
        assert reference()["counts"] is True
        for drive in rehearsal.drives:
            drive.state = DriveState.SWITCH_ON_DISABLED
        assert "without torque now" in str(reference()["why_not"])
        refused = call(*jog, *bus, "-o", tmp_path / "jog")
        assert refused.code == 3, refused
        assert "cdpr home RIG" in refused.err.replace("\n", " ")
        assert {drive.state for drive in rehearsal.drives} == {DriveState.SWITCH_ON_DISABLED}
        assert call("reset", rig, *bus, "--yes").code == 0
        hold(rehearsal.drives)  # again, but the cables were slack meanwhile
        assert "without torque now" in str(reference()["why_not"])
