"""Which control word each drive gets next, so that all go the same way in the same cycle.

Pure: goal and states go in, the next words come out. Every word has bit 1 set, so that none is
"disable voltage"; enabling is all or none.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum, auto

from drivers.cia402.states import FAULTED, TORQUE_ON, ControlWord, DriveState


class Goal(Enum):
    """Where the group is going."""

    IDLE = auto()
    """No power; a drive found under torque is told to stop and hold."""
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
    # Out of quick stop only by a fresh edge: a drive that stopped by itself while it was told to
    # run must first be told to stop.
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
