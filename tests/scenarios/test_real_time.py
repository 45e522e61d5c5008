"""The real-time process and its supervisor: if either dies or hangs, the platform stops."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from shutil import which
from typing import Any, TypeVar

import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.error_codes import emergency_text
from drivers.cia402.state_machine import DriveState
from executor.interlock.fault_latch import FaultLatch
from executor.recording.run_folder import RunFolder
from executor.trajectory.setpoints import PreparedRun
from model.rig import rig_from_document
from simulation.drives.cia402 import SYNC_OVERDUE
from simulation.drives.cia402_rig import SimulatedCia402Rig
from simulation.ground_truth import PowerLoss
from tests.scenarios.test_processes import ROOT, finished, program, send, waited_for

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

AWAY_S = 20.0
SIXTH = 5

Drives = TypeVar("Drives", bound=SimulatedCia402Rig)


def real_time_process(supervisor: int) -> int:
    """The child of a run that moves the drives."""
    for listing in Path(f"/proc/{supervisor}/task").glob("*/children"):
        for child in listing.read_text().split():
            command = Path(f"/proc/{child}/cmdline").read_text()
            if "spawn_main" in command:
                return int(child)
    raise AssertionError("the run has no real-time process")


def gone(process: int) -> bool:
    """Whether it ended, also before it was waited for."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return True
    return state == "Z"


def wait_until_gone(process: int) -> None:
    for _ in range(round(AWAY_S / 0.01)):
        if gone(process):
            return
        signal.sigtimedwait([], 0.01)
    raise AssertionError(f"process {process} goes on")


@contextmanager
def drives_on(
    channel: str,
    prepared: PreparedRun,
    kind: type[Drives] = SimulatedCia402Rig,  # type: ignore[assignment]
    interface: str = "udp_multicast",
) -> Iterator[Drives]:
    """Simulated drives on a bus between processes, in a thread of this one."""
    bus_document = prepared.rig.document.bus.model_copy(
        update={"interface": interface, "channel": channel}
    )
    rig = rig_from_document(prepared.rig.document.model_copy(update={"bus": bus_document}))
    over = threading.Event()
    with open_bus(BusSettings.of(rig)) as bus:
        rehearsal = kind(rig, bus, prepared.scene.start, prepared.scene.load)
        thread = threading.Thread(target=_serve, args=(rehearsal, over))
        thread.start()
        try:
            yield rehearsal
        finally:
            over.set()
            thread.join()


def _serve(rehearsal: SimulatedCia402Rig, over: threading.Event) -> None:
    """Answers in time even on a busy host, if the host allows it, like a real drive."""
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))  # of this thread alone
    rehearsal.serve(over.is_set)


@contextmanager
def moving_over_udp(
    slow_run: PreparedRun, slow_rig: Path, plan: Path, run: Path, number: int
) -> Iterator[tuple[subprocess.Popen[str], SimulatedCia402Rig]]:
    """An active run whose drives are in this process."""
    channel = f"239.74.163.22:{20000 + (os.getpid() * 7 + number) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rest = ("-o", run, *bus, "--no-camera", "--yes", "--without-real-time")
    with (
        drives_on(channel, slow_run) as rehearsal,
        program("run", plan, "--rig", slow_rig, *rest) as process,
    ):
        waited_for(run / "events.jsonl", "moving", process)
        yield process, rehearsal


def wait_until_all_hold(rehearsal: SimulatedCia402Rig) -> None:
    """Drives that hear no more from their master stop when their own time-out is over."""
    for _ in range(round(AWAY_S / 0.01)):
        states = {drive.state for drive in rehearsal.drives}
        if states == {DriveState.QUICK_STOP_ACTIVE}:
            return
        signal.sigtimedwait([], 0.01)
    raise AssertionError(f"not all drives hold: {states}")


