"""The group of eight drives on a bus: set-up, enabling, motion, stops and faults."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.can_bus import BusSettings
from drivers.cia402.object_dictionary import PDO_NO_RTR, Setting, settings_for
from drivers.cia402.pdo import NmtCommand, NmtState
from drivers.cia402.profile import load_profile
from drivers.cia402.sdo import SetupNetwork
from drivers.cia402.state_machine import DriveState, state_of
from drivers.drive_group import GroupCommand, GroupState
from drivers.factory import make_drive_group
from drivers.setup_refusals import TorqueLost
from model.errors import Fault, HardwareMissing, Refused
from model.files.rig_file import RigDocument
from model.rig import Rig, rig_from_document
from simulation.drives.behaviour import STRICT
from simulation.drives.cia402 import SimulatedDrive
from simulation.drives.cia402_rig import SimulatedCia402Rig
from tests.drivers.drive_bench import Bench, three_on_a_bus

HOLDING = DriveState.QUICK_STOP_ACTIVE


class TestFromSetUpToPowerOff:
    """All steps, the same on every kind of bus."""

    def test_configure_enable_follow_stop_disable(self, served_bench: Bench) -> None:
        bench = served_bench
        group = bench.group
        assert group.state is GroupState.OFFLINE
        group.configure()
        bench.before_cycle()
        start = group.read_positions().positions
        assert group.state is GroupState.CONFIGURED
        assert not start.flags.writeable
        group.command(GroupCommand.ENABLE)
        bench.until(GroupState.ENABLED)
        assert all(d.state is DriveState.OPERATION_ENABLED for d in bench.drives)
        bench.until_tensions_are_felt()

        def height(cycle: int) -> float:
            """A millimetre up and down again, [m]."""
            return 0.0005 * (1.0 - math.cos(2.0 * math.pi * cycle / 50))

        for cycle in range(51):
            status = bench.cycle(bench.lifted(height(cycle)))
            assert not status.missing.any()
            assert not status.faults
            # At a SYNC an ideal drive is at the set-point of the previous cycle.
            assert np.abs(status.positions - status.demands).max() <= 1
            assert (status.torques > 0).all()  # positive is pulling
        group.command(GroupCommand.QUICK_STOP)
        for _ in range(3):
            status = bench.cycle()
        assert status.holding
        assert group.state is GroupState.QUICK_STOP
        stood = [drive.motor.position for drive in bench.drives]
        group.command(GroupCommand.RELEASE)
        bench.until(GroupState.RELEASED)
        assert all(d.state is DriveState.READY_TO_SWITCH_ON for d in bench.drives)
        assert not bench.status.holding
        assert [drive.motor.position for drive in bench.drives] == pytest.approx(stood, abs=1)

    def test_stop_now_needs_no_further_cycle(self, served_bench: Bench) -> None:
        bench = served_bench
        bench.enable()
        bench.before_cycle()
        bench.group.quick_stop_now()
        bench.group.receive(5.0)  # replies of the stop's own SYNC
        network = SetupNetwork(bench.group._bus, None, range(1, 9))
        for node in range(1, 9):
            word = network.client(node).read(0x6041, 0, "status word")
            assert state_of(int.from_bytes(word, "little")) is HOLDING
        assert bench.group.state is GroupState.QUICK_STOP


def test_set_up_is_read_back_and_reaches_the_drives(bench: Bench) -> None:
    bench.group.configure()
    winch_map = bench.rehearsal.plant.winch_map
    for drive in range(8):
        final = needed(settings_for(bench.rig, drive, winch_map))
        for key, value in final.items():
            kept = bench.drives[drive].objects[key]
            if key == (0x1800, 1):  # bit 30 is the drive's own affair
                assert (kept ^ value) & ~PDO_NO_RTR == 0
            else:
                assert kept == value
        assert bench.drives[drive].objects[0x1401, 1] & 1 << 31  # unused process data are off


def test_drives_that_were_listed_in_another_order_are_set_up_again(bench: Bench) -> None:
    """As after a killed run: a drive refuses a node that another entry of 1016h has."""
    bench.group.configure()
    document = bench.rig.document.model_dump()
    winches = document["winches"]
    winches[1]["node_id"], winches[5]["node_id"] = 6, 2
    other = rig_from_document(RigDocument.model_validate(document))
    before = bench.drives[0].objects[0x1016, 2]
    make_drive_group(other, bench.group._bus, bench.rehearsal.pump).configure()
    assert bench.drives[0].objects[0x1016, 2] >> 16 == 6
    assert before >> 16 == 2


def test_heartbeats_are_watched_only_once_all_drives_send_them_in_time(bench: Bench) -> None:
    """Peers that still sent one per second were missed, EMCY 8130h, while they were set up."""
    bench.rehearsal.behaviour = slow = replace(STRICT, sdo_delay=0.02)
    sent: list[int] = []
    for drive in bench.drives:
        drive.behaviour = slow
        drive.power_on()
        drive.objects[0x1017, 0] = 1000
        send = drive._bus_send
        drive._bus_send = lambda i, d, send=send: (sent.append(i), send(i, d))
    bench.group.configure()
    assert not [identifier for identifier in sent if 0x80 < identifier < 0x100]
    assert {drive.objects[0x1016, 8] & 0xFFFF for drive in bench.drives} == {100}


def test_a_drive_may_need_some_time_until_it_answers_sync(bench: Bench) -> None:
    bench.group.configure()
    late, cycles = bench.drives[4], itertools.count(1)
    late.silent = True

    def pace() -> float:
        late.silent = next(cycles) < 150  # 1.5 s at 100 Hz
        return 0.0

    status = bench.group.read_positions(pace)
    assert not status.missing.any()
    assert next(cycles) > 150


def without_following(drive: SimulatedDrive, hidden: list[bool]) -> None:
    """Bit 12 of its status word stays 0 while the list says so, as while a brake opens."""
    drive.objects.measured(
        *(0x6041, 0), lambda: drive.status_word & ~0x1000 if hidden[0] else drive.status_word
    )


def test_set_points_wait_until_all_drives_say_that_they_follow(bench: Bench) -> None:
    hidden = [True]
    without_following(bench.drives[3], hidden)
    profile = bench.group._profile.model_copy(update={"follows_bit": True})  # type: ignore[attr-defined]
    bench.group._profile = profile  # type: ignore[attr-defined]
    bench.group.configure()
    bench.group.read_positions()
    stood = bench.group.targets.tolist()
    bench.group.command(GroupCommand.ENABLE)
    for _ in range(50):
        bench.cycle([target + 100 for target in stood])
    assert {drive.state for drive in bench.drives} == {DriveState.OPERATION_ENABLED}
    assert bench.group.state is GroupState.ENABLING
    assert np.abs(bench.group.targets - stood).max() <= 1
    hidden[0] = False
    bench.until(GroupState.ENABLED)


def fault_of_enabling(bench: Bench, limit: int) -> tuple[int, str]:
    """Node and text of the only fault when the drives are enabled, after at most so many cycles."""
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.FAULT, limit=limit)
    assert bench.status is not None
    (fault,) = bench.status.faults
    return fault


def test_a_drive_that_never_follows_is_named(bench: Bench) -> None:
    without_following(bench.drives[3], [True])
    profile = bench.group._profile.model_copy(update={"follows_bit": True})  # type: ignore[attr-defined]
    bench.group._profile = profile  # type: ignore[attr-defined]
    node, text = fault_of_enabling(bench, limit=150)
    assert node == 4
    assert "ignores its target" in text
    assert "follows_bit" in text


def test_nothing_is_sent_before_configure(bench: Bench) -> None:
    with pytest.raises(Refused, match="not configured"):
        bench.group.send_cycle([0] * 8)
    with pytest.raises(Refused, match="not configured"):
        bench.group.command(GroupCommand.ENABLE)
    assert bench.control_words() == []


@pytest.mark.parametrize(("silent", "words"), [([2], "drive 3 does"), ([0, 6], "drives 1, 7 do")])
def test_drives_that_do_not_answer_are_named(bench: Bench, silent: list[int], words: str) -> None:
    for drive in silent:
        bench.drives[drive].silent = True
    with pytest.raises(HardwareMissing, match=words):
        bench.group.configure()
    assert bench.group.state is GroupState.OFFLINE


def test_a_drive_that_falls_silent_after_set_up_is_named(bench: Bench) -> None:
    bench.group.configure()
    bench.drives[4].silent = True
    with pytest.raises(HardwareMissing, match="drive 5"):
        bench.group.read_positions()


def test_a_drive_power_cycled_since_its_configuration_is_reported(bench: Bench) -> None:
    assert bench.group.restarted == ()
    bench.group.configure()
    assert bench.group.restarted == tuple(range(1, 9)), "never set up"
    bench.group.configure()
    assert bench.group.restarted == ()
    bench.drives[4].power_on()
    bench.group.configure()
    assert bench.group.restarted == (5,)


def restart(drive: SimulatedDrive) -> None:
    """With its process data and mode stored by the maker's tool, so that it answers SYNC."""
    kept = {
        key: value
        for key, value in drive.objects.values().items()
        if (0x1400 <= key[0] < 0x1C00 or key == (0x6060, 0)) and isinstance(value, int)
    }
    drive.power_on()
    for key, value in kept.items():
        drive.objects[key] = value


