"""What the operator wants of a run that is under way; the loop asks for it every cycle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class StopReason:
    """Why a run is to end without an operator's stop.

    Attributes:
        code: Of the event that reports it.
        text: A clause, with numbers.
    """

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class OperatorRequests:
    """All of it at one moment; each stays until it is changed.

    Attributes:
        stop: End the run along the path.
        for_what: The stop is wished for this, which the cameras saw, and with which code; None when
            the operator wishes it.
        hold: Come to rest on the path and wait there.
        speed: Share of the planned speed along the path, from 0.01 to 1.
        lost: Why the run has lost its supervisor; empty while it has one.
    """

    stop: bool = False
    hold: bool = False
    speed: float = 1.0
    lost: str = ""
    for_what: StopReason | None = None


#: Slowest and fastest feed that may be asked for, [% of the planned speed].
SLOWEST, FASTEST = 1, 100


class RequestBoard(Protocol):
    """Where wishes are put up. A stop cannot be taken back."""

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """The run is to end along the path.

        Args:
            for_what: What the cameras saw; None when the operator wishes it.
        """

    def ask_hold(self, hold: bool) -> None:
        """The run is to wait on the path, or to go on."""

    def ask_speed(self, percent: int) -> None:
        """The run is to go at a share of the planned speed, from `SLOWEST` to `FASTEST`."""

    def read(self) -> OperatorRequests:
        """What is wished now."""


class LocalRequests:
    """The board of a loop that runs in this process; others may write to it at any time."""

    def __init__(self) -> None:
        """Nothing is wished yet."""
        # One attribute each: a signal that interrupts one wish cannot undo another.
        self._stop, self._hold, self._speed = False, False, 1.0
        self._for_what: StopReason | None = None

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """See `RequestBoard`."""
        if not self._stop:
            self._for_what = for_what
        self._stop = True

    def ask_hold(self, hold: bool) -> None:
        """See `RequestBoard`."""
        self._hold = hold

    def ask_speed(self, percent: int) -> None:
        """See `RequestBoard`."""
        self._speed = percent / 100.0

    def read(self) -> OperatorRequests:
        """See `RequestBoard`."""
        return OperatorRequests(self._stop, self._hold, self._speed, for_what=self._for_what)
