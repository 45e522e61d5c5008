"""Next control word of each drive, so that all change state in the same cycle.

Pure: from goal and states to words. Every word has bit 1 set, so that none is "disable voltage";
all drives are enabled together or none, for a release all that are under torque.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from enum import Enum, IntEnum, auto
from itertools import compress
from types import MappingProxyType

# The CiA 402 state machine as tables: states by status word, and the control words in use.
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
    """Control words in use.

    Bit 1 is set in all of them: a word without it is "disable voltage", which releases the cable.
    """

    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    """In OPERATION ENABLED the same word is "disable operation"."""
    ENABLE_OPERATION = 0x0F
    QUICK_STOP = 0x02
    RESET_FAULT = 0x86
    """Rising edge of bit 7, combined with "shutdown"."""


#: Mask, value and state of a status word. The shorter mask ignores bit 5.
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

MAY_FOLLOW = frozenset({DriveState.NOT_READY, DriveState.OPERATION_ENABLED})
"""States in which a drive may follow set-points; NOT_READY includes unknown codes."""

FAULTED = frozenset({DriveState.FAULT_REACTION_ACTIVE, DriveState.FAULT})

WITHOUT_TORQUE = frozenset({DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON})
"""States at the end of a release."""


def _decoded(status_word: int) -> DriveState:
    for mask, value, state in STATE_CODES:
        if status_word & mask == value:
            return state
    # Not a code of the standard: nothing may be assumed about the drive.
    return DriveState.NOT_READY


_STATES = tuple(_decoded(low_bits) for low_bits in range(0x80))


def state_of(status_word: int) -> DriveState:
    """The state in a status word (6041h); NOT_READY for codes outside the standard."""
    return _STATES[status_word & 0x7F]


VOLTAGE_ENABLED, REMOTE, INTERNAL_LIMIT = 1 << 4, 1 << 9, 1 << 11
"""Bits of the status word. Source: CiA 402-2, object 6041h."""

FOLLOWS = 1 << 12
"""The target position is used. Source: CiA 402-2, cyclic synchronous position mode."""

POWER_BITS = VOLTAGE_ENABLED | REMOTE
"""Bits that are 0 in drives that cannot be enabled, and in some makes without such a meaning."""

_NO_VOLTAGE = (
    "its bit 4 (voltage enabled) is 0: mains power is off, safe torque off (STO) is active, or the"
    " drive does not use this bit (power_bits of its profile)"
)
_LOCAL = (
    "its bit 9 (remote) is 0: its commissioning tool, panel or enable input has control, or the"
    " drive does not use this bit (power_bits of its profile)"
)
_INTERLOCKED = "check mains power, safe torque off (STO) and the enable input"
_STAYS_STOPPED = (
    "it does not accept 0Fh there (transition 16), so that only a power cycle ends its quick stop,"
    " or it stops again at once, as at a limit switch: support the platform first"
)


def late_drives(
    names: Mapping[int, str],
    status_words: Sequence[int],
    commanded: Sequence[ControlWord],
    goal: Goal,
    seconds: float,
    bits: int = POWER_BITS,
) -> list[tuple[int, str]]:
    """Drives that keep the group from its goal, by node, with the likely reason.

    Drives that only wait for these are not among them.

    Args:
        status_words: Of each of them, as last reported.
        commanded: Last control word of each of them.
        seconds: Time that they had, [s].
        bits: As for `without_power`.
    """
    wanted = DriveState.OPERATION_ENABLED if goal is Goal.ENABLE else DriveState.READY_TO_SWITCH_ON
    late = f"instead of {wanted.value} after {seconds:g} s (enable_timeout_ms of its profile)"

    def text(name: str, state: DriveState, word: int, sent: ControlWord) -> str:
        reasons = _reasons(state, word, sent, bits)
        return "; ".join([f"{name} is in {state.value} {late}", *reasons])

    states = [state_of(word) for word in status_words]
    behind = next((step for step in _STEPS[goal] if step.intersection(states)), frozenset())
    rows = zip(names.items(), states, status_words, commanded, strict=True)
    return [
        (node, text(name, state, word, sent))
        for (node, name), state, word, sent in rows
        if state in behind
    ]


def ignoring_drives(
    names: Mapping[int, str], status_words: Sequence[int], seconds: float
) -> list[tuple[int, str]]:
    """Enabled drives that still ignore their target, by node, such as while a brake opens.

    Arguments as for `late_drives`.
    """
    text = (
        f"is enabled but ignores its target (bit 12 of 6041h) {seconds:g} s after it was commanded"
        " (enable_timeout_ms and follows_bit of its profile)"
    )
    return [
        (node, f"{name} {text}")
        for (node, name), word in zip(names.items(), status_words, strict=True)
        if state_of(word) is DriveState.OPERATION_ENABLED and not word & FOLLOWS
    ]


def stopped_between_replies(
    names: Mapping[int, str], status_words: Mapping[int, int], shown: Set[int]
) -> list[tuple[int, str]]:
    """Enabled drives that were not so between two replies, by node; faults have their own message.

    Args:
        status_words: Read between replies, by node; not of all.
        shown: Nodes whose replies show that already.
    """
    states = ((node, state_of(word)) for node, word in status_words.items() if node not in shown)
    return [
        (node, f"{names[node]} stopped on its own: {state.value} between two replies")
        for node, state in states
        if state is not DriveState.OPERATION_ENABLED and state not in FAULTED
    ]


def _reasons(
    state: DriveState, status_word: int, control_word: ControlWord, bits: int
) -> list[str]:
    """Why a drive stays in its state, as far as its status word shows."""
    if state is DriveState.QUICK_STOP_ACTIVE and control_word is ControlWord.ENABLE_OPERATION:
        return [_STAYS_STOPPED]
    if state not in WITHOUT_TORQUE:
        return []
    return [*without_power(status_word, bits), _INTERLOCKED]


def without_power(status_word: int, bits: int) -> list[str]:
    """Likely reasons why a drive at rest cannot be enabled; none for others.

    Args:
        bits: Those of `POWER_BITS` that have this meaning.
    """
    if state_of(status_word) not in WITHOUT_TORQUE:
        return []
    reasons = {REMOTE: _LOCAL, VOLTAGE_ENABLED: _NO_VOLTAGE}
    return [reason for bit, reason in reasons.items() if bit & bits & ~status_word]


class Goal(Enum):
    """Goal of the group."""

    IDLE = auto()
    """No power; a drive found under torque is commanded to stop and hold."""
    ENABLE = auto()
    STOP = auto()
    RELEASE = auto()
    RESET_FAULT = auto()


def change_on_its_own(
    goal: Goal, enables: bool, before: DriveState, state: DriveState
) -> str | None:
    """What a drive did without a command, from two successive states; None if it was commanded.

    Faults have their own message. A drive in quick stop that follows "enable operation" only in
    passing, between two replies, looks like one that has not followed it yet: it is late.

    Args:
        enables: "Enable operation" was sent for this goal. Before that a drive is only commanded to
            hold, or one without torque to approach SWITCHED ON; from then on all have the same
            command.
        before: State in the reply before.
        state: State in the last reply.
    """
    if state is before or state in FAULTED:
        return None
    stops = f"stopped on its own: {state.value}"
    if goal is Goal.ENABLE and enables:
        if state is DriveState.OPERATION_ENABLED:
            return None
        may_stop = before in HOLDS or state is DriveState.QUICK_STOP_ACTIVE
        return stops if may_stop else f"left {before.value} on its own: {state.value}"
    if goal is Goal.RELEASE and enables and state is DriveState.QUICK_STOP_ACTIVE:
        return stops
    released = goal is Goal.RELEASE and before is not DriveState.QUICK_STOP_ACTIVE
    if before in HOLDS and state not in TORQUE_ON and not released:
        return f"lost its torque: {state.value}"
    return None


_MAY_HOLD = TORQUE_ON | {DriveState.NOT_READY}
"""States in which a drive may hold a cable; NOT_READY includes drives without any reply."""

_RANKS = {
    DriveState.NOT_READY: 0,
    DriveState.SWITCH_ON_DISABLED: 0,
    DriveState.READY_TO_SWITCH_ON: 1,
    DriveState.SWITCHED_ON: 2,
    DriveState.QUICK_STOP_ACTIVE: 2,
    DriveState.OPERATION_ENABLED: 3,
}
"""Progress towards OPERATION ENABLED; a drive in quick stop waits for the others."""

_STEPS = {
    Goal.ENABLE: tuple(
        frozenset(state for state in DriveState if _RANKS.get(state, 0) == rank)
        for rank in range(_RANKS[DriveState.OPERATION_ENABLED])
    ),
    Goal.RELEASE: (
        FAULTED | {DriveState.NOT_READY},
        frozenset({DriveState.QUICK_STOP_ACTIVE}),
        frozenset({DriveState.OPERATION_ENABLED}),
        frozenset({DriveState.SWITCHED_ON}),
    ),
}
"""States short of a goal: drives in a later one wait for those in an earlier one."""

STEP_CYCLES = 6
"""Cycles from the command to enable to the one with 0Fh, for drives that follow at once: each word
after the first, which repeats the last one, waits a cycle for the replies to the one before."""

_NEXT_WORD = (
    ControlWord.SHUTDOWN,
    ControlWord.SWITCH_ON,
    ControlWord.ENABLE_OPERATION,
    ControlWord.ENABLE_OPERATION,
)


_NONE_KEPT: Mapping[int, ControlWord] = MappingProxyType({})


def next_words(
    goal: Goal,
    states: Sequence[DriveState],
    stop_commanded: Sequence[bool],
    kept: Mapping[int, ControlWord] = _NONE_KEPT,
) -> tuple[ControlWord, ...]:
    """The control words of the next cycle, one per drive.

    Args:
        stop_commanded: True for drives that were sent a quick stop since they reported QUICK STOP
            ACTIVE.
        kept: Words of `SentWords.kept`, by index. None of these drives is enabled, nor are others
            meanwhile, and a stop is sent to all.
    """
    is_enabling = goal in (Goal.ENABLE, Goal.RELEASE)
    if goal is Goal.STOP or (is_enabling and not FAULTED.isdisjoint(states)):
        return (ControlWord.QUICK_STOP,) * len(states)
    if goal is Goal.ENABLE:
        # The others do not return for a drive that is only passing to its next state.
        ranked = [_on_the_way(kept[i]) if i in kept else each for i, each in enumerate(states)]
        words = _enable(ranked, stop_commanded)
    elif goal is Goal.RELEASE:
        words = _release(states, stop_commanded)
    else:
        resets = goal is Goal.RESET_FAULT
        words = tuple(
            ControlWord.RESET_FAULT if resets and state is DriveState.FAULT else _idle(state)
            for state in states
        )
    return tuple(kept.get(drive, word) for drive, word in enumerate(words))


def _on_the_way(word: ControlWord) -> DriveState:
    """The state that a drive without torque leaves by a word; never one to be enabled from."""
    reached = word is ControlWord.SWITCH_ON
    return DriveState.READY_TO_SWITCH_ON if reached else DriveState.SWITCH_ON_DISABLED


def _idle(state: DriveState) -> ControlWord:
    return ControlWord.QUICK_STOP if state in _MAY_HOLD else ControlWord.SHUTDOWN


def _enable(
    states: Sequence[DriveState], stop_commanded: Sequence[bool]
) -> tuple[ControlWord, ...]:
    """One step towards OPERATION ENABLED; all drives take the last step together."""
    lowest = min(_RANKS[state] for state in states)
    # A drive that stopped itself must first be commanded to stop before it is enabled again.
    may_restart = all(
        state is not DriveState.QUICK_STOP_ACTIVE or commanded
        for state, commanded in zip(states, stop_commanded, strict=True)
    )
    if lowest >= 2 and may_restart:
        return (ControlWord.ENABLE_OPERATION,) * len(states)
    word = _NEXT_WORD[min(lowest, 1)]
    return tuple(ControlWord.QUICK_STOP if s in _MAY_HOLD else word for s in states)


def _release(
    states: Sequence[DriveState], stop_commanded: Sequence[bool]
) -> tuple[ControlWord, ...]:
    """Disables operation of all drives, which closes brakes, then shuts them down.

    Without "disable voltage", QUICK STOP ACTIVE can only be left through OPERATION ENABLED, by
    all drives under torque together and with targets at the actual positions. The others stay
    without it, as one that has no power could not join them: those under torque hold their
    positions, as before, and lose their torque together.
    """
    if DriveState.QUICK_STOP_ACTIVE in states:
        holding = [state in _MAY_HOLD for state in states]
        words = iter(_enable([*compress(states, holding)], [*compress(stop_commanded, holding)]))
        return tuple(next(words) if holds else ControlWord.SHUTDOWN for holds in holding)
    if DriveState.OPERATION_ENABLED in states:
        return tuple(
            ControlWord.SHUTDOWN if state in WITHOUT_TORQUE else ControlWord.SWITCH_ON
            for state in states
        )
    return (ControlWord.SHUTDOWN,) * len(states)


class SentWords:
    """Control words sent to the drives, as far as the next ones depend on them.

    Attributes:
        words: The last ones, one per drive.
    """

    def __init__(self, count: int) -> None:
        """Starts with a stop for each drive, of which nothing is known."""
        self.words: tuple[ControlWord, ...] = (ControlWord.QUICK_STOP,) * count
        self._stop_commanded = [False] * count
        self._at_rest = [False] * count

    def note(self, states: Sequence[DriveState], words: tuple[ControlWord, ...]) -> None:
        """Takes the words that are sent now.

        Args:
            states: As last reported, in reply to the words before.
            words: One per drive.
        """
        stop, enable = ControlWord.QUICK_STOP, ControlWord.ENABLE_OPERATION
        stopped = zip(states, words, self._stop_commanded, strict=True)
        self._stop_commanded = [
            state is DriveState.QUICK_STOP_ACTIVE and (word is stop or was)
            for state, word, was in stopped
        ]
        resting = zip(states, self.words, words, self._at_rest, strict=True)
        self._at_rest = [
            enable not in (before, word) and (state in WITHOUT_TORQUE or (was and state in _SHOWN))
            for state, before, word, was in resting
        ]
        self.words = words

    def kept(self, states: Sequence[DriveState]) -> dict[int, ControlWord]:
        """Words that drives with an unknown code keep, by index, as they have no torque.

        Each of them showed a state without torque, and was not sent "enable operation" since. Many
        drives pass through codes outside the standard while they change their state: another word
        would take them back. A stop leads nowhere and is not kept.
        """
        rows = enumerate(zip(states, self.words, self._at_rest, strict=True))
        return {
            drive: word
            for drive, (state, word, at_rest) in rows
            if at_rest and state is DriveState.NOT_READY and word is not ControlWord.QUICK_STOP
        }

    def next_words(self, goal: Goal, states: Sequence[DriveState]) -> tuple[ControlWord, ...]:
        """The control words of the next cycle; see the function of this name."""
        return next_words(goal, states, self._stop_commanded, self.kept(states))


_SHOWN = frozenset({DriveState.NOT_READY, DriveState.SWITCHED_ON})
"""States that a drive without torque may reach without "enable operation"."""