def restarts_after(drive: SimulatedDrive, writes: int) -> None:
    """It restarts once, after this many downloads, or after START with 0."""
    take, command, left = drive.on_sdo, drive.on_nmt, [writes or -1]

    def on_sdo(data: bytes) -> None:
        take(data)
        if data[0] & 0xE0 == 0x20 and left[0] > 0:
            left[0] -= 1
            if not left[0]:
                restart(drive)

    def on_nmt(code: int, node: int) -> None:
        command(code, node)
        if code == NmtCommand.START and node == drive.node and left[0] < 0:
            left[0] = 0
            restart(drive)
            command(code, node)  # a drive that starts itself (1F80h)

    drive.on_sdo, drive.on_nmt = on_sdo, on_nmt  # type: ignore[method-assign,assignment]


@pytest.mark.parametrize("writes", [0, 1, 15, 22, 30, 31, 36, 40])
@pytest.mark.parametrize("node", [3, 8])
def test_a_drive_that_restarts_during_its_set_up_is_refused(
    bench: Bench, node: int, writes: int
) -> None:
    """It was enabled without abort option, quick stop option and supervision."""
    reported: list[tuple[int, ...]] = []
    bench.group.configure()
    restarts_after(bench.drives[node - 1], writes)
    with pytest.raises(Refused, match=f"drive {node} restarted during set-up"):
        bench.group.configure(on_restarted=reported.append)
    assert reported == [(), (node,)], "an incremental encoder has lost its reference"
    assert bench.group.restarted == (node,)
    with pytest.raises(Refused, match="not configured"):
        bench.group.command(GroupCommand.ENABLE)
    bench.control_words()
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.ENABLED)
    assert bench.drives[node - 1].objects[0x6007, 0] == 3


def test_a_restart_after_start_shows_without_its_boot_up_too(bench: Bench) -> None:
    drive = bench.drives[4]
    send = drive._bus_send
    drive._bus_send = lambda i, data: None if i == 0x705 else send(i, data)
    restarts_after(drive, 0)
    with pytest.raises(Refused, match="drive 5 restarted during set-up"):
        bench.group.configure()


def test_a_restart_after_the_set_up_latches_before_anything_is_enabled(bench: Bench) -> None:
    """The frames that came after START were discarded."""
    bench.group.configure()
    restart(bench.drives[4])
    bench.drives[4].on_nmt(NmtCommand.START, 5)
    bench.group.read_positions()
    with pytest.raises(Refused, match="restarted: its configuration and position are lost"):
        bench.group.command(GroupCommand.ENABLE)


@pytest.mark.parametrize("command", [NmtCommand.PRE_OPERATIONAL, NmtCommand.START])
def test_a_set_up_that_releases_a_cable_ends_at_the_first_one(
    bench: Bench, command: NmtCommand
) -> None:
    """All eight dropped the platform as they left NMT operational; they were enabled again."""

    def releases(drive: SimulatedDrive) -> None:
        take = drive.on_nmt

        def on_nmt(code: int, node: int) -> None:
            take(code, node)
            if (code, node) == (command, drive.node) and drive.state is HOLDING:
                drive.state = DriveState.SWITCH_ON_DISABLED

        drive.on_nmt = on_nmt  # type: ignore[method-assign]

    bench.enable()
    bench.group.command(GroupCommand.QUICK_STOP)
    for _ in range(3):
        bench.cycle()
    for drive in bench.drives[2:]:
        releases(drive)
    with pytest.raises(TorqueLost, match="drive 3 held its cable before the set-up and is now in"):
        bench.group.configure()
    states = [drive.state for drive in bench.drives]
    held = 2 if command is NmtCommand.START else 7  # all are started before they are read
    assert states.count(HOLDING) == held
    assert states[2] is DriveState.SWITCH_ON_DISABLED
    with pytest.raises(Refused, match="not configured"):
        bench.group.command(GroupCommand.ENABLE)


