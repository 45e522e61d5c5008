"""The fault latch: a run that ended badly, or not at all, prevents motion until a reset."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from pathlib import Path

import can
import pytest

from cdpr.cli.options import rig_on_bus
from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.pdo import NmtState
from drivers.cia402.state_machine import DriveState
from executor import service
from executor.doctor import examine
from executor.drives import read_snapshot, resting_drives_of
from executor.interlock.fault_latch import FaultLatch
from executor.remote.client import ask_all
from executor.remote.command_socket import find_runs
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from model.errors import Refused
from model.progress import Listener
from model.rig import load_rig, rig_from_document
from model.scene import empty_scene
from tests.cli.plans import RIG
from tests.cli.program import call
from tests.drivers.drive_bench import free_udp_channel
from tests.scenarios.test_real_time import (
    drives_on,
    moving_over_udp,
    wait_until_all_hold,
    wait_until_gone,
)
from tests.scenarios.test_real_time import real_time_process as process_of

BUS = BusSettings("socketcan", "can0")


def wait_until_beyond(path_mm: float, run: Path) -> None:
    """Waits until the run has progressed this far along its path; fails with why it ended."""
    while True:
        with find_runs() as runs:
            answers = ask_all(runs, "status")
        assert answers, (run / "events.jsonl").read_text()
        (answer,) = answers
        assert answer.status is not None
        if (answer.status["path_mm"] or 0.0) > path_mm:
            return
        signal.sigtimedwait([], 0.01)


def test_a_run_engages_it_and_only_a_good_end_disengages_it(tmp_path: Path) -> None:
    latch = FaultLatch(BUS)
    latch.require_disengaged()
    for state in (State.FINISHED, State.STOPPED):
        latch.engage("rig", tmp_path)
        assert FaultLatch(BUS).read() is not None
        latch.settle("rig", state, "", tmp_path)
        latch.require_disengaged()
    latch.engage("rig", tmp_path)
    latch.settle("rig", State.LATCHED, "cable 6 is slack", tmp_path)
    with pytest.raises(Refused, match="cable 6 is slack") as caught:
        FaultLatch(BUS).require_disengaged()
    step = caught.value.next_step
    assert step.index("`cdpr status RIG`") < step.index("`cdpr reset RIG`")
    with pytest.raises(Refused, match="cable 6 is slack"):
        FaultLatch(BUS).engage("rig", tmp_path)
    FaultLatch(BUS).disengage()
    latch.require_disengaged()


def test_a_run_that_never_came_to_its_end_is_a_fault(tmp_path: Path) -> None:
    FaultLatch(BUS).engage("rig", tmp_path)
    with pytest.raises(Refused, match="did not finish"):
        FaultLatch(BUS).require_disengaged()


def test_a_run_active_is_distinguished_from_a_fault(tmp_path: Path) -> None:
    """To every user of the folder, who may not reach the other's run; and only until it ends."""
    running = FaultLatch(BUS)
    running.engage("rig", tmp_path)
    for ask in (FaultLatch(BUS).require_disengaged, FaultLatch(BUS).require_no_run):
        with pytest.raises(Refused, match=f"process {os.getpid()}.*in progress"):
            ask()
    running.settle("rig", State.LATCHED, "cable 6 is slack", tmp_path)
    FaultLatch(BUS).require_no_run()
    with pytest.raises(Refused, match="cable 6 is slack"):
        FaultLatch(BUS).require_disengaged()


def test_no_reader_sees_a_latch_that_does_not_say_its_cause_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, hold = [], FaultLatch._hold

    def looked_at(latch: FaultLatch) -> None:
        hold(latch)
        seen.append(FaultLatch(BUS).read())

    monkeypatch.setattr(FaultLatch, "_hold", looked_at)
    FaultLatch(BUS).engage("rig", tmp_path)
    assert seen == [None]


def test_of_two_that_begin_at_once_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("executor.interlock.fault_latch.LOCK_TIMEOUT", 0.05)
    first = FaultLatch(BUS)
    first.path.parent.mkdir(parents=True)
    first._hold()  # it is about to write why
    with pytest.raises(Refused, match="in progress"):
        FaultLatch(BUS).engage("rig", tmp_path)
    assert first.read() is None
    first.engage("rig", tmp_path)


def test_a_program_that_was_killed_runs_no_more(tmp_path: Path) -> None:
    killed = multiprocessing.get_context("spawn").Process(
        target=_engaged_and_killed, args=(tmp_path,)
    )
    killed.start()
    killed.join()
    assert killed.exitcode == -signal.SIGKILL
    FaultLatch(BUS).require_no_run()
    with pytest.raises(Refused, match="did not finish"):
        FaultLatch(BUS).require_disengaged()


def _engaged_and_killed(folder: Path) -> None:
    latch = FaultLatch(BUS)
    latch.engage("rig", folder)
    os.kill(os.getpid(), signal.SIGKILL)


