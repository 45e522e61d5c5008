"""A master and a simulated rig on one bus, both in this process."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can
import numpy as np
import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.drive_group import CycleStatus, DriveGroup, GroupCommand, GroupState
from model.kinematics import cable_lengths
from model.pose import Pose
from model.rig import Rig
from model.statics.gravity import working_tensions
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.cia402_rig import SimulatedCia402Rig


def make_reply(status_word: int, position: int, torque: int) -> bytes:
    """TPDO1: 6041h status word, 6064h position actual [counts], 6077h torque [per mille]."""
    return struct.pack("<Hih", status_word, position, torque)


def parse_set_point(data: bytes | bytearray) -> tuple[int, int] | None:
    """Control word and target of an RPDO1; None if the length is wrong."""
    return struct.unpack("<Hi", data) if len(data) == 6 else None


class Bench:
    """Master, drives and a listener for every control word."""

    def __init__(
        self, rig: Rig, group: DriveGroup, rehearsal: SimulatedCia402Rig, ear: can.BusABC
    ) -> None:
        self.rig, self.group, self.rehearsal, self._ear = rig, group, rehearsal, ear
        self.status: CycleStatus | None = None
        self.before_cycle: Callable[[], None] = lambda: None
        self.reply_timeout = 0.0

    @property
    def drives(self) -> tuple[SimulatedDrive, ...]:
        return self.rehearsal.drives

    def cycle(self, targets: list[int] | None = None) -> CycleStatus:
        """One cycle; without targets the drives keep their last targets."""
        self.before_cycle()
        self.group.send_cycle(self.group.targets.tolist() if targets is None else targets)
        self.status = self.group.receive(self.reply_timeout)
        return self.status

    def until(self, state: GroupState, limit: int = 30) -> int:
        """Cycles until the group is in a state."""
        for count in range(limit):
            if self.group.state is state:
                return count
            self.cycle()
        faults = self.status.faults if self.status else ()
        pytest.fail(f"not {state} after {limit} cycles but {self.group.state}; {faults}")

    def until_tensions_are_felt(self, limit: int = 1000) -> None:
        """Cycles until every reply tells of a pulling cable.

        Drives that are served feel their cables while nothing is to be answered, so how many cycles
        that takes depends on how busy this computer is.
        """
        for _ in range(limit):
            if (self.cycle().torques > 0).all():
                return
        pytest.fail(f"no torques after {limit} cycles: {self.status}")

    def enable(self) -> None:
        self.group.configure()
        self.status = self.group.read_positions()
        self.group.command(GroupCommand.ENABLE)
        self.until(GroupState.ENABLED)

    def lifted(self, height: float) -> list[int]:
        """Targets with the platform this much above home, [m], under its working tensions."""
        pose = Pose.level(self.rig.home.position + np.array([0.0, 0.0, height]))
        tensions = working_tensions(self.rig, pose).tensions
        winch_map = self.rehearsal.plant.winch_map
        unstrained = winch_map.unstrained(cable_lengths(self.rig, pose), tensions)
        return [int(count) for count in np.rint(winch_map.counts(unstrained))]

    def control_words(self) -> list[int]:
        """Every control word sent since the last call."""
        words = []
        while (message := self._ear.recv(0)) is not None:
            if 0x200 < message.arbitration_id <= 0x27F:
                parsed = parse_set_point(message.data)
                assert parsed is not None
                words.append(parsed[0])
        return words


@contextmanager
def three_on_a_bus(settings: BusSettings) -> Iterator[tuple[can.BusABC, can.BusABC, can.BusABC]]:
    buses: list[can.BusABC] = []
    try:
        for _ in range(3):
            buses.append(open_bus(settings))
        yield buses[0], buses[1], buses[2]
    finally:
        for bus in buses:
            bus.shutdown()


def free_udp_channel() -> str:
    """A loopback multicast channel separate from other test runs on this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return f"239.74.163.2:{probe.getsockname()[1]}"


class SteppedClock:
    """Clock of drives served by a thread, which advances one cycle per cycle sent."""

    def __init__(self, cycle: float) -> None:
        self.cycle, self.now = cycle, 0.0

    def tick(self) -> None:
        self.now += self.cycle

    def __call__(self) -> float:
        return self.now