def test_an_emergency_during_the_set_up_explains_the_fault(bench: Bench) -> None:
    command, drive = bench.drives[4].on_nmt, bench.drives[4]

    def on_nmt(code: int, node: int) -> None:
        command(code, node)
        if code == NmtCommand.START and node == 5:
            drive.fail(0x3210)

    drive.on_nmt = on_nmt  # type: ignore[method-assign]
    bench.group.configure()
    ((node, text),) = bench.group.read_positions().faults
    assert node == 5
    assert "DC link over-voltage (error 3210h)" in text


def test_what_cannot_be_noted_is_not_wiped_out(bench: Bench) -> None:
    """Only the missing configuration shows that drives restarted."""
    reported: list[tuple[int, ...]] = []

    def not_kept(nodes: tuple[int, ...]) -> None:
        reported.append(nodes)
        raise Refused("the homing reference cannot be written")

    bench.group.configure()
    bench.drives[4].power_on()
    for _ in range(2):
        with pytest.raises(Refused, match="cannot be written"):
            bench.group.configure(on_restarted=not_kept)
    assert reported == [(5,), (5,)]


def needed(settings: Sequence[Setting]) -> dict[tuple[int, int], int]:
    """Final values of every drive; an inhibit time only where it exists."""
    kept = {(s.index, s.sub): s.value for s in settings if not s.transient}
    return {key: value for key, value in kept.items() if key != (0x1800, 3)}


def written_objects(bench: Bench) -> dict[tuple[int, int], int]:
    """Final values of node 6."""
    settings_of_6 = settings_for(bench.rig, 5, bench.rehearsal.plant.winch_map)
    written = needed(settings_of_6)
    return {**written, (0x1016, 1): 127 << 16 | 100, (0x1016, 8): 8 << 16 | 100}


def test_every_object_that_is_not_kept_refuses_to_arm(bench: Bench) -> None:
    """Wrong read-back of each object in turn; node and object are named."""
    objects = written_objects(bench)
    assert len(objects) > 25
    drive = bench.drives[5]
    for key, value in objects.items():
        if key in ((0x1400, 1), (0x1800, 1), (0x1600, 0), (0x1A00, 0)):
            continue  # a PDO that stays switched on refuses its mapping; the next test
        drive.power_on()
        drive.objects[key] = 0xFF if key == (0x1400, 2) else 0 if value else 1
        drive.objects.stuck.add(key)
        with pytest.raises(Refused) as caught:
            bench.group.configure()
        assert f"drive 6, object {key[0]:04X}h:{key[1]:02X}" in caught.value.where
        assert "is required" in caught.value.what
        assert bench.group.state is GroupState.OFFLINE


def stuck_mode(drive: SimulatedDrive) -> None:
    drive.objects.measured(0x6061, 0, lambda: 0)


@pytest.mark.parametrize("kept", [0, 2, 240, 241, 254, 255])
@pytest.mark.parametrize("refuses", [True, False])
def test_any_synchronous_type_of_an_rpdo_is_one(bench: Bench, kept: int, refuses: bool) -> None:
    """Trinamic's PD42-1140 takes 0, 254 and 255; the drives may also keep another."""
    for drive in bench.drives:
        if refuses:
            drive.behaviour = replace(STRICT, ranges={(0x1400, 2): (kept, kept)})
            drive.power_on()
        else:
            drive.objects[0x1400, 2] = kept
            drive.objects.stuck.add((0x1400, 2))
    if kept > (0 if refuses else 240):
        with pytest.raises(Refused, match="1400h:02 PDO transmission type"):
            bench.group.configure()
        return
    bench.enable()
    assert {drive.objects[0x1400, 2] for drive in bench.drives} == {kept}


def test_a_reply_must_follow_every_sync(bench: Bench) -> None:
    for drive in bench.drives:
        drive.objects[0x1800, 2] = 0
        drive.objects.stuck.add((0x1800, 2))
    with pytest.raises(Refused, match="1800h:02 PDO transmission type"):
        bench.group.configure()


def clamped_ramp(drive: SimulatedDrive) -> None:
    write = drive.objects.changed

    def clamp(key: tuple[int, int], value: int) -> None:
        if key == (0x6085, 0):
            drive.objects.note(key, min(value, 1000))
        write(key, value)

    drive.objects.changed = clamp


@pytest.mark.parametrize(
    ("wrong", "said"),
    [(stuck_mode, "mode_display_when_enabled"), (clamped_ramp, "the drive has 1000")],
)
@pytest.mark.parametrize("count", [1, 2])
def test_a_refusal_says_whether_the_drives_were_changed(
    bench: Bench, wrong: Callable[[SimulatedDrive], None], said: str, count: int
) -> None:
    bench.drives[7].objects[0x607C, 0] = 1  # refused before anything is written
    with pytest.raises(Refused) as caught:
        bench.group.configure()
    assert "the drives were not changed" in caught.value.next_step
    bench.drives[7].objects[0x607C, 0] = 0
    for drive in bench.drives[:count]:
        wrong(drive)
    with pytest.raises(Refused) as caught:
        bench.group.configure()
    assert said in str(caught.value)
    assert "not changed" not in str(caught.value)
    assert "not finished: the drives are in NMT pre-operational" in caught.value.next_step
    assert {drive.nmt for drive in bench.drives} == {NmtState.PRE_OPERATIONAL}


def test_every_object_that_is_refused_refuses_to_arm(bench: Bench) -> None:
    drive = bench.drives[5]
    for key in [*written_objects(bench), (0x1000, 0), (0x6502, 0), (0x6061, 0)]:
        drive.power_on()
        drive.objects.refusals[key] = 0x08000022
        with pytest.raises(Refused, match="present device state") as caught:
            bench.group.configure()
        assert f"drive 6, object {key[0]:04X}h:{key[1]:02X}" in caught.value.where


def test_a_node_that_is_no_servo_drive_is_refused(bench: Bench) -> None:
    bench.drives[1].objects[0x1000, 0] = 0x00020191  # an input/output module
    with pytest.raises(Refused, match="drive has") as caught:
        bench.group.configure()
    assert "drive 2" in caught.value.where


def test_a_drive_that_is_enabled_already_is_refused(bench: Bench) -> None:
    bench.drives[3].state = DriveState.OPERATION_ENABLED
    with pytest.raises(Refused, match="drive 4 is enabled already"):
        bench.group.configure()