def test_each_bus_has_its_own(tmp_path: Path) -> None:
    FaultLatch(BUS).engage("rig", tmp_path)
    FaultLatch(BusSettings("socketcan", "can1")).require_disengaged()


def test_all_users_share_it_where_an_administrator_made_a_folder_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    monkeypatch.setattr("executor.interlock.locks.SHARED", shared)
    FaultLatch(BUS).engage("rig", tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another user"))
    with pytest.raises(Refused, match="did not finish"):
        FaultLatch(BUS).require_disengaged()
    assert FaultLatch(BUS).path.parent == shared


def test_a_reset_keeps_runs_off_the_bus_and_leaves_it_as_it_was_when_it_fails(
    tmp_path: Path,
) -> None:
    latch = FaultLatch(BUS)
    with pytest.raises(Refused, match=r"reset .*in progress"), latch.held_for_reset("rig", None):
        FaultLatch(BUS).engage("rig", tmp_path)
    latch.require_disengaged()
    latch.engage("rig", tmp_path, "cable 3 is slack")
    shown = latch.read()
    with pytest.raises(KeyError), latch.held_for_reset("rig", shown):
        raise KeyError
    assert latch.read() == shown
    with latch.held_for_reset("rig", shown):
        pass
    latch.require_disengaged()
    with pytest.raises(Refused, match="changed since"), latch.held_for_reset("rig", shown):
        pytest.fail("somebody else disengaged it: the operator said yes to something else")


@pytest.mark.parametrize("content", ["", "{", "[]", '{"bus": 1}', "\x00"])
def test_a_latch_file_that_cannot_be_read_counts_as_engaged(tmp_path: Path, content: str) -> None:
    latch = FaultLatch(BUS)
    latch.engage("rig", tmp_path)
    latch.path.write_text(content)
    with pytest.raises(Refused, match="cannot be read"):
        latch.require_disengaged()


def test_without_a_folder_for_the_latch_nothing_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with pytest.raises(Refused, match="latch cannot be"):
        FaultLatch(BUS).engage("rig", tmp_path)


def test_a_latched_bus_is_refused_by_the_program(short_plan: Path, tmp_path: Path) -> None:
    channel = free_udp_channel()
    bus = ("--interface", "udp_multicast", "--channel", channel)
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    run = tmp_path / "run"
    answer = call("run", short_plan, "--rig", RIG, "-o", run, *bus, "--no-camera", "--yes")
    assert answer.code == 3
    assert "a fault is latched" in answer.err
    assert not run.exists()


def test_reset_asks_and_a_no_leaves_it_engaged(tmp_path: Path) -> None:
    channel = free_udp_channel()
    bus = ("--interface", "udp_multicast", "--channel", channel)
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    latch = FaultLatch(BusSettings("udp_multicast", channel))
    for answers, code in (("n\n", 130), ("", 2)):
        assert call("reset", RIG, *bus, answers=answers).code == code
        assert latch.read() is not None
    assert call("reset", RIG, "--interface", "virtual").code == 2


def test_reset_of_drives_that_do_not_answer_leaves_it_engaged(tmp_path: Path) -> None:
    channel = free_udp_channel()
    bus = ("--interface", "udp_multicast", "--channel", channel)
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    latch = FaultLatch(BusSettings("udp_multicast", channel))
    assert call("reset", RIG, *bus, "--yes").code == 4
    assert latch.read() is not None


@pytest.mark.slow
@pytest.mark.real_time
def test_reset_brings_a_drive_out_of_its_fault_and_moves_nothing(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.23:{20000 + (os.getpid() * 11) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    latch = FaultLatch(BusSettings("udp_multicast", channel))
    with drives_on(channel, slow_run) as rehearsal:
        stood = [drive.motor.position for drive in rehearsal.drives]
        rehearsal.drives[2].fail(0x2310)
        assert rehearsal.drives[2].state is DriveState.FAULT
        answer = call("reset", slow_rig, *bus, "--yes", "--json")
        assert answer.code == 0, answer
        result = json.loads(answer.out)
        assert result["was_latched"] is True
        assert "fault" not in result["drives"]
        assert DriveState.FAULT not in {drive.state for drive in rehearsal.drives}
        assert [drive.motor.position for drive in rehearsal.drives] == stood
    latch.require_disengaged()


class Raising(Listener):
    def remark(self, text: str) -> None:
        raise RuntimeError(text)


@pytest.mark.slow
@pytest.mark.real_time
def test_reset_and_status_name_the_drive_whose_safe_torque_off_is_still_active(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    """The latch was cleared with "drives: switch on disabled", and nothing said what to do."""
    channel = f"239.74.163.23:{20000 + (os.getpid() * 19) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    with drives_on(channel, slow_run) as rehearsal:
        drive = rehearsal.drives[3]
        drive.objects.measured(0x6041, 0, lambda: drive.status_word & ~0x10)
        status = call("status", slow_rig, *bus)
        assert status.code == 0, status
        summary, line = [line for line in status.out.splitlines() if "STO" in line]
        assert "drive 4 switch on disabled: " in summary
        assert "(drive 4)" in line
        assert "remove the cause shown for drive 4" in status.out.replace("\n", " ")
        with pytest.raises(RuntimeError, match="STO"):  # the reset is done by then
            service.reset(load_rig(slow_rig).with_bus("udp_multicast", channel), listener=Raising())
        FaultLatch(BusSettings("udp_multicast", channel)).require_disengaged()
        answer = call("reset", slow_rig, *bus, "--yes")
        assert answer.code == 0, answer
    (said,) = [line for line in answer.err.splitlines() if "STO" in line]
    assert "cable 4 (drive 4): its bit 4 (voltage enabled) is 0" in said
    assert said.endswith("correct this before a motion")


@pytest.mark.slow
@pytest.mark.real_time
def test_a_drive_that_falls_silent_while_it_is_reset_leaves_the_latch_engaged(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.23:{20000 + (os.getpid() * 17) % 20000}"
    FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
    latch = FaultLatch(BusSettings("udp_multicast", channel))
    with drives_on(channel, slow_run) as rehearsal:
        answered = rehearsal.drives[4].on_sync

        def falls_silent() -> None:
            answered()
            rehearsal.drives[4].silent = rehearsal.cycles > 10

        rehearsal.drives[4].on_sync = falls_silent  # type: ignore[method-assign]
        bus = ("--interface", "udp_multicast", "--channel", channel)
        answer = call("reset", slow_rig, *bus, "--yes")
    assert answer.code == 4, answer
    assert "(drive 5) stopped answering" in answer.err
    assert latch.read() is not None


@pytest.mark.slow
@pytest.mark.real_time
def test_reset_takes_a_drive_in_nmt_stopped_back(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    """It answers nothing, but its heartbeat names the state; only a reset changes it."""
    profile = tmp_path / "lab.yaml"  # a shorter time-out of silent drives
    profile.write_text("name: Ours\nsources: [a test]\nsdo_timeout_ms: 600\n")
    channel = f"239.74.163.35:{20000 + (os.getpid() * 17) % 20000}"
    document = rig_on_bus(slow_rig, "udp_multicast", channel).document
    drives = document.drives.model_copy(update={"profile": str(profile)})
    document = document.model_copy(update={"drives": drives})
    rig = rig_from_document(document)
    with drives_on(channel, slow_run) as rehearsal:
        with resting_drives_of(document, to_reset=True):
            pass  # from now on the drives send heartbeats
        with open_bus(BusSettings.of(rig)) as bus:
            bus.send(can.Message(arbitration_id=0, data=(0x02, 5), is_extended_id=False))
            while rehearsal.drives[4].nmt is not NmtState.STOPPED:
                signal.sigtimedwait([], 0.01)
        found = examine(rig)
        assert (found.silent, found.stopped) == ((5,), (5,))
        with pytest.raises(Refused, match="drive 5: in the NMT state 'stopped'") as caught:
            read_snapshot(rig, rig.home, empty_scene(rig).load)
        assert "`cdpr reset RIG`" in caught.value.next_step
        assert rehearsal.drives[4].nmt is NmtState.STOPPED
        with resting_drives_of(document, to_reset=True) as ready:
            assert ready.restarted == ()
            assert rehearsal.drives[4].nmt is NmtState.OPERATIONAL


@pytest.mark.slow
@pytest.mark.real_time
def test_after_a_crash_nothing_moves_until_reset_and_then_only_from_where_it_is(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    with moving_over_udp(slow_run, slow_rig, short_plan, tmp_path / "run", 5) as (
        process,
        rehearsal,
    ):
        arguments = list(map(str, process.args))  # type: ignore[union-attr, arg-type]
        channel = arguments[arguments.index("--channel") + 1]
        child = process_of(process.pid)
        wait_until_beyond(10.0, tmp_path / "run")
        process.kill()
        process.wait()
        wait_until_gone(child)
        wait_until_all_hold(rehearsal)
        stood = [drive.motor.position for drive in rehearsal.drives]
        bus = ("--interface", "udp_multicast", "--channel", channel)
        rest = ("--no-camera", "--yes", "--without-real-time")
        again = call("run", short_plan, "--rig", slow_rig, "-o", tmp_path / "again", *bus, *rest)
        assert again.code == 3
        assert "did not finish" in again.err
        answer = call("reset", slow_rig, *bus, "--yes")
        assert answer.code == 0, answer
        assert "did not finish" in answer.out
        assert {drive.state for drive in rehearsal.drives} == {DriveState.QUICK_STOP_ACTIVE}
        again = call("run", short_plan, "--rig", slow_rig, "-o", tmp_path / "again", *bus, *rest)
        assert again.code == 3
        assert "not at the start of the plan" in again.err
        assert [drive.motor.position for drive in rehearsal.drives] == stood
        assert not (tmp_path / "again").exists()
