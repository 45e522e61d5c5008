"""F4, densely: for any lateness, no drive that stopped on its own is enabled again.

The drives leave quick stop by level, as CiA 402 allows: "enable operation" alone does it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.state_machine import DriveState
from drivers.drive_group import GroupCommand, GroupState
from drivers.factory import make_drive_group
from executor.control.sync_master import SyncMaster
from model.rig import load_rig, rig_from_document
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.cli.plans import RIG

_CHANNELS = itertools.count()
FOLLOWING, HOLDING = DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE
LATENESS = np.round(np.arange(0.0, 6.001, 0.05), 2).tolist()
FINE = 0.0005


class LateClock:
    """Simulated time in which one cycle may begin late, or be delayed before its SYNC."""

    def __init__(self, cycle: float) -> None:
        self.cycle, self.now, self.time = cycle, 0.0, 0.0
        self.lateness = 0.0

    def next_cycle(self) -> float:
        late, self.lateness = self.lateness, 0.0
        self.now += (1.0 + late) * self.cycle
        self.time = self.now
        return late

    def time_left(self) -> float:
        return 0.0

    def wait_to_decide(self) -> None:
        pass


class Late:
    """Enabled drives and their master."""

    def __init__(self, rehearsal: SimulatedCia402Rig, master: SyncMaster, clock: LateClock) -> None:
        self.rehearsal, self.master, self.clock = rehearsal, master, clock
        self.group = master.group
        self.found: set[DriveState] = set()
        self.returned: list[int] = []
        self.watches = False
        for drive in rehearsal.drives:
            self._listen(drive)

    def _listen(self, drive: SimulatedDrive) -> None:
        """Keeps in which state control words find it, and those that take it out of quick stop."""
        takes = drive._take_control_word

        def take(word: int) -> None:
            before = drive.state
            takes(word)
            if self.watches:
                self.found.add(before)
            if self.watches and before is HOLDING and drive.state is FOLLOWING:
                self.returned.append(drive.node)

        drive._take_control_word = take  # type: ignore[method-assign]

    def enable(self) -> None:
        """Also after drives that stopped on their own have latched a fault."""
        if self.group.state is GroupState.FAULT:
            self.group.command(GroupCommand.RESET_FAULT)
            for _ in range(4):
                self.cycle()
        self.group.command(GroupCommand.ENABLE)
        for _ in range(20):
            self.cycle()
            if self.group.state is GroupState.ENABLED:
                return
        raise AssertionError(self.group.state)

    def pass_time(self, seconds: float) -> None:
        """No SYNC reaches the drives."""
        for _ in range(round(seconds / FINE)):
            self.rehearsal.advance(FINE)

    def cycle(self) -> None:
        """As in the loop."""
        lateness = self.master.begin()
        if self.master.rule.may_enable(1.0 + lateness):
            self.master.exchange(self.group.targets.tolist())
        else:
            self.master.stop_now()
            self.group.receive(0.0)


@contextmanager
def enabled_drives(cycle_ms: float) -> Iterator[Late]:
    document = load_rig(RIG).document
    bus = document.bus.model_copy(update={"cycle_ms": cycle_ms})
    rig = rig_from_document(document.model_copy(update={"bus": bus}))
    settings = BusSettings("virtual", f"late-{next(_CHANNELS)}")
    with open_bus(settings) as near, open_bus(settings) as far:
        rehearsal = SimulatedCia402Rig(rig, far, rig.home)
        group = make_drive_group(rig, near, rehearsal.pump)
        group.configure()
        clock = LateClock(cycle_ms / 1000.0)
        master = SyncMaster(rig, group, clock)
        master.read_positions()
        yield Late(rehearsal, master, clock)


@pytest.mark.parametrize("held_up", ["before its set-points", "before its SYNC"])
@pytest.mark.parametrize("cycle_ms", [4.0, 10.0, 25.0])
def test_no_lateness_enables_a_drive_again(cycle_ms: float, held_up: str) -> None:
    with enabled_drives(cycle_ms) as late:
        went_on, stopped_by_themselves = [], []
        for lateness in LATENESS:
            late.watches = False
            late.enable()
            late.cycle()
            late.watches = True
            late.found.clear()
            late.pass_time(lateness * late.clock.cycle)
            if held_up == "before its SYNC":
                late.clock.now += lateness * late.clock.cycle
            else:
                late.clock.lateness = lateness
            late.cycle()
            if HOLDING in late.found:
                stopped_by_themselves.append(lateness)
            for _ in range(3):
                late.cycle()
            assert late.returned == [], f"{lateness} cycles late"
            states = {drive.state for drive in late.rehearsal.drives}
            assert states in ({FOLLOWING}, {HOLDING})
            if states == {FOLLOWING}:
                went_on.append(lateness)
                late.group.command(GroupCommand.QUICK_STOP)
                for _ in range(4):
                    late.cycle()
        assert went_on == LATENESS[: len(went_on)]
        assert went_on[-1] == pytest.approx(1.475, abs=0.03), "1.5 but for rounding"
        assert stopped_by_themselves[0] == pytest.approx(2.0, abs=0.11)
        assert stopped_by_themselves[-1] == LATENESS[-1]


@pytest.mark.parametrize("held_up", [1.6, 2.5, 4.0])
def test_a_master_held_up_after_its_last_look_stops_the_drives_at_once(held_up: float) -> None:
    """Nothing can be revoked then; the stop follows before another SYNC."""
    with enabled_drives(10.0) as late:
        late.enable()
        late.cycle()
        send, passed = late.group._cyclic.send, []  # type: ignore[attr-defined]

        def held_up_before_sync(frames: object) -> None:
            if frames == (late.group._frames.sync,) and not passed:  # type: ignore[attr-defined]
                passed.append(held_up)
                late.rehearsal.pump()
                late.pass_time(held_up * late.clock.cycle)
                late.clock.now += held_up * late.clock.cycle
            send(frames)

        late.group._cyclic.send = held_up_before_sync  # type: ignore[attr-defined]
        late.cycle()
        assert passed == [held_up]
        assert late.master.overdue == pytest.approx(1.0 + held_up)
        assert {drive.state for drive in late.rehearsal.drives} == {HOLDING}
        for _ in range(3):
            late.cycle()
        assert {drive.state for drive in late.rehearsal.drives} == {HOLDING}


def test_lateness_that_enables_nothing_is_not_a_fault() -> None:
    """Drives that are only read, or hold on their own, are not affected by a late SYNC."""
    with enabled_drives(10.0) as late:
        late.pass_time(2.0 * late.clock.cycle)
        late.clock.now += 2.0 * late.clock.cycle
        late.master.rest()
        assert late.master.overdue == 0.0
        late.enable()
        late.group.command(GroupCommand.QUICK_STOP)
        for _ in range(4):
            late.cycle()
        late.clock.now += 2.0 * late.clock.cycle
        late.master.rest()
        assert late.master.overdue == 0.0
        assert {drive.state for drive in late.rehearsal.drives} == {HOLDING}