def test_enabling_moves_nothing_whatever_targets_are_given(bench: Bench) -> None:
    bench.group.configure()
    start = bench.group.read_positions().positions
    bench.group.command(GroupCommand.ENABLE)
    while bench.group.state is not GroupState.ENABLED:
        bench.cycle([int(p) + 50_000 for p in start])
    assert bench.group.targets.tolist() == start.tolist()
    assert [round(d.motor.position) for d in bench.drives] == start.tolist()


def test_all_are_enabled_at_the_same_sync(bench: Bench) -> None:
    """Drives in different states wait for each other, one that holds in quick stop too."""
    bench.group.configure()
    bench.drives[0].state = DriveState.SWITCHED_ON
    bench.drives[1].state = HOLDING
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    while bench.group.state is not GroupState.ENABLED:
        bench.cycle()
        enabled = [d.state is DriveState.OPERATION_ENABLED for d in bench.drives]
        assert all(enabled) or not any(enabled)


def test_a_fault_of_one_while_moving_stops_the_others(bench: Bench) -> None:
    bench.enable()
    bench.drives[2].fail(0x2310)
    for _ in range(3):
        bench.cycle()
    states = [d.state for d in bench.drives]
    assert states == [HOLDING] * 2 + [DriveState.FAULT] + [HOLDING] * 5
    assert bench.group.state is GroupState.FAULT
    reported = [text for node, text in bench.status.faults if node == 3]
    assert len(reported) == 1, "the emergency, and not its state once more"
    assert "over-current" in reported[0]


def test_a_fault_is_latched_until_it_is_reset(bench: Bench) -> None:
    bench.enable()
    bench.drives[2].fail(0x2310)
    for _ in range(50):
        bench.cycle()
    assert bench.group.state is GroupState.FAULT
    assert bench.drives[2].state is DriveState.FAULT  # no reset by itself
    for command in (GroupCommand.ENABLE, GroupCommand.RELEASE):
        with pytest.raises(Refused, match="latched"):
            bench.group.command(command)
    with pytest.raises(Refused, match="while other drives hold"):
        bench.group.command(GroupCommand.RESET_FAULT)
    for drive in bench.drives:  # the operator's emergency stop takes the torque off
        if drive.state is HOLDING:
            drive.state = DriveState.SWITCH_ON_DISABLED
    bench.cycle()
    bench.group.command(GroupCommand.RESET_FAULT)
    bench.cycle()
    bench.cycle()
    assert bench.status.faults == ()
    assert bench.drives[2].state is not DriveState.FAULT
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.ENABLED)


@pytest.mark.parametrize("stores", [True, False])
@pytest.mark.parametrize("set_up_again", [True, False])
def test_a_reset_that_fails_states_the_cause(
    bench: Bench, stores: bool, set_up_again: bool
) -> None:
    """No emergency was said to have been received: the reset had deleted it."""
    bench.enable()
    drive, take = bench.drives[2], bench.drives[2]._take_control_word
    drive._take_control_word = lambda word: take(word & ~0x80)  # type: ignore[method-assign]
    if not stores:
        drive.objects.refusals[0x603F, 0] = 0x06020000
    drive.fail(0x3210)
    for _ in range(3):
        bench.cycle()
    for each in bench.drives:  # the operator's emergency stop takes the torque off
        if each.state is HOLDING:
            each.state = DriveState.SWITCH_ON_DISABLED
    bench.cycle()
    if set_up_again:
        bench.group.close()
        bench.group.configure(to_reset=True)
        bench.group.read_positions()
    bench.group.command(GroupCommand.RESET_FAULT)
    for _ in range(120):
        bench.cycle()
    assert bench.status is not None
    ((node, text),) = bench.status.faults
    assert node == 3
    over_voltage = "DC link over-voltage (error 3210h)"
    if stores:
        assert text == f"cable 3 (drive 3) is in fault: {over_voltage}, as stored in the drive"
    elif set_up_again:
        assert text.endswith("no emergency message received")
    else:
        assert text == f"cable 3 (drive 3) is in fault: earlier: {over_voltage}"


def test_a_silent_drive_is_reported_every_cycle_and_left_to_the_executor(bench: Bench) -> None:
    bench.enable()
    bench.drives[7].silent = True
    for _ in range(4):
        assert bench.cycle().missing.tolist() == [False] * 7 + [True]
    assert bench.status.faults == ()


def test_a_drive_that_restarts_is_not_armed_again(bench: Bench) -> None:
    bench.enable()
    bench.drives[1].power_on()
    for _ in range(3):
        bench.cycle()
    assert any("restarted" in text for _, text in bench.status.faults)
    with pytest.raises(Refused, match="restarted"):
        bench.group.command(GroupCommand.RESET_FAULT)
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.ENABLED)


def test_a_restart_between_two_cycles_stops_the_others_in_the_next_frames(bench: Bench) -> None:
    """Seven drives were sent one more set-point, although the boot-up had come."""
    bench.enable()
    bench.drives[1].power_on()
    bench.rehearsal.pump()
    bench.control_words()
    bench.cycle(bench.lifted(0.0005))
    assert set(bench.control_words()) == {0x02}
    assert [d.state for d in bench.drives].count(HOLDING) == 7


def test_no_torque_is_taken_off_after_an_emergency(bench: Bench) -> None:
    """The others were released before the reply that said that one was in fault."""
    bench.enable()
    bench.group.command(GroupCommand.QUICK_STOP)
    bench.cycle()
    bench.group.command(GroupCommand.RELEASE)
    for _ in range(10):
        words = bench.cycle().status_words.tolist()
        if all(state_of(word) is DriveState.OPERATION_ENABLED for word in words):
            break
    bench.drives[3].fail(0x3210)
    bench.rehearsal.pump()
    bench.control_words()
    bench.cycle()
    assert set(bench.control_words()) == {0x02}
    assert bench.group.state is GroupState.FAULT
    for _ in range(5):
        bench.cycle()
    assert [d.state for d in bench.drives].count(HOLDING) == 7


@pytest.mark.parametrize("stopped", [True, False])
def test_torque_that_goes_while_drives_hold_is_a_fault_of_that_cycle(
    bench: Bench, stopped: bool
) -> None:
    """Safe torque off after the stop, or before anything was enabled: the drive is named."""
    bench.enable()
    bench.group.command(GroupCommand.QUICK_STOP)
    for _ in range(3):
        bench.cycle()
    if not stopped:
        bench.group.configure()
        bench.group.read_positions()
    bench.drives[6].state = DriveState.SWITCH_ON_DISABLED
    bench.cycle()
    reported = ((7, "cable 7 (drive 7) lost its torque: switch on disabled"),)
    assert bench.status.faults == reported
    assert bench.group.state is GroupState.FAULT


