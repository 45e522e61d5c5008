"""Golden bytes of every frame, and refusal of frames of another length."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.frames import (
    NmtCommand,
    NmtState,
    make_emergency,
    make_heartbeat,
    make_nmt,
    make_reply,
    make_set_point,
    make_sync,
    parse_emergency,
    parse_heartbeat,
    parse_reply,
    parse_set_point,
)


def test_golden_bytes() -> None:
    assert make_set_point(0x000F, 0x01020304).hex() == "0f00040302010000"
    assert make_set_point(0x0002, -2, -3).hex() == "0200fefffffffdff"
    assert make_reply(0x1237, -1, 1000).hex() == "3712ffffffffe803"
    assert make_sync() == b""
    assert make_heartbeat(NmtState.OPERATIONAL) == b"\x05"
    assert make_nmt(NmtCommand.START, 3) == b"\x01\x03"
    assert make_nmt(NmtCommand.PRE_OPERATIONAL, 0) == b"\x80\x00"
    assert make_emergency(0x8611, 1).hex() == "1186010000000000"


@given(
    word=st.integers(0, 0xFFFF),
    position=st.integers(-(2**31), 2**31 - 1),
    torque=st.integers(-(2**15), 2**15 - 1),
)
def test_what_is_made_is_what_is_read(word: int, position: int, torque: int) -> None:
    assert parse_reply(make_reply(word, position, torque)) == (word, position, torque)
    assert parse_set_point(make_set_point(word, position, torque)) == (word, position, torque)


@given(st.binary(max_size=64))
def test_frames_of_another_length_are_not_read(data: bytes) -> None:
    if len(data) != 8:
        assert parse_reply(data) is None
        assert parse_set_point(data) is None
        assert parse_emergency(data) is None
    if len(data) != 1:
        assert parse_heartbeat(data) is None


@pytest.mark.parametrize("target", [2**31, -(2**31) - 1])
def test_a_target_beyond_32_bits_is_not_packed(target: int) -> None:
    with pytest.raises(struct.error):
        make_set_point(0x0F, target)


def test_heartbeat_toggle_bit_is_dropped() -> None:
    assert parse_heartbeat(b"\x85") == NmtState.OPERATIONAL