def test_the_death_of_the_supervisor_ends_in_a_stop_by_the_real_time_process(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    with moving_over_udp(slow_run, slow_rig, short_plan, tmp_path / "run", 1) as (
        process,
        rehearsal,
    ):
        child = real_time_process(process.pid)
        process.kill()
        process.wait()
        wait_until_gone(child)
        wait_until_all_hold(rehearsal)


def codes_of_losses(rehearsal: SimulatedCia402Rig) -> set[int]:
    """EMCY codes of the drives that miss their master from now on."""
    codes: set[int] = set()
    for drive in rehearsal.drives:
        react = drive._connection_lost

        def note(code: int, react: Callable[[int], None] = react) -> None:
            codes.add(code)
            react(code)

        drive._connection_lost = note  # type: ignore[method-assign]
    return codes


@pytest.mark.skipif(which("pkill") is None, reason="there is no pkill here")
@pytest.mark.parametrize(("verb", "takes_sync", "number"), [("pkill", True, 7), ("kill", False, 8)])
def test_the_commands_of_commissioning_kill_what_the_page_says(
    slow_run: PreparedRun,
    slow_rig: Path,
    short_plan: Path,
    tmp_path: Path,
    verb: str,
    takes_sync: bool,
    number: int,
) -> None:
    """Killing the supervisor alone ends in order, so it does not show what the drives do."""
    page = (ROOT / "docs" / "commissioning.md").read_text("utf-8")
    (command,) = re.findall(rf"`({verb} -9 [^`]+)`", page)
    run = tmp_path / "run"
    with moving_over_udp(slow_run, slow_rig, short_plan, run, number) as (process, rehearsal):
        child = real_time_process(process.pid)
        codes = codes_of_losses(rehearsal)
        only_this = command.replace("cdpr jog", str(run))
        subprocess.run(["sh"], input=only_this, text=True, check=True)
        assert process.wait() == -signal.SIGKILL
        wait_until_gone(child)
        wait_until_all_hold(rehearsal)
    # With their text such a test is repeated: SYNC is also late on a computer that is held up.
    said = "; ".join(map(emergency_text, codes))
    assert (SYNC_OVERDUE in codes) == takes_sync, said
    assert takes_sync or not codes, said


def test_the_death_of_the_real_time_process_is_reported_and_the_drives_stop_on_their_own(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with moving_over_udp(slow_run, slow_rig, short_plan, run, 2) as (process, rehearsal):
        os.kill(real_time_process(process.pid), signal.SIGKILL)
        out, err = process.communicate()
        assert process.returncode == 1, (out, err)
        wait_until_all_hold(rehearsal)
    assert "FAILED" in out
    folder = RunFolder.open(run)
    summary = folder.summary()
    assert summary["final_state"] == "latched"
    assert any("killed by signal 9" in reason for reason in summary["reasons"])
    assert [event["code"] for event in summary["events"]][-1] == "real_time_lost"
    assert len(folder.cycles()) == summary["cycles"] > 0


def lets_go(rehearsal: SimulatedCia402Rig) -> None:
    """The loss of the master is a fault of the sixth drive, whatever it was set up to do."""
    rehearsal.drives[SIXTH]._connection_lost = lambda code: rehearsal.drives[SIXTH].fail(code)  # type: ignore[method-assign]


def falls_silent(rehearsal: SimulatedCia402Rig) -> None:
    """The sixth drive is gone together with the master."""
    rehearsal.drives[SIXTH].silent = True


@pytest.mark.parametrize(
    ("breaks", "number", "words"),
    [(lets_go, 5, "(drive 6) is in fault"), (falls_silent, 6, "drive 6")],
)
def test_drives_are_asked_for_their_state_once_their_process_has_died(
    slow_run: PreparedRun,
    slow_rig: Path,
    short_plan: Path,
    tmp_path: Path,
    breaks: Callable[[SimulatedCia402Rig], None],
    number: int,
    words: str,
) -> None:
    run = tmp_path / "run"
    with moving_over_udp(slow_run, slow_rig, short_plan, run, number) as (process, rehearsal):
        child = real_time_process(process.pid)
        os.kill(child, signal.SIGSTOP)
        breaks(rehearsal)
        os.kill(child, signal.SIGKILL)
        out, err = process.communicate()
    assert process.returncode == 1, (out, err)
    summary = RunFolder.open(run).summary()
    assert [event["code"] for event in summary["events"]][-2:] == ["real_time_lost", "not_held"]
    assert words in summary["events"][-1]["text"]
    assert any(words in reason for reason in summary["reasons"])


def test_a_real_time_process_that_hangs_is_ended_and_reported(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    """Suspended for good, it would otherwise be waited for forever."""
    run = tmp_path / "run"
    with moving_over_udp(slow_run, slow_rig, short_plan, run, 4) as (process, rehearsal):
        child = real_time_process(process.pid)
        os.kill(child, signal.SIGSTOP)
        out, err = process.communicate()
        assert process.returncode == 1, (out, err)
        assert gone(child)
        wait_until_all_hold(rehearsal)
    summary = RunFolder.open(run).summary()
    assert summary["final_state"] == "latched"
    assert any("hung and was killed" in reason for reason in summary["reasons"])
    assert summary["events"][-1]["code"] == "real_time_lost"


def test_a_supervisor_that_hangs_is_noticed(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with moving_over_udp(slow_run, slow_rig, short_plan, run, 3) as (process, rehearsal):
        child = real_time_process(process.pid)
        send("speed", 5)
        process.send_signal(signal.SIGSTOP)
        wait_until_gone(child)
        wait_until_all_hold(rehearsal)
        code, out, _ = finished("stop", "--json")
        assert code == 1
        assert json.loads(out) == {"stopped_processes": [], "silent_processes": [process.pid]}
        process.send_signal(signal.SIGCONT)
        process.communicate()
        assert process.returncode == 1
    summary = RunFolder.open(run).summary()
    assert summary["final_state"] == "latched"
    # A host so busy that the drives in this process do not answer in time ends the run before.
    causes = (
        ("silent for 2 s", "did not answer") if summary["lost_replies"] else ("silent for 2 s",)
    )
    assert any(cause in reason for reason in summary["reasons"] for cause in causes)


def codes(status: dict[str, Any]) -> list[str]:
    """Of its events; that a user may be without real-time rights is beside the question."""
    return [event["code"] for event in status["events"] if event["code"] != "no_real_time"]


def test_hold_speed_resume_and_monitor_reach_a_run_from_other_terminals(
    slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with program("run", short_plan, "--rig", slow_rig, "-o", run, "--no-camera") as moving:
        waited_for(run / "events.jsonl", "moving", moving)
        send("hold")
        waited_for(run / "events.jsonl", "hold", moving)
        code, out, err = finished("monitor", "--once", "--json")
        status = json.loads(out)
        assert (code, err) == (0, "")
        assert status["state"] == "holding"
        assert status["process"] == moving.pid
        assert codes(status) == ["enabled", "moving", "hold"]
        assert {d["state"] for d in status["drives"]} == {"operation enabled"}
        code, out, err = finished("hold", "--json")
        assert (code, err) == (0, "")
        assert json.loads(out)["state"] == "holding"
        code, out, err = finished("speed", "100")
        assert (code, err) == (0, "")
        assert "applies after `cdpr resume`" in out
        code, out, err = finished("resume")
        assert (code, err) == (0, "")
        assert f"process {moving.pid} received the request to resume" in out
        code, out, err = finished("monitor")
        assert (code, err) == (0, ""), "it ends with the run"
        assert "resume: continuing along the path at 100%" in out
        moving.communicate()
        assert moving.returncode == 0
    summary = RunFolder.open(run).summary()
    assert summary["verdict"] == "PASSED"
    assert codes(summary) == ["enabled", "moving", "hold", "resume", "held"]


def test_winches_without_a_path_are_moved_by_the_real_time_process_too(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its death is reported and latched as a fault, and the drives hold on their own."""
    channel = f"239.74.163.28:{20000 + (os.getpid() * 17) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel, "--yes", "--without-real-time")
    monkeypatch.chdir(tmp_path)
    with drives_on(channel, slow_run) as rehearsal:
        loss = PowerLoss.drawn(slow_run.rig, 4, 0.010, on_a_stand=True)
        loss.apply_to(slow_run.rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
        with program("home", slow_rig, "--at-home", "--speed-mm-s", "0.05", *bus) as homing:
            events = tmp_path / "runs/home/events.jsonl"
            waited_for(events, "moving", homing)
            child = real_time_process(homing.pid)
            assert len(list(Path(f"/proc/{child}/task").iterdir())) == 1
            os.kill(child, signal.SIGKILL)
            out, err = homing.communicate()
            assert homing.returncode == 1, (out, err)
        wait_until_all_hold(rehearsal)
    assert "killed by signal 9" in err.replace("\n", " ")
    assert json.loads(events.read_text().splitlines()[-1])["code"] == "real_time_lost"
    latched = FaultLatch(BusSettings("udp_multicast", channel)).read()
    assert latched is not None
    assert "killed by signal 9" in latched.cause


def test_the_real_time_process_has_one_thread(
    slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with program("run", short_plan, "--rig", slow_rig, "-o", run, "--no-camera") as moving:
        waited_for(run / "events.jsonl", "moving", moving)
        child = real_time_process(moving.pid)
        assert len(list(Path(f"/proc/{child}/task").iterdir())) == 1
        os.kill(child, signal.SIGTERM)
        moving.communicate()
        assert moving.returncode == 130, "asked to end, it stops along the path"
