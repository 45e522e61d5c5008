"""Taking the torque off: whatever happens on the way, no drive is left following set-points."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from cdpr.errors import Fault, HardwareMissing, Refused, StoppedByOperator
from cdpr.rig import load_rig
from drivers.bus import BusSettings, open_bus
from drivers.cia402.states import DriveState
from drivers.drive_group import CycleStatus, DriveGroup, GroupState, make_drive_group
from executor.clock import SimulatedClock
from executor.torque_off import take_torque_off
from executor.unreferenced import set_up_here
from simulation.power_loss import PowerLoss
from simulation.rehearsal import Rehearsal
from tests.cli.plans import RIG

_CHANNELS = itertools.count()
FOLLOWING, HOLDING = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE


class Held:
    """Drives that hold and count from anywhere."""

    def __init__(self, rehearsal: Rehearsal, group: DriveGroup) -> None:
        self.drives, self.group = rehearsal.drives, group

    def release(self, each_cycle: Callable[[int], bool]) -> CycleStatus:
        cycles = itertools.count()
        return take_torque_off(
            load_rig(RIG), self.group, SimulatedClock(0.01), lambda: each_cycle(next(cycles))
        )

    @property
    def states(self) -> set[DriveState]:
        return {drive.state for drive in self.drives}


@contextmanager
def held(*, set_up_where_they_stand: bool = True) -> Iterator[Held]:
    rig, settings = load_rig(RIG), BusSettings("virtual", f"torque-off-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = Rehearsal(rig, far, rig.home)
        loss = PowerLoss.drawn(rig, 3, 0.0, on_a_stand=True)
        loss.happen_to(rig, rehearsal.plant, [drive.motor for drive in rehearsal.drives])
        for drive in rehearsal.drives:
            drive.state = HOLDING
        group = make_drive_group(rig, near, rehearsal.pump)
        group.configure()
        status = group.read_positions()
        if set_up_where_they_stand:
            group = make_drive_group(set_up_here(rig, status)[0], near, rehearsal.pump)
            group.configure()
            group.read_positions()
        yield Held(rehearsal, group)


def test_all_lose_their_torque_where_they_stand() -> None:
    with held() as bench:
        stood = [drive.motor.position for drive in bench.drives]
        assert bench.release(lambda _cycle: False).state is GroupState.RELEASED
        assert bench.states == {DriveState.READY_TO_SWITCH_ON}
        assert [drive.motor.position for drive in bench.drives] == pytest.approx(stood, abs=1)


def test_drives_beyond_their_limits_are_not_enabled() -> None:
    with held(set_up_where_they_stand=False) as bench:
        with pytest.raises(Refused, match="beyond its position limits"):
            bench.release(lambda _cycle: False)
        assert bench.states == {HOLDING}


@pytest.mark.parametrize("cycle", range(6))
def test_a_stop_at_any_cycle_leaves_none_enabled(cycle: int) -> None:
    with held() as bench:
        with pytest.raises(StoppedByOperator, match="a fault is latched"):
            bench.release(lambda now: now == cycle)
        assert FOLLOWING not in bench.states


def test_an_exception_while_the_drives_are_enabled_stops_them() -> None:
    def interrupt(_cycle: int) -> bool:
        if FOLLOWING in bench.states:
            raise KeyboardInterrupt
        return False

    with held() as bench:
        with pytest.raises(KeyboardInterrupt):
            bench.release(interrupt)
        assert bench.states == {HOLDING}


def test_a_drive_that_falls_silent_stops_the_others() -> None:
    def silence(_cycle: int) -> bool:
        if FOLLOWING in bench.states:
            bench.drives[4].silent = True
        return False

    with held() as bench:
        with pytest.raises(HardwareMissing, match=r"cable 5 \(drive 5\) fell silent"):
            bench.release(silence)
        assert FOLLOWING not in {drive.state for drive in bench.drives if not drive.silent}


def test_a_drive_that_stopped_by_itself_is_not_enabled_again() -> None:
    enabled: list[int] = []
    after: list[DriveState] = []

    def drop(cycle: int) -> bool:
        if bench.drives[2].state is FOLLOWING:
            enabled.append(cycle)
        if len(enabled) == 2:  # the group has heard that it is enabled
            bench.drives[2]._quick_stop()
            enabled.append(cycle)
        elif len(enabled) > 2:
            after.append(bench.drives[2].state)
        return False

    with held() as bench:
        with pytest.raises(Fault, match=r"cable 3 \(drive 3\) stopped by itself"):
            bench.release(drop)
        assert FOLLOWING not in bench.states
        assert set(after) <= {HOLDING}
        assert bench.drives[2].state is HOLDING
