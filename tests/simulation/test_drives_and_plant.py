"""Drives and plant together: platform and torques follow the drums."""

from __future__ import annotations

import errno
import itertools
import threading
from collections.abc import Iterator

import can
import numpy as np
import pytest

from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.state_machine import DriveState
from drivers.drive_group import DriveGroup, GroupCommand, GroupState
from drivers.factory import make_drive_group
from model.errors import Refused
from model.kinematics import cable_lengths
from model.pose import Pose
from model.rig import Rig, load_rig, rig_from_document
from model.statics.gravity import working_tensions
from simulation.drives.behaviour import behaviour_named
from simulation.drives.cia402_rig import SimulatedCia402Rig
from simulation.drives.odrive import SimulatedOdriveRig
from simulation.ground_truth import PowerLoss
from simulation.plant import Plant
from simulation.rig import RehearsalStatus
from tests.drivers.odrive_bench import odrive_bench, odrive_rig

_CHANNELS = itertools.count()


@pytest.fixture
def channel() -> BusSettings:
    return BusSettings("virtual", f"rehearsal-{next(_CHANNELS)}")


def targets_for(
    robot: Rig, rehearsal: SimulatedCia402Rig | SimulatedOdriveRig, pose: Pose
) -> list[int]:
    winch_map = rehearsal.plant.winch_map
    tensions = working_tensions(robot, pose).tensions
    unstrained = winch_map.unstrained(cable_lengths(robot, pose), tensions)
    return [int(count) for count in np.rint(winch_map.counts(unstrained))]


def enabled(robot: Rig, group: DriveGroup, rehearsal: SimulatedCia402Rig) -> list[int]:
    """Enables the drives; returns their positions."""
    group.configure()
    start = [int(p) for p in group.read_positions().positions]
    group.command(GroupCommand.ENABLE)
    for _ in range(10):
        group.send_cycle(start)
        group.receive(0.0)
    assert group.state is GroupState.ENABLED
    return start


@pytest.mark.parametrize("file", ["gachon_8_6", "hall_10_6", "open_frame_8_6"])
def test_a_cable_that_is_slack_on_a_stand_is_so_however_elastic_it_is(
    file: str, channel: BusSettings
) -> None:
    robot = load_rig(f"configs/{file}.yaml")
    with open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(robot, bus, robot.home)
        plant, motors = rehearsal.plant, [drive.motor for drive in rehearsal.drives]
        taut = Plant(robot, robot.home).tensions
        PowerLoss.drawn(robot, 1, 0.005, on_a_stand=True).apply_to(robot, plant, motors)
        plant.settle_counts(np.array([motor.position for motor in motors]))
    assert (taut > 0.0).all()
    assert (plant.tensions == 0.0).all()
    assert plant.pose.distance_to(robot.home) == pytest.approx(0.0, abs=1e-9)


def circle(robot: Rig, cycles: int) -> Iterator[Pose]:
    """A circle of 4 mm radius through home, at most 0.25 mm a cycle."""
    for cycle in range(cycles + 1):
        angle = 2.0 * np.pi * cycle / cycles
        offset = 0.004 * np.array([1.0 - np.cos(angle), np.sin(angle), 0.0])
        yield Pose.level(robot.home.position + offset)


@pytest.mark.parametrize("which", ["rig", "pulley_rig"])
def test_platform_is_where_the_set_points_of_the_cycle_before_put_it(
    request: pytest.FixtureRequest, channel: BusSettings, which: str
) -> None:
    robot: Rig = request.getfixturevalue(which)
    with open_bus(channel) as master, open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(robot, bus, robot.home)
        group = make_drive_group(robot, master, rehearsal.pump)
        enabled(robot, group, rehearsal)
        before, felt = robot.home, rehearsal.tensions
        for pose in circle(robot, 100):
            group.send_cycle(targets_for(robot, rehearsal, pose))
            status = group.receive(0.0)
            assert np.array_equal(status.positions, status.demands)
            # Counts are whole: the platform is off by a fraction of a count of cable.
            assert rehearsal.pose.distance_to(before) < 3e-5
            rated = np.array([w.torque_constant for w in robot.winches])
            shown = status.torques / 1000.0 * rated
            # A torque is that of the SYNC before: the answer does not wait for the platform.
            assert shown == pytest.approx(felt, abs=rated[0] / 1000.0)
            felt = rehearsal.tensions
            assert felt.min() > 0.5 * robot.min_tension
            before = pose


