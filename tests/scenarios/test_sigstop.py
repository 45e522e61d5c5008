"""A real-time process that is suspended for some cycles: no set-point enables a drive again.

All of 5 to 60 ms in steps of 1 ms: `python benchmarks/sigstop.py`.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from executor.recording.run_folder import RunFolder
from executor.trajectory.setpoints import PreparedRun
from tests.cli.plans import RIG
from tests.scenarios.faults.samples import WatchedRehearsal
from tests.scenarios.faults.suspension import Suspension, seen_by
from tests.scenarios.test_processes import program, waited_for
from tests.scenarios.test_real_time import drives_on, real_time_process

pytestmark = [pytest.mark.slow, pytest.mark.real_time, pytest.mark.quiet]


@pytest.mark.parametrize("milliseconds", [8, 21, 28, 45])
def test_no_drive_that_stopped_is_enabled_again(
    prepared: PreparedRun, short_plan: Path, tmp_path: Path, milliseconds: int
) -> None:
    """Drives stop on their own 30 ms after a SYNC: 28 ms begin before, and end after that."""
    run = tmp_path / "run"
    channel = f"239.74.163.36:{20000 + (os.getpid() * 7 + milliseconds) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel)
    rest = ("-o", run, *bus, "--no-camera", "--yes", "--without-real-time")
    with drives_on(channel, prepared, WatchedRehearsal) as rehearsal:
        rehearsal.real = True
        with program("run", short_plan, "--rig", RIG, *rest) as process:
            waited_for(run / "events.jsonl", "moving", process)
            child = real_time_process(process.pid)
            suspension = Suspension(lambda: child, milliseconds)
            rehearsal.on_cycle = suspension.begin
            out, err = process.communicate()
            suspension.join()
    assert suspension.done.is_set(), (out, err)
    seen = seen_by(rehearsal)
    assert seen.returned == ()
    assert seen.stopped == len(rehearsal.drives)
    summary = RunFolder.open(run).summary()
    assert process.returncode == (0 if summary["verdict"] == "PASSED" else 1)
    if milliseconds > 25:  # the last SYNC before was at most a cycle old
        assert process.returncode == 1
        assert summary["final_state"] == "latched"