def test_a_drive_that_stopped_by_itself_stops_all_at_the_next_sync(bench: Bench) -> None:
    """How late 0Fh may be is the executor's to say; what a drive reports is heard in any case."""
    bench.enable()
    bench.drives[3]._quick_stop()
    bench.cycle()
    assert bench.group.state is GroupState.FAULT
    for _ in range(20):
        bench.cycle()
        assert DriveState.OPERATION_ENABLED not in [d.state for d in bench.drives]
    bench.group.command(GroupCommand.RESET_FAULT)
    assert bench.group.state is GroupState.QUICK_STOP
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.ENABLED)


def stops_when_enabled(drive: SimulatedDrive, times: int) -> list[int]:
    """Its limit switch is hit: quick stop in the SYNC that enables it, without an emergency."""
    enable, enabled = drive._command_enable, [0]

    def command_enable() -> None:
        enable()
        enabled[0] += 1
        if enabled[0] <= times:
            drive._quick_stop()

    drive._command_enable = command_enable  # type: ignore[method-assign]
    return enabled


@pytest.mark.parametrize("times", [1, 2, 99])
@pytest.mark.parametrize("held", [False, True])
def test_a_drive_that_stops_in_the_cycle_that_enables_it_is_named_alone(
    bench: Bench, times: int, held: bool
) -> None:
    """The seven others were blamed, and it was enabled three times while its switch was hit."""
    bench.group.configure()
    if held:  # the others hold the platform; it comes from the state SWITCHED ON
        for drive in bench.drives:
            drive.state = DriveState.SWITCHED_ON if drive.node == 3 else HOLDING
    bench.group.read_positions()
    enabled = stops_when_enabled(bench.drives[2], times)
    bench.group.command(GroupCommand.ENABLE)
    for _ in range(20):
        bench.cycle()
        assert bench.group.state is not GroupState.ENABLED
    assert bench.status is not None
    assert bench.status.faults == ((3, "cable 3 (drive 3) stopped on its own: quick stop active"),)
    assert enabled[0] == 2, "once more by the frames that were sent before its reply"
    assert {drive.state for drive in bench.drives} == {HOLDING}
    words = bench.control_words()
    first = words.index(0x0F)
    assert set(words[first : first + 16]) == {0x0F}
    assert set(words[first + 16 :]) == {0x02}


def test_a_drive_that_stops_after_every_reply_and_is_enabled_by_every_set_point_is_found(
    bench: Bench,
) -> None:
    """All its replies show operation enabled: the run went on to its end without an event."""
    bench.enable()
    drive = bench.drives[2]
    drive.behaviour = replace(STRICT, limit_switch=10.0)
    for cycle in range(40):
        status = bench.cycle(bench.lifted(0.00005 * cycle))
        if status.state is not GroupState.ENABLED:
            break
        assert {state_of(word) for word in status.status_words} == {DriveState.OPERATION_ENABLED}
    assert bench.status is not None
    ((node, text),) = bench.status.faults
    assert node == 3
    assert text.startswith("cable 3 (drive 3) stopped on its own: quick stop active")
    bench.control_words()
    for _ in range(3):
        bench.cycle()
    assert set(bench.control_words()) == {0x02}
    assert {each.state for each in bench.drives} == {HOLDING}


@pytest.mark.parametrize("judged", [None, True, False])
def test_a_drive_that_no_longer_follows_its_target_stops_all(
    bench: Bench, judged: bool | None
) -> None:
    """Where bit 12 means something else, the profile says so."""
    hidden = [False]
    without_following(bench.drives[3], hidden)
    profile = bench.group._profile.model_copy(update={"follows_bit": judged})  # type: ignore[attr-defined]
    bench.group._profile = profile  # type: ignore[attr-defined]
    bench.enable()
    bench.cycle()
    hidden[0] = True
    status = bench.cycle()
    if judged is False:
        assert status.state is GroupState.ENABLED
        return
    assert status.state is GroupState.FAULT
    ((node, text),) = status.faults
    assert node == 4
    assert "ceased to follow its target (bit 12 of 6041h" in text
    bench.cycle()
    bench.cycle()
    assert {drive.state for drive in bench.drives} == {HOLDING}


def test_a_drive_that_never_shows_that_it_follows_may_lack_the_bit(bench: Bench) -> None:
    without_following(bench.drives[3], [True])
    bench.enable()
    assert not any(bench.cycle().faults for _ in range(20))
    assert bench.group.state is GroupState.ENABLED


def test_an_answer_from_before_the_motion_is_no_state_of_it(bench: Bench) -> None:
    """A drive took its time to say that it held: it was asked at the end of the motion before."""
    bench.enable()
    watch = bench.group._watch  # type: ignore[attr-defined]
    bench.cycle()
    watch.take(0x581, bytes.fromhex("4b 41 60 00 17 02 00 00"))
    for _ in range(20):
        assert bench.cycle().faults == ()


def test_a_drive_that_falls_back_while_the_others_are_enabled_stops_them_once(
    bench: Bench,
) -> None:
    """Its mains failed after 0Fh: the others were stopped and enabled again without a fault."""
    bench.group.configure()
    bench.group.read_positions()
    drive = bench.drives[5]
    drive._command_enable = lambda: None  # type: ignore[method-assign]
    bench.group.command(GroupCommand.ENABLE)
    for _ in range(8):
        bench.cycle()
    assert [d.state for d in bench.drives].count(DriveState.OPERATION_ENABLED) == 7
    drive.state = DriveState.SWITCH_ON_DISABLED
    for _ in range(8):
        bench.cycle()
    assert bench.status is not None
    text = "cable 6 (drive 6) left switched on on its own: switch on disabled"
    assert bench.status.faults == ((6, text),)
    assert [d.state for d in bench.drives].count(HOLDING) == 7


@pytest.mark.parametrize("command", [GroupCommand.ENABLE, GroupCommand.RELEASE])
@pytest.mark.parametrize("cycles", [0, 1, 2, 3])
@pytest.mark.parametrize("enabling", [0, 3, 4, 5, 10])
def test_a_command_right_after_a_stop_finds_no_fault(
    bench: Bench, enabling: int, cycles: int, command: GroupCommand
) -> None:
    """The replies still showed drives enabled that had been commanded to stop."""
    bench.group.configure()
    bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    for _ in range(enabling):
        bench.cycle()
    bench.group.quick_stop_now()
    bench.group.receive(0.0)
    for _ in range(cycles):
        bench.cycle()
    bench.group.command(command)
    bench.until(
        GroupState.ENABLED if command is GroupCommand.ENABLE else GroupState.RELEASED, limit=40
    )


