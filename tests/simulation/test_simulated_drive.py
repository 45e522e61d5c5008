"""A simulated drive against CiA 301 and CiA 402, through its frames only; no master involved."""

from __future__ import annotations

import struct

import pytest

from drivers.cia402.profile import load_profile
from model.files.drive_profile_file import TorqueLimit
from simulation.drives.eds_file import profile_path, read_eds
from tests.simulation.drive_line import (
    CYCLE,
    DISABLED,
    ENABLED,
    FAULT,
    NODE,
    ON,
    READY,
    SPEED,
    STOPPED,
    Line,
    ready,
)


@pytest.fixture
def line() -> Line:
    line = Line()
    line.set_up()
    return line


def test_a_drive_that_is_switched_on_says_so_and_sends_no_process_data() -> None:
    line = Line()
    assert line.take(0x700 + NODE) == [b"\x00"]
    assert line.sync(0x06) is None


@pytest.mark.parametrize(
    ("words", "state"),
    [
        ([], DISABLED),
        ([0x06], READY),  # transition 2
        ([0x06, 0x07], ON),  # 3
        ([0x06, 0x07, 0x0F], ENABLED),  # 4
        ([0x06, 0x07, 0x0F, 0x07], ON),  # 5
        ([0x06, 0x07, 0x06], READY),  # 6
        ([0x06, 0x02], DISABLED),  # 7, quick stop
        ([0x06, 0x00], DISABLED),  # 7, disable voltage
        ([0x06, 0x07, 0x0F, 0x06], READY),  # 8
        ([0x06, 0x07, 0x0F, 0x00], DISABLED),  # 9
        ([0x06, 0x07, 0x00], DISABLED),  # 10
        ([0x06, 0x07, 0x0F, 0x02], STOPPED),  # 11
        ([0x06, 0x07, 0x0F, 0x02, 0x00], DISABLED),  # 12
        ([0x06, 0x07, 0x0F, 0x02, 0x0F], ENABLED),  # 16
        ([0x06, 0x07, 0x0F, 0x02, 0x06], STOPPED),  # no transition
        ([0x07], DISABLED),  # no transition
        ([0x0F], DISABLED),  # no transition
        ([0x06, 0x0F], ENABLED),  # 3 and 4 at once
        ([0x80], DISABLED),  # a reset without a fault
    ],
)
def test_transitions_of_the_standard(line: Line, words: list[int], state: int) -> None:
    for word in words:
        line.sync(word)
    assert line.sync(None) == state


def test_a_fault_needs_a_rising_edge_to_be_reset(line: Line) -> None:
    line.enable()
    line.set_point(0x8F)  # the bit is set already
    line.sync(None)
    line.drive.fail(0x2310)
    assert line.emergencies() == [0x2310]
    assert line.state_after(0x8F) == FAULT
    assert line.state_after(0x0F) == FAULT
    assert line.state_after(0x86) == DISABLED
    assert line.emergencies() == [0]


def test_a_set_point_acts_at_the_next_sync_and_is_reached_one_cycle_later(line: Line) -> None:
    line.enable()
    line.set_point(0x0F, 1100)
    line.drive.advance(CYCLE)
    assert line.drive.motor.position == 1000  # not before SYNC
    line.drive.on_sync()
    line.drive.advance(CYCLE / 2)
    assert line.drive.motor.position == pytest.approx(1050)  # interpolated over 60C2h
    line.drive.advance(CYCLE / 2)
    assert line.drive.motor.position == pytest.approx(1100)


def test_position_is_reported_before_it_is_enabled(line: Line) -> None:
    assert line.sync(0x06) == DISABLED
    assert line.position == 1000


def test_missing_sync_stops_the_drive_by_itself_and_it_holds(line: Line) -> None:
    line.enable()
    line.sync(0x0F, 1100)
    line.drive.advance(0.031)
    assert line.emergencies() == [0x8700]
    assert line.sync(None) == STOPPED
    assert line.emergencies() == [0x0000]  # SYNC is back
    assert line.drive.torque_on
    assert line.sync(None) == STOPPED


def test_a_late_enable_moves_a_drive_that_stopped_by_itself(line: Line) -> None:
    """Transition 16 is by level: the master must not send 0Fh to a drive that may have stopped."""
    line.enable()
    line.drive.advance(0.031)
    assert line.sync(0x0F, 1050) == STOPPED
    assert line.sync(None) == ENABLED
    line.drive.advance(CYCLE)
    assert line.drive.motor.position == 1050


