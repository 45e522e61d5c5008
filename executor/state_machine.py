"""State machine of a run, and the records of its loop."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from model.pose import Pose


class State(Enum):
    """State of a run."""

    READY = "ready"
    """Drives are configured and answer; nothing is enabled."""
    ENABLING = "enabling"
    """The drives are being enabled together, targets on their actual positions."""
    APPROACHING = "approaching"
    """Moving the last fraction of a millimetre to the first set-point."""
    MOVING = "moving"
    """Moving along the path."""
    HOLDING = "holding"
    """Feed hold: slowing down on the path or at rest there, enabled; resume continues."""
    STOPPING = "stopping"
    """Slowing down along the path, all drives together."""
    SECURING = "securing"
    """At rest; the drives change to holding on their own (quick stop active)."""
    FINISHED = "finished"
    """At the goal; the drives hold."""
    STOPPED = "stopped"
    """Stopped by the operator on the path; the drives hold."""
    LATCHED = "latched"
    """Stopped by a fault; this run is over, and a new command is needed for another."""


ON_PATH = frozenset({State.MOVING, State.HOLDING, State.STOPPING})
"""States in which the platform is at the current table index."""


class Event(Enum):
    """Event of a run."""

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
    """A program error: the event is not allowed in the state."""


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
    """State of the run, whether it was stopped and whether a fault is latched."""

    def __init__(self) -> None:
        self._state = State.READY
        self._stopped = False
        self._faulted = False

    @property
    def state(self) -> State:
        """Present state; only events change it."""
        return self._state

    def on(self, event: Event) -> State:
        """Handles an event; returns the new state.

        Raises:
            ForbiddenTransition: The event is not allowed here; the caller must stop the rig.
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


# Reports of the loop: a record per cycle, and events.


#: Code of the event that the drives report to be simulated.
SIMULATED = "simulated"
#: Code of the event that a drive lacks a function which a run would use.
REMARK = "remark"


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """Record of one cycle.

    Attributes:
        cycle: Counted from the first one sent.
        at: Start of the cycle, on the loop's clock, [s].
        state: Of the run.
        index: Table index; for winches that move without a path the share done, [%].
        rate: Of the feed, rows per cycle.
        targets: Set-points sent, [counts].
        actual: Reported positions, [counts].
        torques: Reported torques, [‰ of rated torque].
        words: Status words.
        missing: Number of drives that did not answer.
        rejected: Implausible frames rejected since the drives were configured.
        error_frames: Error frames of the bus since then.
        following_error: Largest of the cables, [m]; NaN while the drives do not follow.
        lateness: In cycles.
        tension_known: Whether the torque of each drive measures the tension of its cable: it
            answered, and follows set-points or, after a fault, holds under torque.
        press: Of a jog, whose line ``index`` belongs to; 0 before the first, and in other motions.
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
    tension_known: tuple[bool, ...]
    press: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class PlatformPoses:
    """Poses of the platform at one moment of a run; None where they are unknown.

    Attributes:
        time: Since the start of the run, [s].
        at: The same time, monotonic, [s].
        true: Of the simulated platform.
        encoder: From the encoders.
        planned: On the path.
    """

    time: float
    at: float
    true: Pose | None = None
    encoder: Pose | None = None
    planned: Pose | None = None


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """Event of the loop.

    Attributes:
        cycle: Number of the cycle.
        at: Time on the loop's clock, [s].
        code: Stable code.
        text: One sentence.
    """

    cycle: int
    at: float
    code: str
    text: str
