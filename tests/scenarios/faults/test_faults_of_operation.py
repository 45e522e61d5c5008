"""F2, F3, F10, F20–F23, F25, F26: stops, restarts, and events on people's and computers' side."""

from __future__ import annotations

import errno
import json
import os
import random
import time
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.can_bus import BusSettings
from drivers.cia402.state_machine import DriveState
from drivers.factory import make_drive_group
from executor.recording.run_folder import RunEvent, RunFolder
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from model.errors import BadInput, Refused
from tests.scenarios.faults.bench import (
    Bench,
    LiveBench,
    Script,
    SimulatedBench,
    a_message,
    live,
    once,
    simulated,
)
from tests.scenarios.faults.cases import ATTEMPTS, TABLE
from tests.scenarios.faults.masters import Masters
from tests.scenarios.stage import Stage

HOLDING = DriveState.QUICK_STOP_ACTIVE
T = 0.010


def run_again(bench: SimulatedBench, path: Path, script: Script) -> Stage:
    """A new executor for the same drives, ready to run; the line is restored."""
    bench.line.incoming.clear()
    near = bench.stage.group._bus  # type: ignore[attr-defined]
    group = make_drive_group(bench.prepared.rig, near, bench.rehearsal.pump)
    group.configure()
    return Stage(
        bench.prepared, bench.rehearsal, group, RunFolder.create(path), lambda _stage: script(bench)
    )


def per_metre(bench: Bench) -> np.ndarray:
    return np.abs([w.counts_per_metre for w in bench.prepared.rig.winches])


def positions(bench: Bench) -> list[float]:
    return [drive.motor.position for drive in bench.drives]


@pytest.mark.slow
@pytest.mark.real_time
def test_f2_a_suspended_master_that_continues_enables_nothing(
    calm_run: PreparedRun, tmp_path: Path, masters: Masters, between_processes: BusSettings
) -> None:
    """Real SIGSTOP; SIGCONT after the drives have stopped on their own."""
    cycle = calm_run.checked.table.cycle

    def script(bench: Bench) -> None:
        assert isinstance(bench, LiveBench)
        if bench.cycle >= bench.fault_cycle and bench.since is None:
            bench.suspend()

    for attempt in range(ATTEMPTS):
        run = tmp_path / f"run {attempt}"
        with live(calm_run, run, script, between_processes, masters) as bench:
            bench.resumes_after = 10.0 * cycle
            ended = bench.run()
            if bench.since is None:  # this computer was too busy to get so far
                continue
            stop = bench.stop()
            assert ended is State.LATCHED
            assert stop.time <= 5.0 * cycle
            assert stop.spread <= cycle
            assert bench.violations() == []
            assert {drive.state for drive in bench.drives} == {HOLDING}
            return
    pytest.fail("this computer held the simulated drives up each time")


def test_f3_a_restart_begins_where_the_drives_are_and_moves_nothing(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with simulated(prepared, tmp_path / "run", once(SimulatedBench.kill)) as bench:
        bench.fault_cycle = 20
        assert bench.run() is None
        stood, seen = positions(bench), len(bench.rehearsal.samples)
        again = run_again(bench, tmp_path / "again", lambda _bench: None)
        if np.max(np.abs(np.array(stood) - prepared.checked.table.setpoints[0])) < 50:
            again.run()  # so near the start that it is allowed
        targets = [s.targets for s in bench.rehearsal.samples[seen:] if DriveState.OPERATION_ENABLED
                   in s.states][:1]  # fmt: skip
        assert np.abs(np.array(targets) - stood).max() <= 1.0


def test_f3_far_from_the_start_a_restart_is_refused(prepared: PreparedRun, tmp_path: Path) -> None:
    with simulated(prepared, tmp_path / "run", once(SimulatedBench.kill)) as bench:
        assert bench.run() is None
        stood = positions(bench)
        with pytest.raises(Refused, match="not at the start of the plan"):
            run_again(bench, tmp_path / "again", lambda _bench: None).run()
        bench.pass_time(0.2)
        assert positions(bench) == stood
        assert {drive.state for drive in bench.drives} == {HOLDING}


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOBUFS, "No buffer space"),
        (errno.ENETDOWN, "down"),
        (errno.ENODEV, "No such device"),
    ],
)
def test_f10_an_adapter_that_takes_no_frame(
    prepared: PreparedRun, tmp_path: Path, number: int, words: str
) -> None:
    def fails(bench: SimulatedBench) -> None:
        def send(*_: object, **__: object) -> None:
            raise can.CanOperationError(f"Failed to transmit: {os.strerror(number)}", number)

        bench.happens()
        bench.stage.group._bus.send = send  # type: ignore[attr-defined]

    with simulated(prepared, tmp_path / "run", once(fails)) as bench:
        assert bench.run() is State.LATCHED
        assert words.lower() in bench.cause.lower()
        assert bench.stop().time <= 5 * T
        assert bench.violations() == []


