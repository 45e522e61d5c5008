"""Codes of drives as text: the code's own, or its class's; never an empty one."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.error_codes import abort_text, emergency_text


def test_known_codes() -> None:
    assert emergency_text(0x8611) == "following error too large (error 8611h)"
    assert emergency_text(0x3215) == "DC link over-voltage (error 3215h)"
    assert emergency_text(0x4FFF) == "temperature (error 4FFFh)"
    assert abort_text(0x06020000) == "Object does not exist (abort 06020000h)"
    assert abort_text(0x12345678) == "abort 12345678h"


@given(st.integers(0, 0xFFFF))
def test_every_code_is_named(code: int) -> None:
    assert f"{code:04X}h" in emergency_text(code)