def test_two_rehearsals_are_the_same_to_the_last_bit(rig: Rig) -> None:
    runs = []
    for _ in range(2):
        settings = BusSettings("virtual", f"rehearsal-{next(_CHANNELS)}")
        with open_bus(settings) as master, open_bus(settings) as bus:
            rehearsal = SimulatedCia402Rig(rig, bus, rig.home)
            group = make_drive_group(rig, master, rehearsal.pump)
            enabled(rig, group, rehearsal)
            for pose in circle(rig, 60):
                group.send_cycle(targets_for(rig, rehearsal, pose))
                group.receive(0.0)
            runs.append(np.append(rehearsal.pose.matrix().ravel(), rehearsal.tensions))
    assert np.array_equal(*runs)


def test_a_start_away_from_home_is_where_the_drives_say(rig: Rig, channel: BusSettings) -> None:
    start = Pose.level(rig.home.position + np.array([0.1, -0.05, 0.08]))
    with open_bus(channel) as master, open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(rig, bus, start)
        group = make_drive_group(rig, master, rehearsal.pump)
        group.configure()
        read = group.read_positions().positions.tolist()
        assert read == targets_for(rig, rehearsal, start)
        assert rehearsal.pose.distance_to(start) < 1e-5


def test_without_torque_the_brakes_hold_the_platform(rig: Rig, channel: BusSettings) -> None:
    with open_bus(channel) as master, open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(rig, bus, rig.home)
        group = make_drive_group(rig, master, rehearsal.pump)
        start = enabled(rig, group, rehearsal)
        before = rehearsal.pose
        for drive in rehearsal.drives:  # the emergency stop
            drive.state = DriveState.SWITCH_ON_DISABLED
        for _ in range(10):
            group.send_cycle(start)
            status = group.receive(0.0)
        assert (status.torques == 0).all()
        assert rehearsal.pose.distance_to(before) < 1e-9


class ManualTime:
    """A manual clock that ends the service after some readings."""

    def __init__(self, stop: threading.Event, readings: int, step: float) -> None:
        self._stop, self._left, self._step, self._now = stop, readings, step, 0.0

    def __call__(self) -> float:
        self._left -= 1
        if self._left <= 0:
            self._stop.set()
        self._now += self._step
        return self._now


def test_served_drives_stop_by_themselves_when_the_master_is_gone(
    rig: Rig, channel: BusSettings
) -> None:
    """No frame arrives; the time-outs depend only on the clock."""
    stop, statuses = threading.Event(), list[RehearsalStatus]()
    with open_bus(channel) as master, open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(rig, bus, rig.home)
        group = make_drive_group(rig, master, rehearsal.pump)
        enabled(rig, group, rehearsal)
        clock = ManualTime(stop, readings=20, step=0.005)
        rehearsal.serve(stop.is_set, statuses.append, status_period=0.02, clock=clock)
    assert statuses
    assert statuses[0].states == (DriveState.OPERATION_ENABLED,) * 8
    assert statuses[-1].states == (DriveState.QUICK_STOP_ACTIVE,) * 8
    assert statuses[-1].pose.distance_to(rig.home) < 1e-5