def busy(bench: Bench) -> None:
    """With what other devices send, nine tenths of the bus are full; beyond, replies get lost."""
    for _ in range(48):
        bench.line.send(a_message(0x700, bytes(8)))


@pytest.mark.parametrize("cycle", [12, 30, 150, 300])
def test_f20_a_stop_reaches_all_in_two_cycles_on_a_bus_full_of_others(
    prepared: PreparedRun, tmp_path: Path, cycle: int
) -> None:
    def script(bench: Bench) -> None:
        busy(bench)
        if bench.cycle == bench.fault_cycle:
            bench.happens()
            bench.ask_stop()

    with simulated(prepared, tmp_path / "run", script, bitrate=1e6) as bench:
        bench.fault_cycle = cycle
        assert bench.run() is State.STOPPED, bench.cause
        assert bench.violations() == []
        (outcome,) = [event for event in bench.events() if event.code == "stop"]
        begun = bench.events()[0].time_s
        assert outcome.time_s >= begun


def test_f20_a_stop_beside_a_dead_drive_waits_for_nothing(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    def both(bench: Bench) -> None:
        bench.breaks(3)
        bench.drives[3].silent = True
        bench.ask_stop()

    with simulated(prepared, tmp_path / "run", once(both)) as bench:
        assert bench.run() is State.LATCHED
        assert bench.stop().time <= 4 * T
        assert bench.violations() == []


def test_f21_drives_that_come_back_do_not_move(prepared: PreparedRun, tmp_path: Path) -> None:
    def vanish(bench: Bench) -> None:
        bench.breaks(*range(8))
        for drive in bench.drives:
            drive.silent = True

    with simulated(prepared, tmp_path / "run", once(vanish)) as bench:
        assert bench.run() is State.LATCHED
        stood = positions(bench)
        for drive in bench.drives:
            drive.silent = False
            drive.power_on()
        bench.rehearsal.pump()
        bench.pass_time(0.3)
        assert positions(bench) == stood
        assert DriveState.OPERATION_ENABLED not in {drive.state for drive in bench.drives}


def test_f21_a_journal_that_was_cut_anywhere_is_read_up_to_there(tmp_path: Path) -> None:
    """Power loss: complete lines count, a truncated last line is left out."""
    folder = RunFolder.create(tmp_path / "run")
    for k, code in enumerate(("enabled", "moving", "stop")):
        folder.append_event(RunEvent(0.1 * k, code, "größer als 2 mm"))
    whole = (folder.path / "events.jsonl").read_bytes()
    ends = [k + 1 for k, byte in enumerate(whole) if byte == ord("\n")]
    for cut in range(len(whole) + 1):
        (folder.path / "events.jsonl").write_bytes(whole[:cut])
        assert len(folder.events()) == sum(end <= cut for end in ends)


def test_f21_a_run_that_was_cut_off_declares_its_pose_lost(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with simulated(prepared, tmp_path / "run", once(SimulatedBench.kill)) as bench:
        bench.run()
    with pytest.raises(BadInput) as caught:
        RunFolder.open(tmp_path / "run")
    assert "missing" in str(caught.value)


def test_f22_after_a_winch_was_moved_by_hand_nothing_drives_back(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    with simulated(prepared, tmp_path / "run", once(lambda b: b.ask_stop())) as bench:
        bench.fault_cycle = 12
        assert bench.run() is State.STOPPED
        drive = bench.drives[2]
        drive._power_off(DriveState.SWITCH_ON_DISABLED)
        drive.motor.position += 0.003 * per_metre(bench)[2]
        drive.motor.release()
        stood = positions(bench)
        with pytest.raises(Refused, match="cable 3 is"):
            run_again(bench, tmp_path / "again", lambda _bench: None).run()
        bench.pass_time(0.2)
        assert positions(bench) == stood


def test_f23_a_step_of_the_clock_changes_nothing(
    prepared: PreparedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, dice = time.time, random.Random(1)
    wall = [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + wall[0])

    def steps(_bench: Bench) -> None:
        wall[0] = dice.choice((-3600.0, 0.0, 3600.0))

    seen = []
    for name, script in (("still", lambda _bench: None), ("stepping", steps)):
        with simulated(prepared, tmp_path / name, script) as bench:
            assert bench.run() is State.FINISHED
            seen.append((bench.rehearsal.samples, bench.events()))
    assert seen[0] == seen[1]


@pytest.mark.slow
@pytest.mark.real_time
def test_f25_a_master_that_is_requested_to_end_stops_along_the_path(
    calm_run: PreparedRun, tmp_path: Path, masters: Masters, between_processes: BusSettings
) -> None:
    for attempt in range(ATTEMPTS):
        run = tmp_path / f"run {attempt}"
        with live(calm_run, run, once(lambda b: b.ask_stop()), between_processes, masters) as bench:
            if bench.run() is not State.STOPPED:
                continue
            assert bench.violations() == []
            assert bench.codes()[-2:] == ["stop", "held"]
            outcome = json.loads((run / "outcome.json").read_text())
            assert "stop requested" in outcome["cause"]
            return
    pytest.fail("this computer held the simulated drives up each time")


@pytest.mark.parametrize(
    "broken", [ZeroDivisionError("a defect"), OSError(errno.ENOSPC, "No space left on device")]
)
def test_f25_a_recorder_that_fails_is_a_stop_along_the_path(
    prepared: PreparedRun, tmp_path: Path, broken: Exception
) -> None:
    def progress(_row: float) -> None:
        if bench.cycle >= bench.fault_cycle:
            bench.happens()
            raise broken

    with simulated(prepared, tmp_path / "run", lambda _bench: None) as bench:
        outcome = bench.stage.run(progress=progress)
        bench.pass_time(0.1)
        assert outcome.state is State.LATCHED
        assert str(broken) in outcome.cause
        assert bench.violations() == []
        assert {drive.state for drive in bench.drives} == {HOLDING}


def test_f26_after_an_emergency_stop_nothing_is_commanded_and_the_pose_is_asked_again(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    """Without torque the platform sank by 4 mm of cable before the brakes held."""
    fault = TABLE["F26 emergency stop"]
    with simulated(prepared, tmp_path / "run", fault.script()) as bench:
        assert bench.run() is State.LATCHED
        enabling = [w for at, _, w in bench.rehearsal.words if at > (bench.since or 0.0) + 3 * T]
        assert 0x0F not in [word & 0x0F for word in enabling]
        for drive, scale in zip(bench.drives, per_metre(bench), strict=True):
            drive.motor.position += 0.004 * scale
            drive.motor.release()
        stood = positions(bench)
        with pytest.raises(Refused, match="not at the start of the plan"):
            run_again(bench, tmp_path / "again", lambda _bench: None).run()
        assert positions(bench) == stood
