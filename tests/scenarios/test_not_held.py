"""Drives that release after the end of a run, and a bus that is lost by then."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import can
import pytest

from drivers.can_bus import BusSettings
from drivers.can_errors import BusGone
from drivers.cia402.pdo import NmtCommand
from drivers.cia402.state_machine import DriveState
from executor.control.path_runs import Outcome
from executor.interlock.fault_latch import FaultLatch
from executor.recording.run_folder import RunFolder
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import Fault, Refused
from model.rig import rig_from_document
from simulation.drives.cia402 import SimulatedDrive
from tests.cli.program import call
from tests.scenarios.stage import CRUISING, Stage, at, concluded, staged
from tests.scenarios.test_bus_faults import LOST_BY_CONTROLLER, PASSIVE, PROTOCOL_ERROR
from tests.scenarios.test_real_time import drives_on

FIFTH, SIXTH = 4, 5


def run_and_left_alone(stage: Stage) -> tuple[Outcome, set[DriveState]]:
    """With drives that take the end of heartbeats as a fault, and their states later."""
    for drive in stage.drives:
        drive.behaviour = replace(drive.behaviour, heartbeat_loss_is_fault=True)
    outcome = stage.run()
    stage.rehearsal.advance(0.5)
    stage.rehearsal.pump()
    return outcome, {drive.state for drive in stage.drives}


def fails_once_left(drive: SimulatedDrive) -> None:
    """It takes the end of SYNC as a fault, and is asked only then: nothing is seen in a cycle."""
    asked = drive.on_sdo

    def fails(data: bytes) -> None:
        reads_status = data[0] & 0xE0 == 0x40 and data[1:3] == b"\x41\x60"
        if reads_status and drive.state is DriveState.QUICK_STOP_ACTIVE:
            drive.fail(0x8130)
        asked(data)

    drive.on_sdo = fails  # type: ignore[method-assign, assignment]


@pytest.mark.slow
@pytest.mark.real_time
def test_a_drive_that_releases_after_a_run_is_latched_and_reported_with_exit_code_1(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    channel = f"239.74.163.41:{20000 + (os.getpid() * 31) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rest = ("--no-camera", "--yes", "--without-real-time")
    with drives_on(channel, slow_run) as rehearsal:
        fails_once_left(rehearsal.drives[SIXTH])
        answer = call("run", short_plan, "--rig", slow_rig, "-o", folder, *bus, *rest)
        states = [drive.state for drive in rehearsal.drives]
    assert answer.code == 1, answer
    assert "\nFAILED " in answer.out
    message = "cable 6 (drive 6) went from quick stop active to fault"
    assert message in answer.out
    assert states.count(DriveState.QUICK_STOP_ACTIVE) == 7, "the others hold"
    summary = RunFolder.open(folder).summary()
    assert (summary["verdict"], summary["final_state"]) == ("FAILED", "latched")
    (event,) = (each for each in summary["events"] if each["code"] == "not_held")
    assert message in event["text"]
    assert "held" not in [each["code"] for each in summary["events"]]
    with pytest.raises(Refused, match="went from quick stop active to fault"):
        FaultLatch(BusSettings("udp_multicast", channel)).require_disengaged()


def test_a_drive_that_releases_after_a_fault_is_reported_besides_its_cause(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    def fault(stage: Stage) -> None:
        PASSIVE(stage)
        fails_once_left(stage.drives[SIXTH])

    with staged(prepared, tmp_path / "run", at(CRUISING, fault)) as stage:
        outcome = stage.run()
        events = stage.events()
    assert outcome.state is State.LATCHED
    assert "error-passive" in outcome.cause, "what the stop was for remains the cause"
    assert not outcome.holding
    assert events[-1].code == "not_held"
    assert "cable 6 (drive 6) went from quick stop active to fault" in events[-1].text
    assert "cable 4" not in events[-1].text


def test_a_disturbed_bus_still_ends_in_order_so_that_no_drive_misses_its_master(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """After the first fault of the bus others follow, each a new one, in a bus that still works."""

    def fault(stage: Stage) -> None:
        if stage.cycle >= CRUISING:
            PROTOCOL_ERROR(stage)
        if stage.cycle == CRUISING:
            PASSIVE(stage)
        if stage.cycle == CRUISING + 14:
            LOST_BY_CONTROLLER(stage)

    with staged(prepared, tmp_path / "run", fault) as stage:
        outcome, states = run_and_left_alone(stage)
        codes = [event.code for event in stage.events()]
    assert "error-passive" in outcome.cause
    assert "bus_lost" not in codes
    assert states == {DriveState.QUICK_STOP_ACTIVE}


@pytest.mark.parametrize(
    ("held", "lets_go"),
    [
        (range(8), True),
        ((), False),
        ((SIXTH,), True),
        ((FIFTH, SIXTH), True),
        ((0, 1, FIFTH), False),
    ],
)
def test_a_drive_that_held_and_lets_go_while_all_are_enabled_is_no_longer_held(
    prepared: PreparedRun, tmp_path: Path, held: Sequence[int], lets_go: bool
) -> None:
    """All drives usually hold since the last run, but some may have been released."""

    def fault(stage: Stage) -> None:
        if stage.cycle == 1:
            stage.drives[SIXTH].fail(0x2310)

    with staged(prepared, tmp_path / "run", fault) as stage:
        for drive in held:
            stage.drives[drive].state = DriveState.QUICK_STOP_ACTIVE
        outcome = stage.run()
        codes = [event.code for event in stage.events()]
    assert "drive 6" in outcome.cause
    assert "enabled" not in codes
    assert outcome.holding is not lets_go


def test_a_drive_that_opened_its_brake_and_lets_go_while_others_still_enable_is_no_longer_held(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """After power-up the brakes held all cables; nothing held by torque before this motion."""
    failed: list[int] = []

    def fault(stage: Stage) -> None:
        sixth = stage.drives[SIXTH]
        enabled = [states[SIXTH] for states in stage.drive_states]
        if not failed and enabled.count(DriveState.OPERATION_ENABLED) == 2:  # has replied so
            failed.append(stage.cycle)
            sixth.fail(0x2310)

    with staged(prepared, tmp_path / "run", fault) as stage:
        last = stage.drives[-1]
        last.behaviour = replace(last.behaviour, enable_delay=0.4)
        outcome = stage.run()
        codes = [event.code for event in stage.events()]
    assert failed
    assert "drive 6" in outcome.cause
    assert "enabled" not in codes
    assert not outcome.holding


def test_a_second_drive_that_releases_after_a_fault_is_reported_although_the_first_does_not_hold(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    def fault(stage: Stage) -> None:
        stage.drives[FIFTH].fail(0x2310)
        fails_once_left(stage.drives[SIXTH])

    with staged(prepared, tmp_path / "run", at(CRUISING, fault)) as stage:
        outcome = stage.run()
        events = stage.events()
    assert "drive 5" in outcome.cause
    assert not outcome.holding
    assert events[-1].code == "not_held"
    assert "cable 6 (drive 6) went from quick stop active to fault" in events[-1].text
    assert "drive 5" not in events[-1].text


def test_a_drive_that_died_before_the_stop_is_not_reported_again_at_the_end(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    def fault(stage: Stage) -> None:
        stage.drives[FIFTH].silent = True

    with staged(prepared, tmp_path / "run", at(CRUISING, fault)) as stage:
        outcome = stage.run()
        events = stage.events()
    assert "drive 5" in outcome.cause
    assert "not_held" not in [event.code for event in events]


def loses_power(drive: SimulatedDrive) -> None:
    drive.silent = True
    drive._power_off(DriveState.SWITCH_ON_DISABLED)


def powerless(stage: Stage) -> None:
    loses_power(stage.drives[FIFTH])


def all_powerless(stage: Stage) -> None:
    for drive in stage.drives:
        loses_power(drive)


def unheard(stage: Stage) -> None:
    """They stop on their own and hold, but nothing shows it."""
    for drive in stage.drives:
        drive.silent = True


def adapter_gone(stage: Stage) -> None:
    """Nothing is read either, not even at the end."""

    def gone(*_: object) -> None:
        raise BusGone("the interface disappeared", "can0")

    stage.group.send_cycle = gone  # type: ignore[method-assign]


def with_brakes(prepared: PreparedRun) -> PreparedRun:
    document = prepared.rig.document
    winches = [winch.model_copy(update={"brake": True}) for winch in document.winches]
    rig = rig_from_document(document.model_copy(update={"winches": winches}))
    return prepare(prepared.plan, rig)


@pytest.mark.parametrize("happens", [powerless, all_powerless, unheard, adapter_gone])
def test_a_drive_without_a_brake_that_is_silent_to_the_end_counts_as_not_held(
    prepared: PreparedRun, tmp_path: Path, happens: Callable[[Stage], None]
) -> None:
    """Its cable may be off its pulley, which an absolute encoder does not show after power-up."""
    with staged(prepared, tmp_path / "run", at(CRUISING, happens)) as stage:
        outcome = stage.run()
    assert outcome.state is State.LATCHED
    assert not outcome.holding


@pytest.mark.parametrize("happens", [powerless, adapter_gone])
def test_the_brake_of_a_silent_drive_holds_its_cable(
    prepared: PreparedRun, tmp_path: Path, happens: Callable[[Stage], None]
) -> None:
    with staged(with_brakes(prepared), tmp_path / "run", at(CRUISING, happens)) as stage:
        outcome = stage.run()
    assert outcome.state is State.LATCHED
    assert outcome.holding


def test_a_drive_that_is_heard_again_at_the_end_has_held(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    def deaf_for_a_while(stage: Stage) -> None:
        stage.drives[FIFTH].silent = CRUISING <= stage.cycle < CRUISING + 5

    with staged(prepared, tmp_path / "run", deaf_for_a_while) as stage:
        outcome = stage.run()
    assert "drive 5" in outcome.cause
    assert outcome.holding


def test_a_drive_that_is_silent_before_it_was_enabled_has_released_nothing(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    def silent_at_once(stage: Stage) -> None:
        stage.drives[FIFTH].silent = True

    with staged(prepared, tmp_path / "run", at(0, silent_at_once)) as stage:
        outcome = stage.run()
    assert "drive 5" in outcome.cause
    assert outcome.holding


@pytest.mark.parametrize("later", [1, 20, 60, 75])
def test_a_cycle_without_replies_does_not_cut_the_end_short(
    prepared: PreparedRun, tmp_path: Path, later: int
) -> None:
    """SYNC and heartbeat ceased while drives still watched them; some let go for that."""
    ending: list[int] = []

    def deaf_once(stage: Stage) -> None:
        if stage.group.ending:
            ending.append(stage.cycle)
        for drive in stage.drives:
            drive.silent = len(ending) == later

    with staged(prepared, tmp_path / "run", deaf_once) as stage:
        outcome, states = run_and_left_alone(stage)
    assert len(ending) > later, "the end went on"
    assert outcome.state is State.FINISHED, outcome.cause
    assert states == {DriveState.QUICK_STOP_ACTIVE}


def falls_back(stage: Stage) -> None:
    """To NMT pre-operational: its set-points have no effect any more, requests do."""
    stage.drives[FIFTH].on_nmt(NmtCommand.PRE_OPERATIONAL, FIFTH + 1)


def test_a_drive_that_left_nmt_operational_is_not_left_enabled_and_unmonitored(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", at(CRUISING, falls_back)) as stage:
        outcome = stage.run()
        events = stage.events()
        states = {drive.state for drive in stage.drives}
    assert outcome.state is State.LATCHED
    assert "cable 5 (drive 5) left the NMT state operational" in outcome.cause
    assert states == {DriveState.QUICK_STOP_ACTIVE}
    assert outcome.holding
    assert "not_held" not in [event.code for event in events], "it holds"


@pytest.mark.parametrize("also_dead", [False, True])
def test_a_drive_that_nothing_stops_is_reported_as_still_enabled(
    prepared: PreparedRun, tmp_path: Path, also_dead: bool
) -> None:
    def fault(stage: Stage) -> None:
        falls_back(stage)
        stuck = stage.drives[FIFTH]
        stuck._take_control_word = lambda _word: None  # type: ignore[method-assign]
        stuck._connection_lost = lambda _code: None  # type: ignore[method-assign]
        stage.drives[SIXTH].silent = also_dead

    with staged(prepared, tmp_path / "run", at(CRUISING, fault)) as stage:
        outcome = stage.run()
        events = stage.events()
        assert stage.drives[FIFTH].state is DriveState.OPERATION_ENABLED
    assert outcome.state is State.LATCHED
    (event,) = (each for each in events if each.code == "not_held")
    assert "still enabled: cable 5 (drive 5)" in event.text
    assert "drive 4" not in event.text
    assert ("drive 6" in outcome.cause) is also_dead


def welded(stage: Stage) -> None:
    """Drive 5 fails; drive 6 takes no stop, by whichever path."""
    if stage.cycle == CRUISING:
        stage.drives[FIFTH].fail(0x2310)
        stuck = stage.drives[SIXTH]
        stuck._take_control_word = lambda _word: None  # type: ignore[method-assign]
        stuck._connection_lost = lambda _code: None  # type: ignore[method-assign]


def also_fails(stage: Stage) -> None:
    if stage.cycle in (CRUISING, CRUISING + 3):
        stage.drives[FIFTH if stage.cycle == CRUISING else SIXTH].fail(0x2310)


def both_fail(stage: Stage) -> None:
    if stage.cycle == CRUISING:
        stage.drives[FIFTH].fail(0x2310)
        stage.drives[SIXTH].fail(0x3210)


def also_dies(stage: Stage) -> None:
    if stage.cycle == CRUISING:
        stage.drives[FIFTH].fail(0x2310)
    if stage.cycle == CRUISING + 3:
        loses_power(stage.drives[SIXTH])


@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (welded, "drives still enabled: cable 6 (drive 6)"),
        (also_fails, "cable 6 (drive 6)"),
        (both_fail, "cable 6 (drive 6)"),
        (also_dies, "cable 6 (drive 6) does not answer"),
    ],
)
def test_a_second_drive_that_does_not_hold_is_named_with_what_to_do(
    prepared: PreparedRun, tmp_path: Path, happens: Callable[[Stage], None], words: str
) -> None:
    """The first cause alone says "quick stop of all drives": not true of this one."""
    with staged(prepared, tmp_path / "run", happens) as stage:
        outcome = stage.run()
        summary = concluded(stage, outcome)
    assert outcome.cause.startswith("cable 5 (drive 5)")
    assert words in outcome.cause.partition("quick stop of all drives")[2], "the latch keeps it"
    first, *others = summary["reasons"]
    assert words not in first, "each is stated once"
    (second,) = (reason for reason in others if words in reason)
    assert second.endswith("Support the platform and press the emergency stop.")
    (check,) = (check for check in summary["checks"] if check["name"] == "held")
    assert check["text"] == second


def both_stop_alone(stage: Stage) -> None:
    if stage.cycle == CRUISING:
        for drive in (FIFTH, SIXTH):
            stage.drives[drive]._connection_lost(0x8130)


def test_drives_that_stopped_on_their_own_and_hold_are_no_reason_for_an_emergency_stop(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", both_stop_alone) as stage:
        outcome = stage.run()
        summary = concluded(stage, outcome)
        codes = [event.code for event in stage.events()]
    assert codes.count("drive_fault") == 2
    assert "held" not in [check["name"] for check in summary["checks"]]
    assert "drive 6" not in outcome.cause


def jams_and_dies(stage: Stage) -> None:
    if stage.cycle == CRUISING:
        stage.drives[FIFTH].motor.jammed = True
    if stage.recorder is not None and stage.recorder.state is State.LATCHED:
        stage.drives[FIFTH].silent = True


def test_a_drive_that_dies_in_the_stop_is_named_although_it_caused_the_stop(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with staged(prepared, tmp_path / "run", jams_and_dies) as stage:
        outcome = stage.run()
        summary = concluded(stage, outcome)
    assert outcome.cause.startswith("cable 5 (drive 5) did not move")
    (check,) = (check for check in summary["checks"] if check["name"] == "held")
    assert "cable 5 (drive 5) does not answer" in check["text"]


THREE_LINES = Fault("frames cannot be sent", where="can0", why="it is down", next_step="set it up")
OF_THE_LIBRARY = can.CanOperationError("Network is down [Error Code 100]")


@pytest.mark.parametrize("error", [THREE_LINES, OF_THE_LIBRARY])
def test_a_bus_that_is_gone_after_the_stop_is_reported_in_one_line(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def gone(*_: object) -> None:
        raise error

    def fault(stage: Stage) -> None:
        if stage.cycle == CRUISING:
            stage.drives[FIFTH].fail(0x2310)
        if stage.cycle == CRUISING + 5:
            monkeypatch.setattr(stage.group, "receive", gone)

    with staged(prepared, tmp_path / "run", fault) as stage:
        outcome = stage.run()
        events = stage.events()
    assert outcome.state is State.LATCHED
    assert "drive 5" in outcome.cause
    assert events[-1].code == "bus_lost"
    assert "\n" not in events[-1].text
    said = error.what if isinstance(error, Fault) else str(error)
    assert said in events[-1].text
    assert events[-1].text.endswith("the drives stop on loss of the master")
    assert "stop_not_sent" not in [event.code for event in events]
