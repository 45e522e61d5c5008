"""`cdpr home` over a kernel CAN bus: drives that count from anywhere are referenced by a jig."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.state_machine import DriveState
from tests.cli.plans import RIG
from tests.hil.conftest import Program, Rig, next_message, stopped_programs

pytestmark = [pytest.mark.hil, pytest.mark.slow]


def test_slack_cables_are_taut_and_referenced_afterwards(
    channel: str, trace: Path, tmp_path: Path, figures: Callable[[str], None]
) -> None:
    bus = ("--interface", "socketcan", "--channel", channel)
    lost = ("--power-lost", "4", "--slack-mm", "1", "--on-a-stand")
    started: list[Program] = []
    with stopped_programs(started), open_bus(BusSettings("socketcan", channel)) as ear:
        drives = Program(tmp_path / "drives.txt", ("sim", RIG, *bus, *lost))
        started.append(drives)
        next_message(ear, drives)
        words = ("home", RIG, "--at-home", "--speed-mm-s", "10", *bus, "--yes", "--json")
        home = Program(tmp_path / "home.txt", words)
        started.append(home)
        assert home.ended() == 0, home.said.read_text()
        rig = Rig(channel, RIG, tmp_path, drives, ear, started)
        assert rig.states() == {DriveState.QUICK_STOP_ACTIVE}
        said = home.said.read_text()
        told = json.loads(said[said.index("{") :])
        assert told["lost"] == ""
        assert told["stands_at"] == pytest.approx(rig.positions(), abs=1)
        assert min(told["tensions_n"]) > 5.0
        figures(f"tensions {min(told['tensions_n'])} to {max(told['tensions_n'])} N")
