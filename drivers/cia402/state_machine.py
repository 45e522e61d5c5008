"""Which control word each drive gets next, so that all go the same way in the same cycle.

Pure: goal and states go in, the next words come out. Every word has bit 1 set, so that none is
"disable voltage"; enabling is all or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum, IntEnum, auto

# The CiA 402 state machine as tables: status word to state, and the control words sent.
#
# Source: CiA 402-2 / IEC 61800-7-201, tables "state coding" and "command coding".


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

HOLDS = frozenset({DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE})
"""States in which a drive holds its cable, with torque and without a fault."""

FAULTED = frozenset({DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT})


def _decoded(status_word: int) -> DriveState:
    for mask, value, state in STATE_CODES:
        if status_word & mask == value:
            return state
    # No state of the standard has this code: nothing may be assumed about the drive.
    return DriveState.NOT_READY


_STATES = tuple(_decoded(low_bits) for low_bits in range(0x80))


def state_of(status_word: int) -> DriveState:
    """The state a status word (6041h) reports; a code the standard has not is NOT_READY."""
    return _STATES[status_word & 0x7F]


VOLTAGE_ENABLED, REMOTE = 1 << 4, 1 << 9
"""Bits of the status word. Source: CiA 402-2, object 6041h."""

_NO_VOLTAGE = (
    "its bit 4 (voltage enabled) is 0: mains power is off, or safe torque off (STO) is active"
)
_LOCAL = "its bit 9 (remote) is 0: its maker's tool, panel or enable input has control"
_INTERLOCKED = "check mains power, safe torque off (STO) and its enable input"
_STAYS_STOPPED = (
    "it does not take 0Fh there (transition 16), so that only a loss of power ends its quick stop:"
    " support the platform first"
)


def late_drives(
    names: Mapping[int, str],
    status_words: Sequence[int],
    wanted: Sequence[DriveState],
    seconds: float,
) -> list[tuple[int, str]]:
    """Drives that did not come to a state in time, by node, and why they may not have.

    Args:
        names: By node id.
        status_words: Of each of them, as last reported.
        wanted: States that count; the last one is where they were sent.
        seconds: That they had, [s].
    """
    way = f"on the way to {wanted[-1].value} after {seconds:g} s (enable_timeout_ms of its profile)"
    return [
        (node, f"{name} is in {state_of(word).value} {way}{_obstacle(word)}")
        for (node, name), word in zip(names.items(), status_words, strict=True)
        if state_of(word) not in wanted
    ]


def _obstacle(status_word: int) -> str:
    """What in its status word says why a drive stays where it is."""
    state = state_of(status_word)
    if state is DriveState.QUICK_STOP_ACTIVE:
        return f"; {_STAYS_STOPPED}"
    if state not in (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON):
        return ""
    return f"; {' and '.join(without_power(status_word)) or _INTERLOCKED}"


def without_power(status_word: int) -> list[str]:
    """What in its status word keeps a drive at rest from being enabled; nothing if it may be."""
    shown = [_LOCAL] if not status_word & REMOTE else []
    return shown + ([_NO_VOLTAGE] if not status_word & VOLTAGE_ENABLED else [])


class Goal(Enum):
    """Where the group is going."""

    IDLE = auto()
    """No power; a drive found under torque is commanded to stop and hold."""
    ENABLE = auto()
    STOP = auto()
    RELEASE = auto()
    RESET_FAULT = auto()


_MAY_HOLD = TORQUE_ON | {DriveState.NOT_READY}
"""States in which a drive may hold a cable; NOT_READY stands for a drive not heard yet too."""

_RANKS = {
    DriveState.NOT_READY: 0,
    DriveState.SWITCH_ON_DISABLED: 0,
    DriveState.READY_TO_SWITCH_ON: 1,
    DriveState.SWITCHED_ON: 2,
    DriveState.QUICK_STOP_ACTIVE: 2,
    DriveState.OPERATION_ENABLED: 3,
}
"""How far a drive is on its way; a drive that holds in quick stop waits for the others."""

_NEXT_WORD = (
    ControlWord.SHUTDOWN,
    ControlWord.SWITCH_ON,
    ControlWord.ENABLE_OPERATION,
    ControlWord.ENABLE_OPERATION,
)


def next_words(
    goal: Goal, states: Sequence[DriveState], told_to_stop: Sequence[bool]
) -> tuple[ControlWord, ...]:
    """The control words of the next cycle, one a drive.

    Args:
        goal: Where the group is going.
        states: As last reported.
        told_to_stop: True for drives that were sent a quick stop since they reported QUICK STOP
            ACTIVE.
    """
    if goal is Goal.STOP:
        return (ControlWord.QUICK_STOP,) * len(states)
    if goal is Goal.ENABLE:
        return _enable(states, told_to_stop)
    if goal is Goal.RELEASE:
        return _release(states, told_to_stop)
    if goal is Goal.RESET_FAULT:
        return tuple(
            ControlWord.RESET_FAULT if state is DriveState.FAULT else _idle(state)
            for state in states
        )
    return tuple(_idle(state) for state in states)


def _idle(state: DriveState) -> ControlWord:
    return ControlWord.QUICK_STOP if state in _MAY_HOLD else ControlWord.SHUTDOWN


def _enable(states: Sequence[DriveState], told_to_stop: Sequence[bool]) -> tuple[ControlWord, ...]:
    """One step towards OPERATION ENABLED; the last step is one step of all drives."""
    if any(state in FAULTED for state in states):
        return (ControlWord.QUICK_STOP,) * len(states)
    lowest = min(_RANKS[state] for state in states)
    # Out of quick stop only by a fresh edge: a drive that stopped by itself while commanded to
    # run must first be commanded to stop.
    fresh = all(
        state is not DriveState.QUICK_STOP_ACTIVE or told
        for state, told in zip(states, told_to_stop, strict=True)
    )
    if lowest >= 2 and fresh:
        return (ControlWord.ENABLE_OPERATION,) * len(states)
    word = _NEXT_WORD[min(lowest, 1)]
    return tuple(ControlWord.QUICK_STOP if s in _MAY_HOLD else word for s in states)


def _release(states: Sequence[DriveState], told_to_stop: Sequence[bool]) -> tuple[ControlWord, ...]:
    """Operation disabled on all, which closes brakes; shut down once none is under torque.

    The only way out of QUICK STOP ACTIVE without "disable voltage" leads through OPERATION
    ENABLED, for all drives together and with targets on the actual positions.
    """
    if any(state in FAULTED for state in states):
        return (ControlWord.QUICK_STOP,) * len(states)
    if DriveState.QUICK_STOP_ACTIVE in states:
        return _enable(states, told_to_stop)
    if DriveState.OPERATION_ENABLED in states:
        return (ControlWord.SWITCH_ON,) * len(states)
    return (ControlWord.SHUTDOWN,) * len(states)
