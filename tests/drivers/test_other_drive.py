"""The master moves a drive without shared code, based only on the standards."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import pytest

from drivers.can_bus import BusSettings
from drivers.drive_group import DriveGroup, GroupCommand, GroupState
from drivers.factory import make_drive_group, nodes_present
from model.errors import Refused
from model.rig import Rig, load_rig
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.drivers.drive_bench import SteppedClock, three_on_a_bus
from tests.drivers.other_drive import ENABLED, STOPPING, OtherDrive

ROOT = Path(__file__).resolve().parents[2]
_CHANNELS = itertools.count()
NODE, INDEX = 4, 3
MOST = 100


@contextmanager
def beside_others(
    rig: Rig, *, late: float = 0.0, missing: frozenset[int] = frozenset()
) -> Iterator[tuple[DriveGroup, OtherDrive, SteppedClock]]:
    """Seven of our simulated drives, and as node 4 one of another maker."""
    clock = SteppedClock(rig.document.bus.cycle_ms / 1000.0)
    over = threading.Event()
    with three_on_a_bus(BusSettings("virtual", f"other-{next(_CHANNELS)}")) as (near, far, third):
        rehearsal = SimulatedCia402Rig(rig, far, rig.home)
        rehearsal.drives[INDEX].silent = True
        start = round(rehearsal.drives[INDEX].motor.position)
        other = OtherDrive(third, NODE, start, late=late, missing=missing)
        ours = threading.Thread(
            target=rehearsal.serve, args=(over.is_set,), kwargs={"clock": clock}
        )
        ours.start()
        try:
            yield make_drive_group(rig, near), other, clock
        finally:
            over.set()
            ours.join()
            other.close()


def until(group: DriveGroup, clock: SteppedClock, state: GroupState) -> None:
    for _ in range(MOST):
        if group.state is state:
            return
        clock.tick()
        group.send_cycle(group.targets.tolist())
        group.receive(5.0)
    pytest.fail(f"still {group.state} after {MOST} cycles: {group.receive(0.0).faults}")


@pytest.mark.parametrize(
    ("file", "can_id"),
    [
        ("gachon_8_6", 0x583),
        ("gachon_8_6", 0x703),
        ("gachon_8_6", 0x083),
        ("gachon_8_6_odrive", 0x061),
    ],
)
def test_a_drive_is_present_by_whatever_it_sends(file: str, can_id: int) -> None:
    rig = load_rig(ROOT / "configs" / f"{file}.yaml")
    with three_on_a_bus(BusSettings("virtual", f"other-{next(_CHANNELS)}")) as (near, far, _):
        far.send(can.Message(arbitration_id=can_id, data=bytes(8), is_extended_id=False))
        far.send(can.Message(arbitration_id=can_id + 0x001E, is_extended_id=False))  # no drive's
        assert nodes_present(rig, near, 0.05) == {3}


@pytest.mark.parametrize("late", [0.0, 0.004])
def test_it_is_set_up_enabled_moved_and_stopped(rig: Rig, late: float) -> None:
    with beside_others(rig, late=late) as (group, other, clock):
        remarks = group.configure()
        for missing in ("1007h", "1029h", "605Ch", "605Eh", "1016h has 2"):
            assert any(missing in remark for remark in remarks), remarks
        start = group.read_positions().positions[INDEX]
        assert start == other.position
        group.command(GroupCommand.ENABLE)
        until(group, clock, GroupState.ENABLED)
        assert other.state == ENABLED
        targets = group.targets.tolist()
        for _ in range(10):
            targets[INDEX] += 5
            clock.tick()
            group.send_cycle(targets)
            status = group.receive(5.0)
        assert other.position == start + 50
        assert status.positions[INDEX] == start + 45, "reported before the set-point acts"
        assert status.state is GroupState.ENABLED
        group.quick_stop_now()
        until(group, clock, GroupState.QUICK_STOP)
        clock.tick()
        group.send_cycle(targets)
        group.receive(5.0)
        assert other.state == STOPPING
        assert all(word & 0x02 for word in other.words), "never disable voltage"
        assert not any(word & 0x80 for word in other.words), "never a fault reset"


@pytest.mark.parametrize("index", [0x6007, 0x605A, 0x6072, 0x1006])
def test_what_the_master_relies_on_must_be_there(rig: Rig, index: int) -> None:
    with beside_others(rig, missing=frozenset({index})) as (group, _, _clock):
        with pytest.raises(Refused) as caught:
            group.configure()
        assert "drive 4" in caught.value.where
        assert caught.value.values["abort_code"]