def test_a_cycle_that_may_not_enable_becomes_a_stop_of_all(bench: Bench) -> None:
    """Asked just before SYNC, when the drives hold set-points that would enable them again."""
    bench.enable()
    for drive in bench.drives:
        drive._quick_stop()  # their emergencies have not arrived yet
    bench.group.send_cycle(bench.group.targets.tolist(), lambda _enables: False)
    bench.rehearsal.pump()
    assert [d.state for d in bench.drives] == [HOLDING] * 8
    bench.group.receive(0.0)
    for _ in range(20):
        bench.cycle()
        assert [d.state for d in bench.drives] == [HOLDING] * 8
    assert bench.group.state is GroupState.QUICK_STOP


@pytest.mark.parametrize("refused", [1, 2])
def test_a_cycle_with_a_refused_frame_becomes_a_stop_of_all_before_sync(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, refused: int
) -> None:
    """SYNC follows at any age: it must not enable drives again that stopped on their own."""
    bench.enable()
    for drive in bench.drives:
        drive._quick_stop()  # their emergencies have not arrived yet
    send, frames = bench.group._bus.send, [0]

    def full_for_drive_3(message: can.Message) -> None:
        frames[0] += message.arbitration_id == 0x203
        if message.arbitration_id == 0x203 and frames[0] <= refused:
            raise can.CanOperationError("No buffer space available")
        send(message)

    monkeypatch.setattr(bench.group._bus, "send", full_for_drive_3)
    with pytest.raises(Fault, match="No buffer space"):
        bench.group.send_cycle(bench.group.targets.tolist())
    bench.rehearsal.pump()
    assert {d.state for d in bench.drives if d.node != 3 or refused == 1} == {HOLDING}
    assert bench.group.state is GroupState.QUICK_STOP
    bench.group.receive(0.0)
    for _ in range(20):
        bench.cycle()
        assert [d.state for d in bench.drives] == [HOLDING] * 8


def test_a_restarted_master_starts_from_where_the_drives_hold(bench: Bench) -> None:
    bench.enable()
    moved = bench.lifted(0.0002)
    for _ in range(3):
        bench.cycle(moved)
    bench.rehearsal.advance(0.05)
    held = [round(d.motor.position) for d in bench.drives]
    bench.group.close()
    bench.group.configure()
    assert bench.group.read_positions().positions.tolist() == held
    assert [d.state for d in bench.drives] == [HOLDING] * 8
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.ENABLED)
    assert np.abs(np.array(held) - [d.motor.position for d in bench.drives]).max() <= 1


def test_a_following_error_trips_the_drive_and_stops_all(bench: Bench) -> None:
    bench.enable()
    start = bench.group.targets
    bench.drives[0].motor.jammed = True
    step = int(bench.rig.winches[0].counts_per_metre * 0.0002)  # 20 mm/s
    for cycle in range(1, 40):
        bench.cycle((start + step * cycle).tolist())
        if bench.group.state is GroupState.FAULT:
            break
    assert any("following error" in text for _, text in bench.status.faults)
    for _ in range(3):
        bench.cycle()
    assert [d.state for d in bench.drives[1:]] == [HOLDING] * 7


