"""The operator's wishes and the supervisor's sign of life, in memory that both sides share."""

from __future__ import annotations

import os
import struct
import time
from dataclasses import replace

from executor.shared_memory import SharedMemory
from executor.wishes import Wishes

#: The supervisor has hung if nothing is heard of it for so long, [s].
SILENCE = 2.0

_STOP, _HOLD, _PERCENT, _NEAR, _BEAT, _TROUBLE = 0, 1, 2, 3, 8, 16
_LONGEST_TROUBLE = 400
_SIZE = _TROUBLE + 2 + _LONGEST_TROUBLE
_BEATS, _LENGTH = struct.Struct("<Q"), struct.Struct("<H")


class SharedBoard:
    """The supervisor's side; a `executor.wishes.WishBoard`. Each wish has a byte of its own."""

    def __init__(self) -> None:
        """Nothing is wished yet."""
        self.memory = SharedMemory.create(_SIZE)
        self.memory.view[_PERCENT] = 100
        self._beats = 0

    def ask_stop(self, too_near: bool = False) -> None:
        """See `WishBoard`."""
        if too_near and not self.memory.view[_STOP]:
            self.memory.view[_NEAR] = 1  # before the stop: whoever reads that knows why
        self.memory.view[_STOP] = 1

    def ask_hold(self, hold: bool) -> None:
        """See `WishBoard`."""
        self.memory.view[_HOLD] = int(hold)

    def ask_speed(self, percent: int) -> None:
        """See `WishBoard`."""
        self.memory.view[_PERCENT] = percent

    def read(self) -> Wishes:
        """See `WishBoard`."""
        return _read(self.memory)

    def close(self) -> None:
        """Lets go of the memory; who still has it open keeps it."""
        self.memory.close()

    def beat(self) -> None:
        """A sign of life."""
        self._beats += 1
        _BEATS.pack_into(self.memory.view, _BEAT, self._beats)

    def complain(self, trouble: str) -> None:
        """The run cannot be supervised any more, for this reason; the first one is kept."""
        if _LENGTH.unpack_from(self.memory.view, _TROUBLE)[0]:
            return
        content = trouble.encode()[:_LONGEST_TROUBLE]
        begin = _TROUBLE + _LENGTH.size
        self.memory.view[begin : begin + len(content)] = content
        _LENGTH.pack_into(self.memory.view, _TROUBLE, len(content))


class Supervised:
    """The side of the process that moves the drives: wishes, and whether somebody supervises."""

    def __init__(self, memory: SharedMemory, supervisor: int) -> None:
        """Listens to the process with this number, this process's parent."""
        self._memory, self._supervisor = memory, supervisor
        self._stopped = False
        self._beats, self._heard = 0, time.monotonic()

    def ask_stop(self) -> None:
        """This process itself was asked to end."""
        self._stopped = True

    def read(self) -> Wishes:
        """What is wished now, and whether anybody is there to wish."""
        wishes = _read(self._memory)
        return replace(wishes, stop=wishes.stop or self._stopped, lost=self._lost())

    def _lost(self) -> str:
        beats = _BEATS.unpack_from(self._memory.view, _BEAT)[0]
        now = time.monotonic()
        if beats != self._beats:
            self._beats, self._heard = beats, now
        if os.getppid() != self._supervisor:
            return "the process that supervises the run is gone"
        if now - self._heard > SILENCE:
            return f"the process that supervises the run was silent for {SILENCE:g} s"
        length = _LENGTH.unpack_from(self._memory.view, _TROUBLE)[0]
        begin = _TROUBLE + _LENGTH.size
        return bytes(self._memory.view[begin : begin + length]).decode(errors="replace")


def _read(memory: SharedMemory) -> Wishes:
    view = memory.view
    stop, hold, near = (bool(view[place]) for place in (_STOP, _HOLD, _NEAR))
    return Wishes(stop, hold, view[_PERCENT] / 100.0, too_near=near)
