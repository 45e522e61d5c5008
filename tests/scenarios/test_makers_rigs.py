"""Eight drives of each maker in real time: every verb of a day, without a fault of any drive."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.trajectory.setpoints import PreparedRun, prepare
from model.rig import load_rig
from tests.scenarios.faults.samples import WatchedRehearsal
from tests.scenarios.makers import MAKERS, STEPS, Day, HeldUp, a_day, plan_back, rig_of
from tests.scenarios.test_real_time import drives_on

ATTEMPTS = 3


@pytest.mark.slow
@pytest.mark.quiet
@pytest.mark.parametrize("profile", MAKERS)
def test_a_day_with_drives_of(
    prepared: PreparedRun,
    short_plan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    profile: str,
) -> None:
    back, reasons = plan_back(tmp_path), list[str]()
    for attempt in range(ATTEMPTS):
        number = (os.getpid() * 23 + ATTEMPTS * MAKERS.index(profile) + attempt) % 20000
        settings = BusSettings("udp_multicast", f"239.74.163.38:{20000 + number}")
        folder = tmp_path / f"{attempt}"
        folder.mkdir()
        monkeypatch.chdir(folder)
        rig = rig_of(profile, settings, folder)
        theirs = prepare(prepared.plan, load_rig(rig))
        with drives_on(settings.channel, theirs, WatchedRehearsal) as rehearsal:
            rehearsal.real = True
            day = Day(rig, rehearsal, folder)
            try:
                assert list(a_day(day, theirs, short_plan, back)) == STEPS
            except HeldUp as held_up:
                reasons.append(f"after {day.steps}: {held_up}")
            else:
                return
    pytest.fail(f"held up by this computer each time: {reasons}")
