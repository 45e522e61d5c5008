"""Layouts of CANSimple: bytes worked out by hand from ODrive's documentation, and DBC files."""

from __future__ import annotations

import struct
import sys
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.odrive.messages import (
    OWN_DBC,
    AxisError,
    Layout,
    Layouts,
    can_id,
    error_text,
    node_and_command,
    read_layouts,
    state_text,
    status_word,
)
from model.errors import BadInput

TEXT = OWN_DBC.read_text()


@cache
def own() -> Layouts:
    return read_layouts()


@pytest.mark.parametrize(
    ("name", "command", "values", "data"),
    [
        ("get_version", 0x00, (2, 4, 4, 58, 0, 6, 11), "02 04043a 00 06 0b 00"),
        ("heartbeat", 0x01, (0x01000000, 8, 3), "00000001 08 03 00 00"),
        ("estop", 0x02, (), ""),
        ("rxsdo", 0x04, (1, 0x0123, 7), "01 2301 00 07000000"),
        ("txsdo", 0x05, (0x0123, 0x3F800000), "00 2301 00 0000803f"),
        ("set_axis_state", 0x07, (8,), "08000000 00000000"),
        ("get_encoder_estimates", 0x09, (1.0, -2.0), "0000803f 000000c0"),
        ("set_controller_mode", 0x0B, (3, 1), "03000000 01000000"),
        ("set_input_pos", 0x0C, (-2.0, 0.5, -0.001), "000000c0 f401 ffff"),
        ("set_limits", 0x0F, (1.0, 10.0), "0000803f 00002041"),
        ("get_bus_voltage_current", 0x17, (48.0, 0.0), "00004042 00000000"),
        ("clear_errors", 0x18, (), "00"),
        ("get_torques", 0x1C, (0.0, 1.0), "00000000 0000803f"),
    ],
)
def test_a_message_has_the_bytes_of_the_documentation(
    name: str, command: int, values: tuple[float, ...], data: str
) -> None:
    layout: Layout = getattr(own(), name)
    assert layout.command == command
    assert layout.pack(*values) == bytes.fromhex(data)
    assert layout.unpack(bytes.fromhex(data)) == pytest.approx(values)


@given(st.floats(-1e6, 1e6, width=32), st.floats(-100, 100), st.floats(-100, 100))
def test_feed_forward_that_does_not_fit_is_as_large_as_it_may_be(
    turns: float, speed: float, torque: float
) -> None:
    packed = struct.unpack("<fhh", own().set_input_pos.pack(turns, speed, torque))
    assert packed[0] == turns
    for raw, value in zip(packed[1:], (speed, torque), strict=True):
        assert abs(raw) <= 32768
        assert raw * 0.001 == pytest.approx(max(-32.768, min(32.767, value)), abs=0.0006)


@given(st.integers(0, 63), st.integers(0, 31))
def test_node_and_command_share_an_identifier(node: int, command: int) -> None:
    identifier = can_id(node, command)
    assert 0 <= identifier < 0x800
    assert node_and_command(identifier) == (node, command)


def test_messages_lie_where_the_named_file_says(tmp_path: Path) -> None:
    path = tmp_path / "other.dbc"
    text = TEXT.replace("(0.001,0)", "(0.0001,0)").replace("BO_ 28 ", "BO_ 30 ")
    path.write_text(text.replace("SIG_VALTYPE_ 28 ", "SIG_VALTYPE_ 30 "))
    found = read_layouts(path)
    assert found.set_input_pos.pack(0.0, 1.0, 0.0)[4:6] == struct.pack("<h", 10_000)
    assert found.get_torques.command == 30


IDENTIFY = ' SG_ Identify : 0|8@1+ (1,0) [0|0] "" ODrive\n'


@pytest.mark.parametrize("size", [0, 1, 8])
def test_errors_are_cleared_with_files_of_any_firmware(tmp_path: Path, size: int) -> None:
    """Before firmware 0.6.9, Clear_Errors has no data."""
    path = tmp_path / "old.dbc"
    text = TEXT.replace("Axis0_Clear_Errors: 1", f"Axis0_Clear_Errors: {size}")
    assert IDENTIFY in text
    path.write_text(text if size else text.replace(IDENTIFY, ""))
    assert read_layouts(path).clear_errors.pack() == bytes(size)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "cannot be read"),
        ("nonsense", "cannot be read"),
        (TEXT.replace("Torque_Estimate", "Torque"), "has no 'Torque_Estimate'"),
        (TEXT.replace("Axis0_Estop", "Axis0_Stop"), "has no 'Axis0_Estop'"),
        (
            TEXT.replace("Pos_Estimate : 0|32", "Pos_Estimate : 32|32", 1).replace(
                "Vel_Estimate : 32|32", "Vel_Estimate : 0|32", 1
            ),
            "Vel_Estimate is not a whole number of bytes in order",
        ),
        (
            TEXT.replace("Axis_State : 32|8", "Axis_State : 33|7"),
            "State is not a whole number",
        ),
        (TEXT.replace("Axis0_Get_Torques: 8", "Axis0_Get_Torques: 4"), "its signals need 8"),
        (TEXT.replace("(0.001,0)", f"({'9' * 399},0)"), "has a scale of 999"),
        (TEXT.replace("(0.001,0)", "(0,0)"), "has a scale of 0"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "odd.dbc"
    path.write_text(text)
    with pytest.raises(BadInput, match=words) as caught:
        read_layouts(path)
    assert caught.value.where == str(path)
    assert caught.value.next_step


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such file"):
        read_layouts(tmp_path / "none.dbc")


def test_without_cantools_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cantools", None)
    for module in [name for name in sys.modules if name.startswith("cantools.")]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(BadInput, match="is not installed") as caught:
        read_layouts()
    assert "cdpr[odrive]" in caught.value.next_step


def test_errors_and_states_are_shown_as_text() -> None:
    assert "watchdog" in error_text(AxisError.WATCHDOG_TIMER_EXPIRED)
    both = error_text(0x2000 | AxisError.ESTOP_REQUESTED)
    assert "motor over-temperature, emergency stop" in both
    assert "unknown error (error 00000080h)" in error_text(0x80)
    assert state_text(status_word(8, 0)) == "closed loop control"
    assert state_text(status_word(1, 0x20)) == "idle, in error"
    assert state_text(status_word(4, 0)) == "axis state 4"
    watchdog = AxisError.WATCHDOG_TIMER_EXPIRED
    assert state_text(status_word(1, watchdog)) == "idle"
    assert state_text(status_word(1, watchdog | 0x20)) == "idle, in error"
    assert state_text(status_word(8, watchdog)) == "closed loop control, in error"
