"""Rigs of three makes over a kernel CAN bus, from `cdpr doctor --drives` to `cdpr release`."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.trajectory.setpoints import prepare
from model.plan import load_plan
from model.rig import load_rig
from planner.check import verify
from tests.scenarios import test_processes
from tests.scenarios.faults.samples import WatchedRehearsal
from tests.scenarios.makers import MAKERS, STEPS, Day, a_day, plan_back, rig_of
from tests.scenarios.test_real_time import drives_on

SLOW_S = 600.0  # a program's imports alone take a minute where instructions are counted

pytestmark = [pytest.mark.hil, pytest.mark.slow]


@pytest.mark.parametrize("profile", MAKERS)
def test_a_day_with_drives_of(
    channel: str,
    short_plan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    profile: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(test_processes, "ENDS_WITHIN_S", SLOW_S)
    rig = rig_of(profile, BusSettings("socketcan", channel), tmp_path)
    theirs = prepare(verify(load_plan(short_plan)), load_rig(rig))
    with drives_on(channel, theirs, WatchedRehearsal, "socketcan") as rehearsal:
        rehearsal.real = True
        day = Day(rig, rehearsal, tmp_path)
        assert list(a_day(day, theirs, short_plan, plan_back(tmp_path))) == STEPS
