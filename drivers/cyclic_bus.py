"""What every cycle does on a bus: frames out, replies in, a look at the bus. One thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Protocol

import can

from drivers.bus import bus_name, lost_frames, take, transmit
from drivers.bus_faults import BusFault, ForeignMaster, ReceiveOverflow
from drivers.error_frames import ErrorFrames
from drivers.own_frames import OwnFrames

MOST_STALE = 4096
"""Frames that may wait at the beginning of a cycle; more than any bus carries in a few of them."""


class Listener(Protocol):
    """Takes in what drives send."""

    @property
    def complete(self) -> bool:
        """Every drive has answered in this cycle."""
        ...

    def take(self, can_id: int, data: bytes | bytearray, *, stale: bool = False) -> None:
        """Takes in one frame; a reply that is stale belongs to a cycle that is over."""
        ...


class CyclicBus:
    """Sends and takes what belongs to a cycle.

    What is wrong with the bus itself is kept until `end_cycle` raises it, so that the replies of
    the cycle are taken in all the same. Each kind is raised once.
    """

    def __init__(self, bus: can.BusABC, own: OwnFrames, foreign_text: Callable[[int], str]) -> None:
        """Takes an open bus.

        Args:
            bus: The caller's.
            own: Tells another master's frames from ours.
            foreign_text: What another master does that sends a frame of an identifier.
        """
        self._bus, self._where = bus, bus_name(bus)
        self._own, self._foreign_text = own, foreign_text
        self._errors = ErrorFrames(self._where)
        self._lost = lost_frames(bus)
        self._found: list[BusFault] = []
        self._raised: set[str] = set()

    @property
    def error_frames(self) -> int:
        """Error frames that came so far."""
        return self._errors.total

    def send(self, messages: Iterable[can.Message]) -> None:
        """Sends frames back to back.

        Raises:
            BusFault: The bus did not take a frame; the others were sent all the same.
        """
        failure: BusFault | None = None
        for message in messages:
            try:
                transmit(self._bus, message)
                self._own.sent(message.arbitration_id)
            except BusFault as error:
                failure = failure or error
        if failure is not None:
            raise failure

    def forget_waiting(self) -> None:
        """Throws away what came while nobody listened; that it overflowed then is no fault.

        Raises:
            BusFault: The bus failed.
        """
        while take(self._bus, 0.0) is not None:
            pass
        self._lost = lost_frames(self._bus)

    def discard_stale(self, listener: Listener) -> None:
        """Replies that came too late for their cycle are thrown away, never used as new ones.

        Raises:
            BusFault: The bus failed, or is flooded.
        """
        for _ in range(MOST_STALE):
            message = take(self._bus, 0.0)
            if message is None:
                return
            self._hand_over(message, listener, stale=True)
        raise ReceiveOverflow(f"more than {MOST_STALE} frames waited to be fetched", self._where)

    def take_replies(self, listener: Listener, timeout: float) -> None:
        """Hands frames over until every drive has answered or the time [s] is over.

        Raises:
            BusFault: The bus failed.
        """
        deadline = time.monotonic() + timeout
        left = timeout
        for _ in range(MOST_STALE):
            if listener.complete or left < 0.0:  # a bus full of other frames must not hold us up
                return
            message = take(self._bus, left)
            if message is None:
                return
            self._hand_over(message, listener, stale=False)
            if timeout > 0.0:  # with 0 all that has arrived is taken
                left = deadline - time.monotonic()

    def forget_faults(self) -> None:
        """After a reset by the operator: what is still wrong is raised again."""
        self._found.clear()
        self._raised.clear()

    def end_cycle(self) -> None:
        """Looks at the health of the bus.

        Raises:
            BusFault: Something about it is wrong, for the first time.
        """
        self._find(self._errors.end_cycle())
        lost = lost_frames(self._bus)
        if lost > self._lost:
            what = f"{lost - self._lost} received frames were lost"
            self._find(ReceiveOverflow(what, self._where, {"lost_frames": lost - self._lost}))
            self._lost = lost
        while self._found:
            fault = self._found.pop(0)
            if fault.code not in self._raised:
                self._raised.add(fault.code)
                raise fault

    def _find(self, fault: BusFault | None) -> None:
        if fault is not None:
            self._found.append(fault)

    def _hand_over(self, message: can.Message, listener: Listener, *, stale: bool) -> None:
        if message.is_error_frame:
            self._find(self._errors.take(message.arbitration_id, message.data))
        elif message.is_extended_id or message.is_remote_frame:
            return
        elif self._own.is_foreign(message.arbitration_id):
            self._find(ForeignMaster(self._foreign_text(message.arbitration_id), self._where))
        else:
            listener.take(message.arbitration_id, message.data, stale=stale)