def test_missing_set_points_stop_the_drive_although_sync_goes_on(line: Line) -> None:
    line.write(0x1400, 5, "<H", 30)
    line.enable()
    states = [line.sync(None) for _ in range(6)]
    assert states[-1] == STOPPED
    assert line.emergencies() == [0x8250]


@pytest.mark.parametrize(
    ("option", "state"), [(0, ENABLED), (1, FAULT), (2, DISABLED), (3, STOPPED)]
)
def test_what_a_lost_bus_does_is_set_by_6007(option: int, state: int) -> None:
    line = Line()
    line.set_up(abort_option=option)
    line.enable()
    line.drive.advance(0.035)
    line.drive.advance(CYCLE)
    assert line.sync(None) == state


def test_quick_stop_options_below_five_take_the_torque_off() -> None:
    line = Line()
    line.set_up(stop_option=2)
    line.enable()
    assert line.state_after(0x02) == DISABLED


def test_a_lost_master_heartbeat_stops_the_drive(line: Line) -> None:
    line.write(0x1016, 1, "<I", 127 << 16 | 100)
    line.write(0x1006, 0, "<I", 0)
    line.enable()
    line.drive.advance(0.5)
    assert line.sync(None) == ENABLED  # not watched before the first heartbeat
    line.drive.on_heartbeat(127, b"\x05")
    line.drive.on_heartbeat(9, b"\x05")  # not in 1016h
    line.drive.advance(0.09)
    line.drive.on_heartbeat(127, b"\x05")
    line.drive.advance(0.09)
    assert line.sync(None) == ENABLED
    line.drive.advance(0.02)
    assert line.emergencies() == [0x8130]
    assert line.drive.state.value == "quick stop active"
    assert line.sync(None) is None  # 1029h:01 is 0: pre-operational
    line.drive.on_heartbeat(127, b"\x05")
    assert line.emergencies() == [0x0000]


def test_own_heartbeat_is_produced(line: Line) -> None:
    line.write(0x1017, 0, "<H", 30)
    line.take(0x700 + NODE)
    for _ in range(31):
        line.drive.advance(CYCLE)
    assert line.take(0x700 + NODE) == [b"\x05"] * 11


def test_quick_stop_ramps_down_at_6085_and_holds(line: Line) -> None:
    line.write(0x6085, 0, "<I", 100_000)
    line.enable()
    for cycle in range(1, 6):
        line.sync(0x0F, 1000 + 100 * cycle)  # 10 000 counts/s
    line.sync(0x02)
    start = line.drive.motor.position
    for _ in range(20):
        line.sync(0x02)
    # v² / 2a with 10 000 counts/s and 100 000 counts/s²
    assert line.drive.motor.position - start == pytest.approx(500.0, rel=1e-6)
    assert line.drive.motor.speed == 0.0


def test_following_error_trips_after_its_time(line: Line) -> None:
    line.enable()
    line.drive.motor.jammed = True
    line.sync(0x0F, 1600)
    states = [line.sync(0x0F) for _ in range(6)]
    assert states[0] == ENABLED
    assert states[-1] == FAULT
    assert line.emergencies() == [0x8611]


def test_at_the_torque_limit_the_motor_does_not_wind_in_further(line: Line) -> None:
    line.write(0x6072, 0, "<H", 800)
    line.enable()
    line.drive.torque = -800.0  # holds a cable whose positive counts pay out
    line.sync(0x0F, 900)
    line.sync(0x0F)
    assert line.drive.motor.position == 1000  # winding in is refused
    line.sync(0x0F, 1050)
    line.sync(0x0F)
    assert line.drive.motor.position == 1050  # paying out is not


def test_a_torque_limit_is_in_the_unit_of_its_profile() -> None:
    limit = TorqueLimit(object="6073h:00", bytes=2, rated_value=819.0)
    profile = load_profile("akd").model_copy(update={"torque_limit": limit})
    line = ready(profile=profile, eds=read_eds(profile_path("akd")))
    line.write(0x6073, 0, "<H", 983)  # 1200 per mille
    line.enable()
    for torque, shown in ((-1199.0, 0x1000), (-1201.0, 0x1800)):
        line.drive.torque = torque
        line.sync(0x0F)
        assert line.word & 0x1800 == shown


def test_above_the_torque_limit_the_load_turns_the_motor_back(line: Line) -> None:
    line.enable()
    line.sync(0x0F, 1000)
    line.drive.torque = -900.0  # holds a cable whose positive counts pay out
    line.write(0x6072, 0, "<H", 901)
    line.sync(0x0F)
    assert line.drive.motor.position == 1000
    line.write(0x6072, 0, "<H", 890)
    line.sync(0x0F)
    slipped = line.drive.motor.position
    assert slipped > 1000
    line.drive.torque = -889.0
    line.sync(0x0F)
    assert 1000 < line.drive.motor.position < slipped  # comes back, against what it can hold
    line.drive.torque = 0.0
    for _ in range(20):
        line.sync(0x0F)
    assert line.drive.motor.position == 1000


