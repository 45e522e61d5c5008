"""`cdpr status`: state on file and state of the drives, without changing either."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cdpr.cli.options import rig_on_bus
from drivers.can_bus import BusSettings
from drivers.cia402.state_machine import DriveState
from executor import service
from executor.interlock import locks as set_up_lock
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock
from executor.interlock.locks import SetUpLock, state_file
from executor.interlock.reference import as_in_the_file
from executor.state_machine import State
from executor.trajectory.setpoints import PreparedRun
from model.errors import Refused
from simulation.drives.cia402 import SimulatedDrive
from tests.cli.plans import RIG
from tests.cli.program import call
from tests.scenarios.test_real_time import drives_on


def kept(drive: SimulatedDrive) -> dict[Any, Any]:
    """Everything in a drive that can be written."""
    return drive.objects.values()


@pytest.mark.slow
@pytest.mark.real_time
def test_it_shows_the_state_of_the_rig_and_leaves_everything_as_it_was(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.28:{20000 + (os.getpid() * 23) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    settings = BusSettings("udp_multicast", channel)
    with drives_on(channel, slow_run) as rehearsal:
        before = [kept(drive) for drive in rehearsal.drives]
        answer = call("status", slow_rig, *bus, "--json")
        assert answer.code == 0, answer
        result = json.loads(answer.out)
        assert result["latched"] is result["run"] is None
        assert result["reference"]["counts"] is True
        assert [drive["set_up"] for drive in result["drives"]] == [False] * 8
        assert {drive["state"] for drive in result["drives"]} == {"switch on disabled"}
        assert [d["position_counts"] for d in result["drives"]] == [
            round(drive.motor.position) for drive in rehearsal.drives
        ]
        start = (slow_run.scene.start.position * 1e3).tolist()
        assert result["pose"]["position_mm"] == pytest.approx(start, abs=0.5)
        assert [kept(drive) for drive in rehearsal.drives] == before
        assert not state_file("latched", settings).parent.exists()

        counting = tmp_path / "rig.yaml"
        counting.write_text(slow_rig.read_text().replace("encoder: absolute, ", ""))
        running = FaultLatch(settings)
        running.engage("rig", tmp_path)
        answer = call("status", counting, *bus)
        assert answer.code == 0, answer
        assert re.search(
            r"latched fault +none; process \d+ is moving or resetting the rig", answer.out
        )
        assert "never homed: cable 1 (drive 1)" in answer.out.replace("\n", " ")
        assert "switch on disabled" not in answer.out, "an active run must not be disturbed"


@pytest.mark.slow
@pytest.mark.real_time
def test_what_is_on_file_is_reported_although_no_drive_answers(
    slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.29:{20000 + (os.getpid() * 23) % 20000}"
    latch = FaultLatch(BusSettings("udp_multicast", channel))
    latch.engage("rig", tmp_path)
    latch.settle("rig", State.LATCHED, "cable 4 is slack", tmp_path)
    answer = call("status", slow_rig, "--interface", "udp_multicast", "--channel", channel)
    assert answer.code == 4
    assert "cable 4 is slack" in answer.out
    assert "do not answer" in answer.err


@pytest.mark.slow
@pytest.mark.real_time
def test_the_drives_that_answer_are_shown_beside_one_that_does_not(
    slow_run: PreparedRun, slow_rig: Path
) -> None:
    """One without power hid the state of the seven others, and the reference seemed valid."""
    channel = f"239.74.163.29:{20000 + (os.getpid() * 23 + 1) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    with drives_on(channel, slow_run) as rehearsal:
        everything = json.loads(call("status", slow_rig, *bus, "--json").out)
        rehearsal.drives[4].silent = True
        answer = call("status", slow_rig, *bus, "--json")
        assert answer.code == 4
        assert "drive 5 does not answer" in answer.err
        result = json.loads(answer.out)
        assert (result["error"], result["exit_code"]) == ("hardware_missing", 4)
        assert "drive 5 does not answer" in result["what"]
        without = [drive for drive in everything["drives"] if drive["node"] != 5]
        assert result["drives"] == without
        assert result["silent"] == [5]
        assert result["pose"] is None
        reference = result["reference"]
        assert (reference["counts"], reference["known"]) == (False, False)
        shown = call("status", slow_rig, *bus)
        assert shown.code == 4
        lines = [line.split(")", 1) for line in shown.out.splitlines() if " (drive " in line]
        lines = [line for line in lines if line[0].lstrip().startswith("cable")]
        assert [line[0].strip() for line in lines] == [f"cable {n} (drive {n}" for n in range(1, 9)]
        assert ["does not answer" in line[1] for line in lines] == [n == 5 for n in range(1, 9)]
        assert "unknown" in next(line for line in shown.out.splitlines() if "reference" in line)
        assert "cdpr home" not in shown.said


@pytest.mark.slow
@pytest.mark.real_time
def test_drives_in_configuration_are_not_read(slow_run: PreparedRun, slow_rig: Path) -> None:
    channel = f"239.74.163.27:{20000 + (os.getpid() * 23) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    with (
        drives_on(channel, slow_run) as rehearsal,
        SetUpLock(BusSettings("udp_multicast", channel)).held(),
    ):
        answer = call("status", slow_rig, *bus, "--json")
        assert answer.code == 0, answer
        result = json.loads(answer.out)
        assert (result["being_set_up"], result["drives"], result["run"]) == (True, None, None)
        assert "preparing a motion" in call("status", slow_rig, *bus).out.replace("\n", " ")
        assert rehearsal.cycles == 0


def _one_let_go(drives: tuple[SimulatedDrive, ...]) -> str:
    drives[3].state = DriveState.SWITCH_ON_DISABLED
    return ""


def _one_lost_power(drives: tuple[SimulatedDrive, ...]) -> str:
    drives[3].power_on()
    return ""


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize(
    ("number", "happened", "off", "before", "after"),
    [
        (2, lambda _: "", 10**6, (False, True), True),
        (3, _one_let_go, 10**6, (False, False), False),
        (4, _one_lost_power, 10**6, (False, False), False),
        (5, lambda _: "a cable came off", 10**6, (False, False), False),
    ],
)
def test_a_reset_is_announced_to_keep_the_reference_exactly_where_it_does(
    slow_run: PreparedRun,
    slow_rig: Path,
    tmp_path: Path,
    number: int,
    happened: Callable[[tuple[SimulatedDrive, ...]], str],
    off: int,
    before: tuple[bool, bool],
    after: bool,
) -> None:
    """A killed program recorded no end of its motion: the operator must not home in mid-air."""
    channel = f"239.74.163.36:{20000 + (os.getpid() * 23 + number) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rig = tmp_path / "rig.yaml"
    rig.write_text(slow_rig.read_text().replace("encoder: absolute, ", ""))
    with drives_on(channel, slow_run) as rehearsal:
        assert call("reset", rig, *bus, "--yes").code == 0
        for drive in rehearsal.drives:
            drive.objects[0x605A, 0] = 6
            drive.state = DriveState.QUICK_STOP_ACTIVE
        described = rig_on_bus(rig, "udp_multicast", channel)
        lost = happened(rehearsal.drives)
        stood = [round(drive.motor.position) + off for drive in rehearsal.drives]
        homed = {"made": "2026-01-01T00:00:00+00:00", "stands_at": stood, "released": []}
        kept = as_in_the_file(described).model_copy(update={**homed, "lost": lost})
        MotionInterlock(described).file.write(kept)
        FaultLatch(BusSettings("udp_multicast", channel)).engage("gachon_8_6", tmp_path)
        answer = call("status", rig, *bus, "--json")
        assert answer.code == 0, answer
        shown = json.loads(answer.out)["reference"]
        assert (shown["counts"], shown["valid_after_reset"]) == before
        steps = service.status(described).next_step(rig)
        assert ("cdpr home" in steps) == (not after)
        assert "cdpr reset" in steps
        answer = call("reset", rig, *bus, "--yes", "--json")
        assert answer.code == 0, answer
        assert json.loads(answer.out)["reference"]["counts"] is after
        assert (service.status(described).pose is not None) == after


def test_who_sets_drives_up_waits_for_who_asks_and_does_so_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = BusSettings("socketcan", "can6")
    monkeypatch.setattr(set_up_lock, "READ_TIMEOUT", 0.05)
    with SetUpLock(settings).tried() as alone:
        assert alone
        assert not state_file("set-up", settings).parent.exists(), "reading creates no file"
    with SetUpLock(settings).held():
        with SetUpLock(settings).tried() as alone:
            assert not alone
        with (
            pytest.raises(Refused, match="configuring or reading"),
            SetUpLock(settings).held(),
        ):
            pytest.fail("two programs set the same drives up")
        with SetUpLock(BusSettings("socketcan", "can7")).held():
            pass
    with SetUpLock(settings).tried() as alone:
        assert alone
        with pytest.raises(Refused), SetUpLock(settings).held():
            pytest.fail("drives were set up while somebody asked them")
    with SetUpLock(settings).held():
        pass


def test_a_bus_of_one_process_has_nothing_to_report() -> None:
    assert call("status", RIG).code == 2
