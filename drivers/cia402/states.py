"""The CiA 402 state machine as tables: status word to state, and the control words sent.

Source: CiA 402-2 / IEC 61800-7-201, tables "state coding" and "command coding".
"""

from __future__ import annotations

from enum import Enum, IntEnum


class DriveState(Enum):
    """State of one drive; the text is the standard's."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"


class ControlWord(IntEnum):
    """The control words this program sends.

    Bit 1 is set in each of them: a word without it is "disable voltage", which frees the cable.
    """

    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    """In OPERATION ENABLED the same word is "disable operation"."""
    ENABLE_OPERATION = 0x0F
    QUICK_STOP = 0x02
    RESET_FAULT = 0x86
    """Rising edge of bit 7, with "shutdown" beside it."""


#: Mask, value and state of a status word. The short mask leaves bit 5 open.
STATE_CODES: tuple[tuple[int, int, DriveState], ...] = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY_TO_SWITCH_ON),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, DriveState.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, DriveState.FAULT),
)

#: States in which the motor may hold the cable by its torque.
TORQUE_ON = frozenset(
    {
        DriveState.OPERATION_ENABLED,
        DriveState.QUICK_STOP_ACTIVE,
        DriveState.FAULT_REACTION_ACTIVE,
    }
)

FAULTED = frozenset({DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT})


def _decoded(status_word: int) -> DriveState:
    for mask, value, state in STATE_CODES:
        if status_word & mask == value:
            return state
    # No state of the standard has this code: nothing may be assumed about the drive.
    return DriveState.NOT_READY


_STATES = tuple(_decoded(low_bits) for low_bits in range(0x80))


def state_of(status_word: int) -> DriveState:
    """The state a status word (6041h) tells; a code the standard has not is NOT_READY."""
    return _STATES[status_word & 0x7F]
