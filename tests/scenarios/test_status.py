"""`cdpr status`: what is on file and what the drives tell, without touching either."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from cdpr.errors import Refused
from drivers.bus import BusSettings
from executor import set_up_lock
from executor.latch import Latch
from executor.machine import State
from executor.prepare import PreparedRun
from executor.set_up_lock import SetUpLock
from executor.state_folder import state_file
from simulation.drive import SimulatedDrive
from tests.cli.plans import RIG
from tests.cli.program import call
from tests.scenarios.test_real_time import drives_on


def kept(drive: SimulatedDrive) -> dict[Any, int]:
    """Everything in a drive that can be written."""
    return {key: entry.value for key, entry in drive.objects._entries.items()}


@pytest.mark.slow
def test_it_tells_how_the_rig_stands_and_leaves_everything_as_it_was(
    prepared: PreparedRun, tmp_path: Path
) -> None:
    channel = f"239.74.163.28:{20000 + (os.getpid() * 23) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    settings = BusSettings("udp_multicast", channel)
    with drives_on(channel, prepared) as rehearsal:
        before = [kept(drive) for drive in rehearsal.drives]
        answer = call("status", RIG, *bus, "--json")
        assert answer.code == 0, answer
        told = json.loads(answer.out)
        assert told["latched"] is told["run"] is None
        assert told["reference"]["counts"] is True
        assert [drive["set_up"] for drive in told["drives"]] == [False] * 8
        assert {drive["state"] for drive in told["drives"]} == {"switch on disabled"}
        assert [d["position_counts"] for d in told["drives"]] == [
            round(drive.motor.position) for drive in rehearsal.drives
        ]
        start = (prepared.scene.start.position * 1e3).tolist()
        assert told["pose"]["position_mm"] == pytest.approx(start, abs=0.5)
        assert [kept(drive) for drive in rehearsal.drives] == before
        assert not state_file("latched", settings).parent.exists()

        counting = tmp_path / "rig.yaml"
        counting.write_text(RIG.read_text().replace("encoder: absolute, ", ""))
        running = Latch(settings)
        running.engage("rig", tmp_path)
        answer = call("status", counting, *bus)
        assert answer.code == 0, answer
        assert re.search(r"latched fault +none; process \d+ moves or resets it", answer.out)
        assert "never referenced: cable 1 (drive 1)" in answer.out.replace("\n", " ")
        assert "switch on disabled" not in answer.out, "who runs them must not be disturbed"


@pytest.mark.slow
def test_what_is_on_file_is_told_although_no_drive_answers(tmp_path: Path) -> None:
    channel = f"239.74.163.29:{20000 + (os.getpid() * 23) % 20000}"
    latch = Latch(BusSettings("udp_multicast", channel))
    latch.engage("rig", tmp_path)
    latch.settle("rig", State.LATCHED, "cable 4 is slack", tmp_path)
    answer = call("status", RIG, "--interface", "udp_multicast", "--channel", channel)
    assert answer.code == 4
    assert "cable 4 is slack" in answer.out
    assert "does not answer" in answer.err


@pytest.mark.slow
def test_drives_that_somebody_sets_up_are_not_asked(prepared: PreparedRun) -> None:
    channel = f"239.74.163.27:{20000 + (os.getpid() * 23) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    with (
        drives_on(channel, prepared) as rehearsal,
        SetUpLock(BusSettings("udp_multicast", channel)).held(),
    ):
        answer = call("status", RIG, *bus, "--json")
        assert answer.code == 0, answer
        told = json.loads(answer.out)
        assert (told["being_set_up"], told["drives"], told["run"]) == (True, None, None)
        assert "a motion is being prepared" in call("status", RIG, *bus).out.replace("\n", " ")
        assert rehearsal.cycles == 0


def test_who_sets_drives_up_waits_for_who_asks_and_does_so_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = BusSettings("socketcan", "can6")
    monkeypatch.setattr(set_up_lock, "ASKED_WITHIN", 0.05)
    with SetUpLock(settings).tried() as alone:
        assert alone
        assert not state_file("set-up", settings).parent.exists(), "who looks makes no file"
    with SetUpLock(settings).held():
        with SetUpLock(settings).tried() as alone:
            assert not alone
        with pytest.raises(Refused, match="sets these drives up"), SetUpLock(settings).held():
            pytest.fail("two programs set the same drives up")
        with SetUpLock(BusSettings("socketcan", "can7")).held():
            pass
    with SetUpLock(settings).tried() as alone:
        assert alone
        with pytest.raises(Refused), SetUpLock(settings).held():
            pytest.fail("drives were set up while somebody asked them")
    with SetUpLock(settings).held():
        pass


def test_a_bus_of_one_process_has_nothing_to_tell() -> None:
    assert call("status", RIG).code == 2
