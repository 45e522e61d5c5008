"""Eight drives of each maker in real time: every verb of a day, without a fault of any drive."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.trajectory.setpoints import PreparedRun, prepare
from model.rig import load_rig
from tests.scenarios.faults.samples import WatchedRehearsal
from tests.scenarios.makers import MAKERS, STEPS, Day, a_day, plan_back, rig_of
from tests.scenarios.test_real_time import drives_on


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.quiet
@pytest.mark.parametrize("profile", MAKERS)
def test_a_day_with_drives_of(
    prepared: PreparedRun,
    short_plan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    profile: str,
) -> None:
    number = (os.getpid() * 23 + MAKERS.index(profile)) % 20000
    settings = BusSettings("udp_multicast", f"239.74.163.38:{20000 + number}")
    monkeypatch.chdir(tmp_path)
    rig = rig_of(profile, settings, tmp_path)
    theirs = prepare(prepared.plan, load_rig(rig))
    with drives_on(settings.channel, theirs, WatchedRehearsal) as rehearsal:
        rehearsal.real = True
        day = Day(rig, rehearsal, tmp_path)
        assert list(a_day(day, theirs, short_plan, plan_back(tmp_path))) == STEPS
