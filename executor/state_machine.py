"""The states of a run, and the only ways from one to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

from executor.safety.monitor import Alarm


class State(Enum):
    """Where a run is."""

    READY = "ready"
    """Drives are configured and answer; nothing is enabled."""
    ENABLING = "enabling"
    """The drives are being enabled together, targets on their actual positions."""
    APPROACHING = "approaching"
    """The last fraction of a millimetre to the first set-point."""
    MOVING = "moving"
    """Along the path."""
    HOLDING = "holding"
    """Feed hold: slowing down on the path or at rest there, enabled; a resume goes on."""
    STOPPING = "stopping"
    """Slowing down along the path, all drives together."""
    SECURING = "securing"
    """At rest; the drives go over to hold by themselves (quick stop active)."""
    FINISHED = "finished"
    """At the goal, held by the drives."""
    STOPPED = "stopped"
    """Stopped by the operator on the path, held by the drives."""
    LATCHED = "latched"
    """Stopped by a fault; this run is over, and another begins only with a new command."""


ON_PATH = frozenset({State.MOVING, State.HOLDING, State.STOPPING})
"""Where the place in the table is the place of the platform."""


class Event(Enum):
    """What may happen to a run."""

    ENABLE = "enable"
    ENABLED = "enabled"
    AT_START = "at_start"
    HOLD = "hold"
    RESUME = "resume"
    STOP = "stop"
    PATH_FAULT = "path_fault"
    FAULT = "fault"
    AT_REST = "at_rest"
    HELD = "held"


class ForbiddenTransition(RuntimeError):
    """A program error: the event is not foreseen in the state."""


_NEXT = {
    (State.READY, Event.ENABLE): State.ENABLING,
    (State.ENABLING, Event.ENABLED): State.APPROACHING,
    (State.ENABLING, Event.STOP): State.SECURING,
    (State.APPROACHING, Event.AT_START): State.MOVING,
    (State.APPROACHING, Event.STOP): State.SECURING,
    (State.MOVING, Event.HOLD): State.HOLDING,
    (State.HOLDING, Event.RESUME): State.MOVING,
    (State.HOLDING, Event.STOP): State.STOPPING,
    (State.HOLDING, Event.PATH_FAULT): State.STOPPING,
    (State.MOVING, Event.STOP): State.STOPPING,
    (State.MOVING, Event.PATH_FAULT): State.STOPPING,
    (State.MOVING, Event.AT_REST): State.SECURING,
    (State.STOPPING, Event.STOP): State.STOPPING,
    (State.STOPPING, Event.PATH_FAULT): State.STOPPING,
    (State.STOPPING, Event.AT_REST): State.SECURING,
    (State.SECURING, Event.PATH_FAULT): State.SECURING,
}


class Machine:
    """Where the run is, whether it was stopped and whether a fault is latched."""

    def __init__(self) -> None:
        """Starts ready."""
        self._state = State.READY
        self._stopped = False
        self._faulted = False

    @property
    def state(self) -> State:
        """Where the run is; only events change it."""
        return self._state

    def on(self, event: Event) -> State:
        """Takes one step.

        Raises:
            ForbiddenTransition: The event is not foreseen here; the caller must stop the rig.
        """
        if event is Event.FAULT:
            self._faulted = True
            self._state = State.LATCHED
            return self._state
        if event is Event.HELD and self._state is State.SECURING:
            self._state = self._end()
            return self._state
        following = _NEXT.get((self._state, event))
        if following is None:
            raise ForbiddenTransition(f"{event.value} in state {self._state.value}")
        self._stopped |= event is Event.STOP
        self._faulted |= event is Event.PATH_FAULT
        self._state = following
        return following

    def _end(self) -> State:
        if self._faulted:
            return State.LATCHED
        return State.STOPPED if self._stopped else State.FINISHED


# What the loop reports while it runs: a record per cycle, and events.


#: Code of the event that the drives say that they are simulated.
SIMULATED = "simulated"


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """One cycle as it was.

    Attributes:
        cycle: Counted from the first one sent.
        at: When it began, on the loop's clock, [s].
        state: Where the run was.
        index: Place in the table; of winches that move without a path how much is done, [%].
        rate: Rows a cycle that the feed went.
        targets: What was sent, [counts].
        actual: What the drives answered, [counts].
        torques: What they answered, [‰ of rated torque].
        words: Their status words.
        missing: How many did not answer.
        rejected: Frames thrown away since the drives were set up, as they could not be true.
        error_frames: Error frames of the bus since then.
        following_error: Largest over the cables, [m]; NaN while the drives do not follow.
        lateness: In cycles.
    """

    cycle: int
    at: float
    state: State
    index: float
    rate: float
    targets: tuple[int, ...]
    actual: tuple[int, ...]
    torques: tuple[int, ...]
    words: tuple[int, ...]
    missing: int
    rejected: int
    error_frames: int
    following_error: float
    lateness: float


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """Something worth reporting.

    Attributes:
        cycle: In which cycle.
        at: When, on the loop's clock, [s].
        code: Stable name.
        text: One sentence.
    """

    cycle: int
    at: float
    code: str
    text: str


#: Findings that several drives have at once for one cause.
_SHARED = frozenset({"drive_silent", "reply_lost"})


def shared_causes(findings: Sequence[Alarm], names: Sequence[str]) -> tuple[Alarm, ...]:
    """The findings of a cycle, with replies that several drives owe as one finding.

    Args:
        findings: Of one cycle.
        names: Of all drives, as the findings name them.
    """
    told: list[Alarm] = []
    for finding in findings:
        rest = _without_name(finding, names)
        same = [f for f in findings if f.code == finding.code and _without_name(f, names) == rest]
        if finding.code not in _SHARED or len(same) == 1:
            told.append(finding)
        elif finding is same[0]:
            which, cause = together([names[f.drive - 1] for f in same], len(names))
            told.append(replace(finding, text=f"{which} {rest}{cause}", drive=0))
    return tuple(told)


def together(who: Sequence[str], drives: int) -> tuple[str, str]:
    """Drives that fail in the same way at once, named in a sentence, and the cause to end it with.

    Args:
        who: Their names.
        drives: How many the rig has.
    """
    if len(who) == drives:
        return f"all {drives} drives", ": bus or supply"
    return ", ".join(who), ""


def _without_name(finding: Alarm, names: Sequence[str]) -> str:
    return finding.text.removeprefix(f"{names[finding.drive - 1]} ") if finding.drive else ""