def test_other_frames_on_the_bus_do_not_hold_the_time_outs_up(
    rig: Rig, channel: BusSettings
) -> None:
    """A tool that reads objects all the time must not keep a dead master's drives moving."""
    stop = threading.Event()
    with open_bus(channel) as master, open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(rig, bus, rig.home)
        group = make_drive_group(rig, master, rehearsal.pump)
        enabled(rig, group, rehearsal)
        for _ in range(100):  # the bus is never idle
            master.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        clock = ManualTime(stop, readings=50, step=0.001)
        rehearsal.serve(stop.is_set, clock=clock)
        assert {d.state for d in rehearsal.drives} == {DriveState.QUICK_STOP_ACTIVE}


@pytest.mark.parametrize("happens", ["hearing", "sending"])
def test_an_interface_that_goes_down_is_silence_to_served_drives(
    rig: Rig, channel: BusSettings, monkeypatch: pytest.MonkeyPatch, happens: str
) -> None:
    def down(*_: object) -> None:
        raise can.CanOperationError("Network is down", errno.ENETDOWN)

    stop = threading.Event()
    with open_bus(channel) as master, open_bus(channel) as bus:
        rehearsal = SimulatedCia402Rig(rig, bus, rig.home)
        group = make_drive_group(rig, master, rehearsal.pump)
        enabled(rig, group, rehearsal)
        monkeypatch.setattr(bus, "recv" if happens == "hearing" else "send", down)
        rehearsal.serve(stop.is_set, clock=ManualTime(stop, readings=20, step=0.005))
        assert {d.state for d in rehearsal.drives} == {DriveState.QUICK_STOP_ACTIVE}


def test_serving_ends_quietly_on_an_interrupt_from_the_keyboard(
    rig: Rig, channel: BusSettings
) -> None:
    def interrupted() -> float:
        raise KeyboardInterrupt

    with open_bus(channel) as bus:
        SimulatedCia402Rig(rig, bus, rig.home).serve(threading.Event().is_set, clock=interrupted)


def test_set_points_that_come_one_by_one_never_leave_the_platform_between_two_cycles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Eight ODrives receive those of a cycle within a millisecond; inertia averages over it."""
    stop, statuses = threading.Event(), list[RehearsalStatus]()
    with odrive_bench(odrive_rig()) as bench:
        bench.enable()
        rig, rehearsal = bench.rig, bench.rehearsal
        arrivals: list[can.Message | None] = []
        for pose in circle(rig, 100):
            bench.group.send_cycle(targets_for(rig, rehearsal, pose))
            for frame in bench.frames():
                arrivals += [frame, None]
            arrivals += [None] * 8
        coming = iter(arrivals)
        monkeypatch.setattr("simulation.rig.receive_frame", lambda *_: next(coming, None))
        clock = ManualTime(stop, readings=3 * len(arrivals), step=0.0004)
        rehearsal.serve(stop.is_set, statuses.append, status_period=0.0, clock=clock)
    tensions = np.array([status.tensions for status in statuses])
    assert np.abs(np.diff(tensions, axis=0)).max() < 5.0


def test_no_set_up_makes_a_drive_that_monitors_its_limits_release_its_cable(
    rig: Rig, channel: BusSettings
) -> None:
    """As after `cdpr home --as-rig-file` over another reference: the drives hold outside."""
    document = rig.document
    moved = [w.model_copy(update={"home_counts": w.home_counts + 10**6}) for w in document.winches]
    other = rig_from_document(document.model_copy(update={"winches": moved}))
    behaviour = behaviour_named(["limits-monitored"])
    with open_bus(channel) as near, open_bus(channel) as far:
        rehearsal = SimulatedCia402Rig(rig, far, rig.home, behaviour=behaviour)
        group = make_drive_group(rig, near, rehearsal.pump)
        enabled(rig, group, rehearsal)
        group.command(GroupCommand.QUICK_STOP)
        for _ in range(10):
            group.send_cycle(group.targets.tolist())
            group.receive(0.0)
        with pytest.raises(Refused, match="outside its position limits"):
            make_drive_group(other, near, rehearsal.pump).configure()
        rehearsal.advance(0.05)
        assert {d.state for d in rehearsal.drives} == {DriveState.QUICK_STOP_ACTIVE}
