"""`cdpr status`: state on file and state of the drives, without changing either."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from drivers.can_bus import BusSettings
from executor.interlock import locks as set_up_lock
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.locks import SetUpLock, state_file
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
