"""A bus for tests that loses, delays, repeats and corrupts frames by rules.

It wraps one end of a bus. It is deterministic: random rules take a generator.
"""

from __future__ import annotations

import heapq
import random
import time
from collections.abc import Callable, Container, Iterable

import can

from drivers.can_load import frame_bits

Arrivals = Iterable[tuple[float, can.Message]]
"""Result of a rule: frames, each with its delay, [s]."""

Rule = Callable[[can.Message], Arrivals]

_Box = list[tuple[float, int, can.Message]]

BUS_OFF = can.Message(
    arbitration_id=0x040, data=bytes(8), is_error_frame=True, is_extended_id=False
)
"""Report of a controller in bus-off to its host. Source: linux/can/error.h."""


class FaultBus(can.BusABC):
    """One end of a bus, with rules for each direction.

    Attributes:
        incoming: For received frames; each rule gets the output of the previous one.
        outgoing: For sent frames.
    """

    def __init__(
        self,
        bus: can.BusABC,
        clock: Callable[[], float] = time.monotonic,
        *,
        ahead: float = 0.0,
        bitrate: float | None = None,
    ) -> None:
        """Takes an open bus, owned by the caller; without rules frames pass unchanged.

        Args:
            bus: The wrapped end.
            clock: Seconds, real or simulated.
            ahead: Frames due within this time count as arrived, [s]: in simulated time, where a
                whole cycle happens at its beginning, nearly a cycle.
            bitrate: If given, frames take their time on the wire, with arbitration by identifier,
                [bit/s]. Both directions share the wire.
        """
        super().__init__(channel="")
        self.channel_info = f"{bus.channel_info} with faults"
        self.incoming: list[Rule] = []
        self.outgoing: list[Rule] = []
        self._bus, self._clock, self._ahead = bus, clock, ahead
        self.bitrate = bitrate
        self._number = 0
        self._free_at = 0.0
        self._waiting: list[tuple[int, int, float, _Box, can.Message]] = []
        self._came: _Box = []
        self._goes: _Box = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame through the rules."""
        if self.bitrate is None and not self.outgoing and not self._goes:
            self._bus.send(msg)
            return
        self._enter(msg, self.outgoing, self._goes)
        self._pass_on()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame from the rules; None if none arrives within the time."""
        self._pass_on()
        if self.bitrate is None and not self.incoming and not self._came and not self._goes:
            return self._bus.recv(timeout)
        wait = timeout
        while not self._has_come():
            message = self._bus.recv(wait)
            if message is None:
                self._pass_on()
                break
            self._enter(message, self.incoming, self._came)
            self._pass_on()
            wait = 0.0
        return heapq.heappop(self._came)[2] if self._has_come() else None

    def inject(self, message: can.Message) -> None:
        """Sends a frame past the rules, as another device would."""
        self._bus.send(message)

    def fileno(self) -> int:
        """Of the wrapped bus."""
        return self._bus.fileno()

    def shutdown(self) -> None:
        """Discards pending frames; the wrapped bus stays open."""
        self._waiting.clear()
        self._came.clear()
        self._goes.clear()
        super().shutdown()

    @property
    def _now(self) -> float:
        return self._clock() + self._ahead

    def _has_come(self) -> bool:
        return bool(self._came) and self._came[0][0] <= self._now

    def _enter(self, message: can.Message, rules: list[Rule], box: _Box) -> None:
        began = self._clock()
        arrivals: list[tuple[float, can.Message]] = [(0.0, message)]
        for rule in rules:
            arrivals = [(late + more, new) for late, old in arrivals for more, new in rule(old)]
        for late, new in arrivals:
            self._number += 1
            if self.bitrate is None:
                heapq.heappush(box, (began + late, self._number, new))
            else:
                entry = (new.arbitration_id, self._number, began + late, box, new)
                heapq.heappush(self._waiting, entry)

    def _arbitrate(self) -> None:
        """Transmits waiting frames by priority until now."""
        while self.bitrate is not None and self._waiting:
            begin, entry = self._free_at, self._waiting[0]
            if entry[2] > begin:  # the most urgent frame came later: another may go before it
                begin = max(begin, min(waiting[2] for waiting in self._waiting))
                entry = min(waiting for waiting in self._waiting if waiting[2] <= begin)
            if begin > self._now:
                return
            self._waiting.remove(entry)
            heapq.heapify(self._waiting)
            _, number, _, box, message = entry
            self._free_at = begin + frame_bits(len(message.data)) / self.bitrate
            heapq.heappush(box, (self._free_at, number, message))

    def _pass_on(self) -> None:
        """Sends the frames that are due."""
        self._arbitrate()
        while self._goes and self._goes[0][0] <= self._now:
            self._bus.send(heapq.heappop(self._goes)[2])


def lose(ids: Container[int], share: float = 1.0, dice: random.Random | None = None) -> Rule:
    """Loses all frames of some identifiers, or a random fraction."""

    def rule(message: can.Message) -> Arrivals:
        lost = message.arbitration_id in ids and (dice is None or dice.random() < share)
        return [] if lost else [(0.0, message)]

    return rule


def lose_next(ids: Container[int], count: int) -> Rule:
    """Loses the next ``count`` frames of some identifiers."""
    left = count

    def rule(message: can.Message) -> Arrivals:
        nonlocal left
        if left and message.arbitration_id in ids:
            left -= 1
            return []
        return [(0.0, message)]

    return rule


def delay(ids: Container[int], seconds: float) -> Rule:
    """Delays frames of some identifiers."""
    return lambda message: [(seconds if message.arbitration_id in ids else 0.0, message)]


def repeat(ids: Container[int], seconds: float = 0.0) -> Rule:
    """Repeats frames of some identifiers after a delay."""

    def rule(message: can.Message) -> Arrivals:
        again = [(seconds, message)] if message.arbitration_id in ids else []
        return [(0.0, message), *again]

    return rule


def spoil(ids: Container[int], change: Callable[[bytes], bytes], count: int | None = None) -> Rule:
    """Changes the data of the next ``count`` or all frames of some identifiers."""
    left = count

    def rule(message: can.Message) -> Arrivals:
        nonlocal left
        if left == 0 or message.arbitration_id not in ids:
            return [(0.0, message)]
        left = None if left is None else left - 1
        data = change(bytes(message.data))
        number = message.arbitration_id
        return [(0.0, can.Message(arbitration_id=number, data=data, is_extended_id=False))]

    return rule