def test_the_motor_is_no_faster_than_it_is(line: Line) -> None:
    line.enable()
    line.sync(0x0F, 1000 + 400_000)
    line.sync(0x0F)
    assert line.drive.motor.position - 1000 <= SPEED * CYCLE


def test_software_limits_hold(line: Line) -> None:
    line.write(0x607D, 2, "<i", 1040)
    line.enable()
    line.sync(0x0F, 1100)
    line.sync(0x0F)
    assert line.drive.motor.position == 1040


def test_a_target_beyond_the_software_limits_shows_in_the_status_word(line: Line) -> None:
    """Bit 11 internal limit active, bit 12 follows the command value; CiA 402-2, 6041h and CSP."""
    line.write(0x607D, 2, "<i", 1040)
    line.enable()
    seen = []
    for target in (1040, 1041, 1040, 1040):
        line.sync(0x0F, target)
        seen.append(line.word & 0x1800)
    assert seen == [0x1000, 0x1000, 0x0800, 0x1000]  # of the target at the SYNC before


def test_the_torque_limit_shows_in_the_status_word(line: Line) -> None:
    """The position loop still takes the target: bit 12 stays."""
    line.write(0x6072, 0, "<H", 800)
    line.enable()
    seen = []
    for torque in (-799.0, -800.0, -799.0):
        line.drive.torque = torque  # holds a cable whose positive counts pay out
        line.sync(0x0F)
        seen.append(line.word & 0x1800)
    assert seen == [0x1000, 0x1800, 0x1000]


def test_the_software_limits_never_cross(line: Line) -> None:
    line.drive.objects[0x607D, 1] = line.drive.objects[0x607D, 2] = 0
    assert line.abort(0x607D, 1, "<i", 5) == 0x06090036  # CiA 301: maximum less than minimum
    assert line.abort(0x607D, 2, "<i", -5) == 0x06090036
    assert line.abort(0x607D, 2, "<i", 9) == line.abort(0x607D, 1, "<i", 9) == 0
    assert (line.read(0x607D, 1), line.read(0x607D, 2)) == (9, 9)


def test_a_short_set_point_is_ignored_and_reported(line: Line) -> None:
    line.enable()
    line.drive.on_pdo(0x205, b"\0" * 6)
    assert line.sync(None) == ENABLED
    assert line.emergencies() == [0x8210]


@pytest.mark.parametrize(
    ("index", "sub", "abort"),
    [(0x5FFF, 0, 0x06020000), (0x60C2, 9, 0x06090011)],
)
def test_unknown_objects_are_refused(line: Line, index: int, sub: int, abort: int) -> None:
    reply = line.sdo(0x40, index, sub)
    assert reply[0] == 0x80
    assert struct.unpack_from("<I", reply, 4) == (abort,)


@pytest.mark.parametrize(
    ("index", "sub", "form", "value", "abort"),
    [
        (0x6041, 0, "<H", 0, 0x06010002),
        (0x6007, 0, "<i", 3, 0x06070010),
        (0x1600, 1, "<I", 0, 0x08000022),
        (0x60C2, 1, "<B", 0, 0x06090030),
    ],
)
def test_writes_that_the_standard_forbids_are_refused(
    line: Line, index: int, sub: int, form: str, value: int, abort: int
) -> None:
    reply = line.write(index, sub, form, value)
    assert reply[0] == 0x80
    assert struct.unpack_from("<I", reply, 4) == (abort,)


def test_a_reset_loses_the_set_up_and_keeps_the_position(line: Line) -> None:
    line.enable()
    line.sync(0x0F, 1234)
    line.sync(0x0F)
    line.take(0x700 + NODE)
    line.drive.on_nmt(0x81, NODE)
    assert line.take(0x700 + NODE) == [b"\x00"]
    assert line.sync(0x0F) is None
    assert not line.drive.torque_on
    assert line.drive.motor.position == 1234
    assert line.sdo(0x40, 0x6007, 0)[4] == 1


def test_a_silent_drive_hears_and_says_nothing(line: Line) -> None:
    line.enable()
    line.drive.silent = True
    line.sent.clear()
    assert line.sync(0x00) is None
    line.drive.on_nmt(0x81, NODE)
    line.drive.on_sdo(bytearray(8))
    assert line.sent == []
