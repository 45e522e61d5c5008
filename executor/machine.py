"""The states of a run, and the only ways from one to the next."""

from __future__ import annotations

from enum import Enum


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
