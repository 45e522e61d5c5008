"""Golden bytes of every frame, and refusal of frames of another length."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402 import pdo as frames
from drivers.cia402.pdo import (
    CyclicFrames,
    NmtCommand,
    NmtState,
    commanding_ids,
    foreign_master_message,
    is_command,
    make_emergency,
    make_heartbeat,
    make_nmt,
    make_set_point,
    make_sync,
    parse_emergency,
    parse_heartbeat,
    parse_reply,
)
from drivers.cia402.state_machine import ControlWord


def test_golden_bytes() -> None:
    assert make_set_point(0x000F, 0x01020304).hex() == "0f0004030201"
    assert make_set_point(0x0002, -2).hex() == "0200feffffff"
    assert parse_reply(bytes.fromhex("3712ffffffffe803")) == (0x1237, -1, 1000)
    assert make_sync() == b""
    assert make_heartbeat(NmtState.OPERATIONAL) == b"\x05"
    assert make_nmt(NmtCommand.START, 3) == b"\x01\x03"
    assert make_nmt(NmtCommand.PRE_OPERATIONAL, 0) == b"\x80\x00"
    assert make_emergency(0x8611, 1).hex() == "1186010000000000"


def test_identifiers_are_those_of_the_standard() -> None:
    """CiA 301, table "pre-defined connection set", written out, as no other test checks these."""
    assert frames.NMT_ID == 0x000
    assert frames.SYNC_ID == 0x080
    assert frames.EMCY_BASE == 0x080
    assert frames.TPDO1_BASE == 0x180
    assert frames.RPDO1_BASE == 0x200
    assert frames.SDO_REPLY_BASE == 0x580
    assert frames.SDO_REQUEST_BASE == 0x600
    assert frames.HEARTBEAT_BASE == 0x700
    assert frames.MASTER_NODE == 127


def test_network_commands_and_states_are_those_of_the_standard() -> None:
    """CiA 301, tables "NMT service" and "NMT state of the heartbeat producer"."""
    assert {command.name: int(command) for command in NmtCommand} == {
        "START": 0x01,
        "STOP": 0x02,
        "PRE_OPERATIONAL": 0x80,
        "RESET_NODE": 0x81,
        "RESET_COMMUNICATION": 0x82,
    }
    assert {state.name: int(state) for state in NmtState} == {
        "BOOT_UP": 0x00,
        "STOPPED": 0x04,
        "OPERATIONAL": 0x05,
        "PRE_OPERATIONAL": 0x7F,
    }


def test_an_emergency_is_read_as_the_standard_lays_it_out() -> None:
    read = parse_emergency(bytes.fromhex("1186010a0b0c0d0e"))
    assert read == (0x8611, 0x01, bytes.fromhex("0a0b0c0d0e"))


@pytest.mark.parametrize(("byte", "state"), [(0x7F, 0x7F), (0xFF, 0x7F), (0x04, 4), (0x80, 0)])
def test_every_bit_of_a_heartbeat_but_the_toggle_bit_counts(byte: int, state: int) -> None:
    assert parse_heartbeat(bytes((byte,))) == state


@given(
    word=st.integers(0, 0xFFFF),
    position=st.integers(-(2**31), 2**31 - 1),
    torque=st.integers(-(2**15), 2**15 - 1),
)
def test_what_is_made_is_what_is_read(word: int, position: int, torque: int) -> None:
    assert parse_reply(struct.pack("<Hih", word, position, torque)) == (word, position, torque)
    assert struct.unpack("<Hi", make_set_point(word, position)) == (word, position)


@given(st.binary(max_size=64))
def test_frames_of_another_length_are_not_read(data: bytes) -> None:
    if len(data) != 8:
        assert parse_reply(data) is None
        assert parse_emergency(data) is None
    if len(data) != 1:
        assert parse_heartbeat(data) is None


@pytest.mark.parametrize("target", [2**31, -(2**31) - 1])
def test_a_target_beyond_32_bits_is_not_packed(target: int) -> None:
    with pytest.raises(struct.error):
        make_set_point(0x0F, target)


def test_heartbeat_toggle_bit_is_dropped() -> None:
    assert parse_heartbeat(b"\x85") == NmtState.OPERATIONAL


def test_the_frames_of_a_cycle_are_those_of_the_standard() -> None:
    """By literal identifiers; what was never filled in tells a drive to stop."""
    cyclic = CyclicFrames([1, 8])
    assert (cyclic.sync.arbitration_id, bytes(cyclic.sync.data)) == (0x080, b"")
    assert (cyclic.heartbeat.arbitration_id, bytes(cyclic.heartbeat.data)) == (0x77F, b"\x05")
    unfilled = [(frame.arbitration_id, frame.data.hex()) for frame in cyclic._set_points]
    assert unfilled == [(0x201, "020000000000"), (0x208, "020000000000")]
    sent = cyclic.set_points([ControlWord.ENABLE_OPERATION, ControlWord.QUICK_STOP], [258, -2])
    assert [(frame.arbitration_id, frame.data.hex()) for frame in sent] == [
        (0x201, "0f0002010000"),
        (0x208, "0200feffffff"),
    ]


#: What another program does that sends each of these, with a first byte, beside drives 1 and 8.
OF_ANOTHER_MASTER = {
    (0x000, 0x01): "sends NMT commands on this bus",
    (0x080, None): "sends SYNC on this bus",
    (0x77F, 0x05): "sends the master's heartbeat on this bus, or a device has the node id 127, as"
    " new drives may: give it another one",
    (0x201, 0x0F): "sends set-points to drive 1",
    (0x208, 0x40): "sends set-points to drive 8",
    (0x601, 0x2F): "writes objects of drive 1",  # download
    (0x608, 0x00): "writes objects of drive 8",  # segment of a download
    (0x608, 0xC6): "writes objects of drive 8",  # block download
    (0x608, 0xE0): "writes objects of drive 8",  # of no known meaning
}
OF_A_READING_TOOL = {
    (0x601, 0x40): "reads objects of drive 1",  # upload
    (0x608, 0x70): "reads objects of drive 8",  # segment of an upload
    (0x608, 0xA4): "reads objects of drive 8",  # block upload
    (0x608, 0x80): "reads objects of drive 8",  # abort of its own transfer
}


def test_identifiers_of_a_master_are_described_by_what_it_does() -> None:
    assert commanding_ids([1, 8]) == {can_id for can_id, _ in OF_ANOTHER_MASTER}
    for (can_id, first), action in (OF_ANOTHER_MASTER | OF_A_READING_TOOL).items():
        data = b"" if first is None else bytes((first,)).ljust(8, b"\0")
        assert foreign_master_message(can_id, data) == f"another program {action}"
        assert is_command(can_id, data) == ((can_id, first) in OF_ANOTHER_MASTER)
