"""The CiA 402 state machine of the simulated drive: every state, every command, by level."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.cia402.state_machine import DriveState
from tests.simulation.drive_line import DISABLED, ENABLED, FAULT, ON, READY, STOPPED, Line, ready

PATHS = {
    DISABLED: [],
    READY: [0x06],
    ON: [0x06, 0x07],
    ENABLED: [0x06, 0x07, 0x0F],
    STOPPED: [0x06, 0x07, 0x0F, 0x02],
}
WORDS = {"shutdown": 0x06, "switch on": 0x07, "enable": 0x0F, "quick stop": 0x02, "voltage": 0x00}

# CiA 402-2, figure "state machine" and table "command coding"; 605Ah is 6.
TABLE = [
    (DISABLED, "shutdown", READY),  # 2
    (DISABLED, "switch on", DISABLED),
    (DISABLED, "enable", DISABLED),
    (DISABLED, "quick stop", DISABLED),
    (DISABLED, "voltage", DISABLED),
    (READY, "shutdown", READY),
    (READY, "switch on", ON),  # 3
    (READY, "enable", ENABLED),  # 3 and 4
    (READY, "quick stop", DISABLED),  # 7
    (READY, "voltage", DISABLED),  # 7
    (ON, "shutdown", READY),  # 6
    (ON, "switch on", ON),
    (ON, "enable", ENABLED),  # 4
    (ON, "quick stop", DISABLED),  # 10
    (ON, "voltage", DISABLED),  # 10
    (ENABLED, "shutdown", READY),  # 8
    (ENABLED, "switch on", ON),  # 5
    (ENABLED, "enable", ENABLED),
    (ENABLED, "quick stop", STOPPED),  # 11
    (ENABLED, "voltage", DISABLED),  # 9
    (STOPPED, "shutdown", STOPPED),
    (STOPPED, "switch on", STOPPED),
    (STOPPED, "enable", ENABLED),  # 16
    (STOPPED, "quick stop", STOPPED),
    (STOPPED, "voltage", DISABLED),  # 12
]


def in_state(state: int, **options: int) -> Line:
    line = Line()
    line.set_up(**options)
    for word in PATHS[state]:
        line.sync(word)
    assert line.sync(None) == state
    return line


@pytest.mark.parametrize(("before", "command", "after"), TABLE)
def test_each_command_in_each_state(before: int, command: str, after: int) -> None:
    assert in_state(before).state_after(WORDS[command]) == after


@pytest.mark.parametrize(("before", "command", "after"), TABLE)
def test_a_command_that_was_given_before_acts_again(before: int, command: str, after: int) -> None:
    """By level: the word that the drive has already, repeated after the state has changed."""
    line = in_state(before)
    line.drive._control_word = WORDS[command]
    assert line.state_after(WORDS[command]) == after


@pytest.mark.parametrize("state", PATHS)
def test_a_fault_leads_to_fault_from_every_state(state: int) -> None:
    line = in_state(state)
    line.drive.fail(0x2310)
    for word in (0x06, 0x07, 0x0F, 0x02, 0x00):
        assert line.state_after(word) == FAULT
    assert line.state_after(0x80) == DISABLED


@pytest.mark.parametrize("option", [5, 6, 7, 8])
def test_a_stopped_drive_is_enabled_by_level_where_605a_lets_it_hold(option: int) -> None:
    line = in_state(ENABLED, stop_option=option)
    line.drive.advance(0.031)
    assert line.drive.state is DriveState.QUICK_STOP_ACTIVE
    assert line.state_after(0x0F) == ENABLED


@pytest.mark.parametrize("option", [0, 1, 2, 3, 4])
def test_a_drive_that_lets_go_after_its_quick_stop_is_not_enabled_by_level(option: int) -> None:
    line = in_state(ENABLED, stop_option=option)
    line.sync(0x02)
    line.drive.advance(0.001)
    assert line.drive.state is DriveState.SWITCH_ON_DISABLED
    assert line.state_after(0x0F) == DISABLED


def test_a_control_word_by_sdo_acts_at_once() -> None:
    line = in_state(ON)
    assert line.abort(0x6040, 0, "<H", 0x0F) == 0
    assert line.drive.state is DriveState.OPERATION_ENABLED


def test_fault_reaction_0_lets_go_at_once() -> None:
    line = in_state(ENABLED)
    line.write(0x605E, 0, "<h", 0)
    line.drive.fail(0x2310)
    assert line.drive.state is DriveState.FAULT


def test_without_a_mode_nothing_moves() -> None:
    line = Line()
    line.set_up()
    line.write(0x6060, 0, "<b", 0)
    line.enable()
    line.sync(0x0F, 1300)
    line.sync(0x0F)
    assert line.drive.motor.position == 1000
    assert not line.word & 0x1000  # bit 12: follows the command value
    assert line.abort(0x6060, 0, "<b", 1) == 0x06090030  # not in 6502h


EVENTS = st.one_of(
    st.tuples(st.just("frame"), st.sampled_from([0x205, 0x305]), st.binary(max_size=8)),
    st.tuples(st.just("word"), st.integers(0, 0xFF), st.integers(-(2**31), 2**31 - 1)),
    st.tuples(st.just("sdo"), st.binary(min_size=8, max_size=8)),
    st.tuples(
        st.just("write"),
        st.sampled_from([0x1006, 0x1016, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6060, 0x6007, 0x6085]),
        st.integers(0, 3),
        st.sampled_from([1, 2, 4]),
        st.integers(0, 2**32 - 1),
    ),
    st.tuples(st.just("nmt"), st.sampled_from([1, 2, 0x80, 0x81, 0x82, 7])),
    st.tuples(st.just("sync")),
    st.tuples(st.just("time"), st.floats(0.0, 0.2)),
    st.tuples(st.just("heartbeat"), st.binary(max_size=2)),
    st.tuples(st.just("fault"), st.integers(1, 0xFFFF)),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(EVENTS, max_size=40))
def test_no_frame_breaks_it_and_it_is_always_in_a_state_of_the_standard(events: list) -> None:
    line = ready()
    drive = line.drive
    drive.on_heartbeat(127, b"\x05")
    for kind, *values in events:
        if kind == "frame":
            drive.on_pdo(*values)
        elif kind == "word":
            drive.on_pdo(0x205, struct.pack("<Hih", *values, 0))
        elif kind == "sdo":
            drive.on_sdo(values[0])
        elif kind == "write":
            index, sub, length, value = values
            line.ask(0x23 | (4 - length) << 2, index, sub, struct.pack("<I", value)[:length])
        elif kind == "nmt":
            drive.on_nmt(values[0], 5)
        elif kind == "sync":
            drive.on_sync()
        elif kind == "time":
            drive.advance(values[0])
        elif kind == "heartbeat":
            drive.on_heartbeat(127, values[0])
        else:
            drive.fail(values[0])
        code = drive.status_word
        assert code & 0x4F in (0x40, 0x00, 0x0F, 0x08) or code & 0x6F in (0x21, 0x23, 0x27, 0x07)
        assert abs(drive.motor.position) <= 2**31
        assert drive.torque_on or drive.motor.speed == 0.0
    assert all(len(data) <= 8 and 0 <= can_id <= 0x7FF for can_id, data in line.sent)
