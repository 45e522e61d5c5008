"""The operator's wishes and the supervisor's sign of life, in memory that both sides share."""

from __future__ import annotations

import os
import struct
import time
from dataclasses import replace

from executor.shared_memory import SharedMemory
from executor.wishes import StopReason, Wishes

#: The supervisor has hung if nothing is heard of it for so long, [s].
SILENCE = 2.0

_BEATS, _LENGTH = struct.Struct("<Q"), struct.Struct("<H")
_LONGEST_TEXT = 400
_STOP, _HOLD, _PERCENT, _BEAT, _TROUBLE = 0, 1, 2, 8, 16
_REASON = _TROUBLE + _LENGTH.size + _LONGEST_TEXT
_SIZE = _REASON + _LENGTH.size + _LONGEST_TEXT


class SharedBoard:
    """The supervisor's side; a `executor.wishes.WishBoard`. Each wish has a byte of its own."""

    def __init__(self) -> None:
        """Nothing is wished yet."""
        self.memory = SharedMemory.create(_SIZE)
        self.memory.view[_PERCENT] = 100
        self._beats = 0

    def ask_stop(self, for_what: StopReason | None = None) -> None:
        """See `WishBoard`."""
        if for_what is not None and not self.memory.view[_STOP]:
            # Before the stop: whoever reads that knows why.
            _write(self.memory, _REASON, f"{for_what.code} {for_what.text}")
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
        if not _text(self.memory, _TROUBLE):
            _write(self.memory, _TROUBLE, trouble)


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
        return _text(self._memory, _TROUBLE)


def _read(memory: SharedMemory) -> Wishes:
    view = memory.view
    stop, hold = bool(view[_STOP]), bool(view[_HOLD])
    code, _, text = (_text(memory, _REASON) if stop else "").partition(" ")
    for_what = StopReason(code, text) if code else None
    return Wishes(stop, hold, view[_PERCENT] / 100.0, for_what=for_what)


def _write(memory: SharedMemory, place: int, text: str) -> None:
    content = text.encode()[:_LONGEST_TEXT]
    begin = place + _LENGTH.size
    memory.view[begin : begin + len(content)] = content
    _LENGTH.pack_into(memory.view, place, len(content))  # last: no text is read half-written


def _text(memory: SharedMemory, place: int) -> str:
    length = _LENGTH.unpack_from(memory.view, place)[0]
    begin = place + _LENGTH.size
    return bytes(memory.view[begin : begin + length]).decode(errors="replace")
