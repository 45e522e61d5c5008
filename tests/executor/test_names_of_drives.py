"""What a run says of a drive: cables are counted, drives have the numbers they have on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from cdpr.rig import load_rig
from drivers.cia402.frames import EMCY_BASE
from drivers.cia402.watch import DriveWatch
from drivers.drive_group import WHOLE_BUS, GroupState
from executor.course import Course, fingerprint
from executor.exchange import Exchange
from executor.safety.gate import Purpose

#: Its ten winches have the node ids 11 to 20.
HALL = load_rig(Path(__file__).parents[2] / "configs" / "hall_10_6.yaml")
HOME = np.array([[winch.home_counts for winch in HALL.winches]], dtype=np.int32)


class _Group:
    """Drives of which the fifth does not answer, one is faulty and the bus as well."""

    state = GroupState.CONFIGURED

    def __init__(self, faults: Sequence[tuple[int, str]]) -> None:
        self.faults = tuple(faults)

    def send_cycle(self, targets: Sequence[int]) -> None:
        """Nobody listens."""

    def receive(self, _timeout: float) -> SimpleNamespace:
        """What they told."""
        return SimpleNamespace(
            positions=HOME[0],
            demands=HOME[0],
            torques=np.zeros(10, dtype=int),
            missing=np.arange(10) == 4,
            faults=self.faults,
            state=self.state,
        )


def test_a_drive_has_one_name_whoever_speaks_of_it():
    watch = DriveWatch(HALL.drive_names, [1e9] * 10)
    watch.take(EMCY_BASE + 13, bytes.fromhex("1023000000000000"))
    group = _Group([*watch.news(), (WHOLE_BUS, "bus-off")])
    course = Course(HALL, 0.01, HOME, fingerprint(0.01, HOME))
    clock = SimpleNamespace(next_cycle=lambda: 0.0, time_left=lambda: 0.0)
    exchange = Exchange(course, group, clock)
    exchange.actual = tuple(HOME[0].tolist())
    done = exchange.cycle(Purpose.HOLD, exchange.actual, at_rest=True)
    told = {(finding.drive, finding.text.split(":")[0]) for finding in done.findings}
    assert told == {
        (3, "cable 3 (drive 13)"),
        (0, "bus-off"),
        (5, "cable 5 (drive 15) did not answer for 1 cycle"),
    }