def test_a_frame_that_the_bus_refuses_does_not_hold_up_the_stop(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.enable()
    bus = bench.group._bus
    send = bus.send

    def full_for_drive_3(message: can.Message) -> None:
        if message.arbitration_id == 0x203:
            raise can.CanOperationError("No buffer space available")
        send(message)

    monkeypatch.setattr(bus, "send", full_for_drive_3)
    with pytest.raises(Fault, match="No buffer space"):
        bench.group.quick_stop_now()
    assert bench.group.state is GroupState.QUICK_STOP
    bench.rehearsal.pump()
    assert [d.state for d in bench.drives] == [
        DriveState.OPERATION_ENABLED if d.node == 3 else HOLDING for d in bench.drives
    ]
    monkeypatch.undo()
    bench.cycle()
    assert bench.drives[2].state is HOLDING


def test_a_bus_that_fails_is_a_fault_of_ours(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """No exception of python-can leaks, and the message says what the drives do."""

    def down(timeout: float) -> None:
        raise can.CanOperationError("Network is down")

    bench.enable()
    bench.group.send_cycle(bench.group.targets.tolist())
    monkeypatch.setattr(bench.group._bus, "recv", down)
    with pytest.raises(Fault, match="Network is down") as caught:
        bench.group.receive(0.0)
    assert "stop on their own" in caught.value.next_step


def test_another_master_on_the_bus_is_refused(bench: Bench) -> None:
    say = bench.drives[0]._bus_send
    bench.drives[0]._bus_send = lambda i, d: (say(0x080, b""), say(i, d))
    with pytest.raises(Refused, match="another program sends SYNC"):
        bench.group.configure()


def test_replies_of_the_wrong_length_are_counted_and_not_used(bench: Bench) -> None:
    bench.enable()
    before = bench.status.positions
    send = bench.drives[0]._bus_send
    bench.drives[0]._bus_send = lambda can_id, data: send(can_id, data[:2])
    status = bench.cycle()
    assert status.missing[0]
    assert status.rejected == 1
    assert status.positions.tolist() == before.tolist()


def test_stale_replies_are_not_taken_for_new_ones(bench: Bench) -> None:
    bench.enable()
    start = bench.group.targets.tolist()
    moved = bench.lifted(0.0001)
    bench.cycle(moved)
    bench.group.send_cycle(moved)
    bench.rehearsal.pump()  # replies from the new position wait unread in the queue
    bench.drives[3].silent = True
    bench.group.send_cycle(moved)
    status = bench.group.receive(0.0)
    assert status.missing.tolist() == [False] * 3 + [True] + [False] * 4
    assert status.positions[3] == start[3]
    assert status.positions[2] == moved[2]


def test_torque_that_goes_without_a_word_stops_the_others(bench: Bench) -> None:
    """The safe-torque-off input of one drive: no emergency, only another state."""
    bench.enable()
    bench.drives[6].state = DriveState.SWITCH_ON_DISABLED
    for _ in range(2):
        bench.cycle()
    assert bench.status.faults == ((7, "cable 7 (drive 7) stopped on its own: switch on disabled"),)
    assert [d.state for d in bench.drives].count(HOLDING) == 7


def test_while_one_drive_is_slow_to_enable_the_others_hold_and_do_not_sag(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.group.configure()
    start = bench.group.read_positions().positions
    monkeypatch.setattr(bench.drives[7], "_command_enable", lambda: None)
    bench.group.command(GroupCommand.ENABLE)
    for _ in range(10):
        bench.cycle()
    assert bench.drives[0].state is DriveState.OPERATION_ENABLED
    bench.drives[0].motor.position += 50  # the load pulls it down a little, and keeps it there
    bench.drives[0].motor.jammed = True
    for _ in range(3):
        bench.cycle()
    assert bench.status.positions[0] == start[0] + 50
    assert bench.group.targets.tolist() == start.tolist()
    assert bench.group.state is GroupState.ENABLING
    bench.until(GroupState.FAULT, limit=120)
    assert bench.status.faults[0][0] == 8
    assert "instead of operation enabled" in bench.status.faults[0][1]
    bench.cycle()
    assert [d.state for d in bench.drives[:7]] == [HOLDING] * 7


def without_power(drive: SimulatedDrive) -> None:
    """Its mains is off, or safe torque off is active."""
    drive.state = DriveState.SWITCH_ON_DISABLED
    drive._command_shutdown = lambda: None  # type: ignore[method-assign]
    drive.objects.measured(0x6041, 0, lambda: drive.status_word & ~0x10)


def holding_but_one_without_power(bench: Bench) -> None:
    """Seven drives hold as after a run, the eighth cannot be enabled."""
    bench.group.configure()
    for drive in bench.drives[:7]:
        drive.state = HOLDING
    without_power(bench.drives[7])
    bench.group.read_positions()


def test_a_drive_without_power_alone_is_named_where_the_others_wait_for_it(bench: Bench) -> None:
    holding_but_one_without_power(bench)
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.FAULT, limit=150)
    assert bench.status is not None
    ((node, text),) = bench.status.faults
    assert node == 8
    assert "voltage enabled" in text
    assert 0x0F not in bench.control_words()


@pytest.mark.parametrize("powered", [True, False])
def test_a_drive_without_torque_does_not_keep_the_others_from_their_release(
    bench: Bench, powered: bool
) -> None:
    """It gets none, and they lose theirs together."""
    holding_but_one_without_power(bench)
    last = bench.drives[7]
    if powered:
        del last._command_shutdown
        last.objects.measured(0x6041, 0, lambda: last.status_word)
    stood = [drive.motor.position for drive in bench.drives]
    bench.group.command(GroupCommand.RELEASE)
    for _ in range(30):
        if bench.group.state is GroupState.RELEASED:
            break
        bench.cycle()
        assert not last.torque_on
        assert len({drive.torque_on for drive in bench.drives[:7]}) == 1
    assert bench.group.state is GroupState.RELEASED
    assert bench.status is not None
    assert bench.status.faults == ()
    assert [drive.motor.position for drive in bench.drives] == pytest.approx(stood, abs=1)


def test_no_drive_is_enabled_for_a_release_while_the_state_of_one_is_unknown(bench: Bench) -> None:
    holding_but_one_without_power(bench)
    bench.drives[7].objects.measured(0x6041, 0, lambda: 0x0200)
    bench.cycle()
    bench.group.command(GroupCommand.RELEASE)
    bench.until(GroupState.FAULT, limit=250)
    assert bench.status is not None
    assert [node for node, _ in bench.status.faults] == [8]
    assert set(bench.control_words()) == {0x02, 0x06}
    assert all(drive.state is HOLDING for drive in bench.drives[:7])


def shows_after_ready(drive: SimulatedDrive, code: int, replies: float) -> None:
    """From its next state *ready to switch on* it shows another code for some replies."""
    before, left = drive.state, 0.0

    def shown() -> int:
        nonlocal before, left
        if before is not DriveState.READY_TO_SWITCH_ON is drive.state:
            left = replies
        before = drive.state
        if left > 0 and drive.state is DriveState.READY_TO_SWITCH_ON:
            left -= 1
            return code
        return drive.status_word

    drive.objects.measured(0x6041, 0, shown)


@pytest.mark.parametrize("code", [0x0256, 0x0210])
@pytest.mark.parametrize("replies", [1, 2, 40])
def test_a_drive_in_passing_to_ready_is_not_taken_back(
    bench: Bench, code: int, replies: int
) -> None:
    """As 56h of a multi-axis drive: 02h undid each step, also after the code was gone."""
    bench.group.configure()
    shows_after_ready(bench.drives[2], code, replies)
    bench.status = bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.ENABLED, limit=replies + 15)
    assert bench.status is not None
    assert bench.status.faults == ()


def test_a_drive_that_stays_in_an_unknown_state_is_named_and_none_is_enabled(
    bench: Bench,
) -> None:
    bench.group.configure()
    shows_after_ready(bench.drives[2], 0x0256, math.inf)
    bench.status = bench.group.read_positions()
    bench.group.command(GroupCommand.ENABLE)
    bench.until(GroupState.FAULT, limit=115)
    assert bench.status is not None
    ((node, text),) = bench.status.faults
    assert node == 3
    assert "is in not ready to switch on instead of operation enabled after 1 s" in text
    assert 0x0F not in bench.control_words()
    bench.cycle()
    assert set(bench.control_words()) == {0x02}


def test_the_heartbeat_comes_from_the_loop(bench: Bench) -> None:
    """With it drives stay enabled; it is counted in cycles, so that a stuck loop sends none."""
    bench.enable()
    for drive in bench.drives:
        drive.objects[0x1006, 0] = 0  # neither SYNC nor set-points are watched
        drive.objects[0x1400, 5] = 0
    for _ in range(100):
        bench.cycle()
    assert bench.group.state is GroupState.ENABLED
    bench.rehearsal.advance(0.12)
    assert [d.state for d in bench.drives] == [HOLDING] * 8


COMMANDS = st.one_of(
    st.sampled_from(GroupCommand).map(lambda command: ("command", command)),
    st.just(("stop now", None)),
    st.integers(1, 8).map(lambda cycles: ("cycles", cycles)),
    st.integers(0, 7).map(lambda drive: ("fault", drive)),
    st.integers(0, 7).map(lambda drive: ("stops", drive)),
    st.integers(1, 6).map(lambda cycles: ("pause", cycles)),
)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(script=st.lists(COMMANDS, max_size=12))
def test_no_script_frees_a_cable_or_enables_some(bench: Bench, script: list) -> None:
    """Random commands, faults, stops of drives and pauses: words and states keep the rules."""
    for drive in bench.drives:
        drive.power_on()
    bench.group.close()
    bench.group.configure()
    bench.group.read_positions()
    words: list[int] = []
    for what, value in script:
        if what == "command":
            try:
                bench.group.command(value)
            except Refused:
                continue
        elif what == "stop now":
            bench.group.quick_stop_now()
        elif what == "fault":
            bench.drives[value].fail(0x7121)
        elif what == "stops":
            if bench.drives[value].state is DriveState.OPERATION_ENABLED:
                bench.drives[value]._quick_stop()
        elif what == "pause":
            bench.rehearsal.advance(0.01 * value)
        else:
            for _ in range(value):
                before = [d.torque_on for d in bench.drives]
                enabled_before = [d.state is DriveState.OPERATION_ENABLED for d in bench.drives]
                words += bench.control_words()
                bench.cycle()
                sent = bench.control_words()
                words += sent
                if bench.group.state is GroupState.ENABLED:
                    assert sent == [0x0F] * 8
                enabled = [d.state is DriveState.OPERATION_ENABLED for d in bench.drives]
                if any(new and not old for new, old in zip(enabled, enabled_before, strict=True)):
                    assert all(enabled)
                if bench.group.state is GroupState.FAULT:
                    lost = [
                        d.node
                        for d, held in zip(bench.drives, before, strict=True)
                        if held and not d.torque_on and d.state is not DriveState.FAULT
                    ]
                    assert not lost
    assert all(word & 0x02 for word in [*words, *bench.control_words()])


def leave_operational(bench: Bench, nodes: Sequence[int]) -> None:
    """Enabled drives fall back to NMT pre-operational: SDO works, process data does not."""
    bench.enable()
    for node in nodes:
        bench.drives[node - 1].on_nmt(NmtCommand.PRE_OPERATIONAL, node)
    for _ in range(20):
        bench.cycle()
    assert bench.group.state is GroupState.FAULT
    assert bench.drives[nodes[0] - 1].state is DriveState.OPERATION_ENABLED


def end_monitoring(bench: Bench) -> None:
    bench.group.command(GroupCommand.END_MONITORING)
    for _ in range(round(bench.group.capabilities.unmonitored_within / bench.rig.cycle)):
        if not bench.group.ending:
            break
        bench.cycle()
    assert not bench.group.ending


@pytest.mark.parametrize("nodes", [(5,), range(1, 9)])
def test_a_drive_without_process_data_is_stopped_by_sdo_before_its_monitoring_ends(
    bench: Bench, nodes: Sequence[int]
) -> None:
    leave_operational(bench, nodes)
    end_monitoring(bench)
    assert {drive.state for drive in bench.drives} == {HOLDING}
    assert not bench.group.is_monitored
    assert {drive.objects[0x1016, 1] for drive in bench.drives} == {0}


def ignores_words(drive: SimulatedDrive) -> None:
    drive._take_control_word = lambda _word: None  # type: ignore[method-assign]


def refuses_words(drive: SimulatedDrive) -> None:
    asked = drive.on_sdo

    def refuses(data: bytes) -> None:
        if data[1:4] == b"\x40\x60\0":
            drive._send(0x580 + drive.node, b"\x80" + data[1:4] + b"\x22\0\0\x08")
        else:
            asked(data)

    drive.on_sdo = refuses  # type: ignore[method-assign, assignment]


def hides_its_state(drive: SimulatedDrive) -> None:
    ignores_words(drive)
    drive.objects.measured(0x6041, 0, lambda: 0x0010)


@pytest.mark.parametrize("spoil", [ignores_words, refuses_words, hides_its_state])
def test_a_drive_that_sdo_does_not_stop_keeps_the_monitoring_that_stops_it(
    bench: Bench, spoil: Callable[[SimulatedDrive], None]
) -> None:
    leave_operational(bench, [5])
    drive = bench.drives[4]
    spoil(drive)
    kept = drive.objects[0x1016, 1], drive.objects[0x1006, 0]
    assert min(kept) > 0
    end_monitoring(bench)
    assert drive.state is DriveState.OPERATION_ENABLED
    assert bench.group.is_monitored
    assert (drive.objects[0x1016, 1], drive.objects[0x1006, 0]) == kept
    bench.rehearsal.advance(0.5)
    bench.rehearsal.pump()
    assert {drive.state for drive in bench.drives} == {HOLDING}


@pytest.fixture
def short_of_time(rig: Rig, tmp_path: Path) -> Iterator[Bench]:
    """A cycle as long as `enable_timeout_ms` and longer than `sdo_timeout_ms`."""
    profile = tmp_path / "profile.yaml"
    document = load_profile("cia402").model_dump(mode="json", exclude_defaults=True)
    document |= {"enable_timeout_ms": 100, "sdo_timeout_ms": 50}
    profile.write_text(yaml.safe_dump(document))
    drives = rig.document.drives.model_copy(update={"profile": str(profile)})
    bus = rig.document.bus.model_copy(update={"cycle_ms": 100.0})
    slow = rig.document.model_copy(update={"bus": bus})
    short = rig_from_document(slow.model_copy(update={"drives": drives}))
    with three_on_a_bus(BusSettings("virtual", "short-of-time")) as (master, far, ear):
        rehearsal = SimulatedCia402Rig(rig_from_document(slow), far, rig.home)
        yield Bench(short, make_drive_group(short, master, rehearsal.pump), rehearsal, ear)


def test_a_drive_has_all_of_its_time_to_enable_besides_the_control_words(
    short_of_time: Bench,
) -> None:
    """At 100 ms the words took 400 ms of it; below 350 ms no drive was ever enabled."""
    bench = short_of_time
    for drive in bench.drives:
        drive.behaviour = replace(drive.behaviour, enable_delay=0.1)
    bench.enable()


def test_a_drive_that_exceeds_its_time_to_enable_is_named_with_this_time(
    short_of_time: Bench,
) -> None:
    bench = short_of_time
    bench.drives[2].behaviour = replace(bench.drives[2].behaviour, enable_delay=60.0)
    node, text = fault_of_enabling(bench, limit=10)
    assert node == 3
    assert "after 0.1 s (enable_timeout_ms" in text


def test_all_states_are_read_in_cycles_longer_than_an_answer(short_of_time: Bench) -> None:
    """Two cycles were allowed for three requests, so that every run ended as not held."""
    bench = short_of_time
    bench.group.configure()
    bench.group.read_positions()
    bench.cycle()
    end_monitoring(bench)
    assert not bench.group.is_monitored
    assert not bench.group.read_state(lambda: 0.0).missing.any()
