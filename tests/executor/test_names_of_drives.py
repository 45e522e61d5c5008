"""Names of drives in reports: cables are counted, drives have their numbers on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np

from drivers.cia402.monitor import DriveMonitor
from drivers.cia402.pdo import EMCY_BASE
from drivers.drive_group import WHOLE_BUS, GroupState
from executor.control.cycle import Cycle
from executor.control.sync_master import SyncMaster
from executor.realtime.scheduling import SimulatedClock
from executor.safety.gate import Purpose
from executor.trajectory.setpoints import CheckedSetpoints, fingerprint
from tests.configs import HALL

#: Its ten winches have the node ids 11 to 20.
HOME = np.array([[winch.home_counts for winch in HALL.winches]], dtype=np.int32)


class _Group:
    """Drives of which the fifth does not answer, one is faulty and the bus as well."""

    state = GroupState.CONFIGURED
    capabilities = SimpleNamespace(sync_timeout=3.0)

    def __init__(self, faults: Sequence[tuple[int, str]]) -> None:
        self.faults = tuple(faults)

    def send_cycle(self, _targets: Sequence[int], _may_send: object) -> None:
        """Does nothing."""

    def receive(self, _timeout: float) -> SimpleNamespace:
        """Their reports."""
        return SimpleNamespace(
            positions=HOME[0],
            demands=HOME[0],
            set_points=HOME[0],
            renewed=np.arange(10) != 4,
            torques=np.zeros(10, dtype=int),
            missing=np.arange(10) == 4,
            faults=self.faults,
            warnings=(),
            state=self.state,
        )


def test_a_drive_has_one_name_in_every_message():
    watch = DriveMonitor(HALL.drive_names, [1e9] * 10)
    watch.take(EMCY_BASE + 13, bytes.fromhex("1023000000000000"))
    group = _Group([*watch.news(), (WHOLE_BUS, "bus-off")])
    course = CheckedSetpoints(HALL, 0.01, HOME, fingerprint(0.01, HOME))
    exchange = Cycle(course, SyncMaster(HALL, group, SimulatedClock(0.01)))
    exchange.actual = tuple(HOME[0].tolist())
    done = exchange.cycle(Purpose.HOLD, exchange.actual, at_rest=True)
    reported = {(alarm.drive, alarm.text.split(":")[0]) for alarm in done.alarms}
    assert reported == {
        (3, "cable 3 (drive 13)"),
        (0, "bus-off"),
        (5, "cable 5 (drive 15) did not answer for 1 cycle"),
    }
