"""The messages of CANSimple that are used here, and what their numbers mean. No bus.

Source: ODrive documentation, "CAN Protocol" and "API Reference" of firmware 0.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import can

from drivers.can_bus import SentFrame
from drivers.odrive.dbc import Layout, Layouts
from model.rig import Rig

COMMAND_BITS = 5


class AxisState(IntEnum):
    """States of an axis that matter here; in the others it calibrates or searches."""

    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


class ControlMode(IntEnum):
    """What the controller controls."""

    POSITION = 3


class InputMode(IntEnum):
    """What becomes of a set-point on its way to the controller."""

    PASSTHROUGH = 1


class AxisError(IntEnum):
    """Errors with a meaning of their own here."""

    WATCHDOG_TIMER_EXPIRED = 0x0100_0000
    ESTOP_REQUESTED = 0x0200_0000


ERROR_TEXTS: dict[int, str] = {
    0x0000_0001: "still starting",
    0x0000_0002: "drive electronics",
    0x0000_0004: "control loop late",
    0x0000_0008: "no position from the encoder",
    0x0000_0010: "invalid configuration",
    0x0000_0020: "gate driver",
    0x0000_0040: "no set-point received",
    0x0000_0100: "supply over-voltage",
    0x0000_0200: "supply under-voltage",
    0x0000_0400: "supply over-current",
    0x0000_0800: "regenerated current above its limit",
    0x0000_1000: "motor current above its limit",
    0x0000_2000: "motor over-temperature",
    0x0000_4000: "drive over-temperature",
    0x0000_8000: "speed above its limit",
    0x0001_0000: "position outside its limits",
    0x0002_0000: "current demand above its limit",
    AxisError.WATCHDOG_TIMER_EXPIRED: "watchdog: no set-point in time",
    AxisError.ESTOP_REQUESTED: "emergency stop",
    0x0400_0000: "motor spinning out; has the encoder slipped?",
    0x0800_0000: "brake resistor",
    0x1000_0000: "temperature sensor",
    0x4000_0000: "calibration",
}

RESULT_TEXTS: dict[int, str] = {
    1: "still busy",
    2: "cancelled",
    3: "disarmed",
    4: "no response",
    11: "time-out",
    13: "not possible in this state",
    14: "not calibrated",
}
"""Why an axis did not reach a state that was requested."""


def can_id(node: int, command: int) -> int:
    """The identifier of a message of one drive."""
    return node << COMMAND_BITS | command


def node_and_command(identifier: int) -> tuple[int, int]:
    """The inverse of `can_id`."""
    return identifier >> COMMAND_BITS, identifier & (1 << COMMAND_BITS) - 1


def error_text(errors: int) -> str:
    """What the bits of an axis error say."""
    known = [text for bit, text in ERROR_TEXTS.items() if errors & bit]
    return f"{', '.join(known) or 'unknown error'} (error {errors:08X}h)"


def state_text(word: int) -> str:
    """What a `status_word` says."""
    state, error = word & 0xFF, word & ERROR_FLAG
    names = {AxisState.IDLE: "idle", AxisState.CLOSED_LOOP_CONTROL: "closed loop control"}
    text = names.get(AxisState(state)) if state in names else f"axis state {state}"
    return f"{text}, in error" if error else f"{text}"


ERROR_FLAG = 0x100


def status_word(state: int, errors: int) -> int:
    """An axis's state as one number: the state, and a flag for errors."""
    return state | (ERROR_FLAG if errors else 0)


# The frames that a master of ODrives sends, built from the layouts of the DBC file. No bus.


class OdriveFrames:
    """One frame a drive, to be sent back to back: no SYNC makes them count together."""

    def __init__(self, rig: Rig, layouts: Layouts) -> None:
        """Takes nodes, counts and cycle from the rig."""
        self._nodes = tuple(winch.node_id for winch in rig.winches)
        self._per_turn = tuple(winch.counts_per_turn for winch in rig.winches)
        self._cycle = rig.document.bus.cycle_ms / 1000.0
        self._layouts = layouts

    def set_points(self, targets: Sequence[int], before: Sequence[int]) -> list[can.Message]:
        """Positions, with their speed as feed-forward; they feed the watchdogs.

        Args:
            targets: Shape (m,), [counts].
            before: Of the cycle before, shape (m,), [counts].
        """
        layout = self._layouts.set_input_pos
        return [
            self._frame(
                node, layout, target / per_turn, (target - last) / per_turn / self._cycle, 0.0
            )
            for node, per_turn, target, last in zip(
                self._nodes, self._per_turn, targets, before, strict=True
            )
        ]

    def axis_states(self, state: AxisState) -> list[can.Message]:
        """Requests a state of every drive."""
        return [self._frame(node, self._layouts.set_axis_state, state) for node in self._nodes]

    def clear_errors(self) -> list[can.Message]:
        """Takes the errors off every drive."""
        return [self._frame(node, self._layouts.clear_errors, 0) for node in self._nodes]

    def _frame(self, node: int, layout: Layout, *values: float) -> can.Message:
        return SentFrame(can_id(node, layout.command), layout.pack(*values))
