"""Presses of jog controls. A press that ended never resumes, whatever arrives later.

Press numbers rise. A held control is reported repeatedly; a press without a report for `TIMEOUT`
has ended. The process that hears the operator and the one that moves the drives apply the same
rule independently.
"""

from __future__ import annotations

import math
import struct
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass

from executor.realtime.shared_memory import SharedMemory
from model.pose import Array

#: A press without a report for this long has ended, [s].
TIMEOUT = 0.150

_ENTRY, _CHECK = struct.Struct("<QdB?B?d"), struct.Struct("<I")
_SIZE = _ENTRY.size + _CHECK.size


def press_clock() -> int:
    """Time since the boot, [ms]: the source of press numbers.

    All programs of this computer share it, and unlike the wall clock it is never set back: the
    numbers of another console would be over until it had caught up.
    """
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1_000_000


class PressRule:
    """Distinguishes held presses from ended ones; a clock that jumps back also ends one."""

    def __init__(self) -> None:
        self._over = 0

    def held(self, number: int, heard: float, now: float) -> bool:
        """Whether the press is held; ends earlier presses, and this one if it is not held.

        Args:
            number: Of the press, from 1.
            heard: Time of its last report, [s]; NaN after its release.
            now: On the same clock, [s].
        """
        if number <= self._over:
            return False
        self._over = number - 1
        if not 0.0 <= now - heard <= TIMEOUT:
            self._over = number
            return False
        return True


@dataclass(frozen=True, slots=True)
class PressState:
    """Input of the loop.

    Attributes:
        press: Number of the held press; 0 for none.
        share: Of the jog speed, from 0.01 to 1.
        ends: The session is to end.
        cable: Number of the cable to move, from 1; 0 for the platform.
        pays_out: Whether the cable is paid out, otherwise wound in.
        step: Cable length of a jog that ends on its own, [m]; None to move while it is held.
    """

    press: int
    share: float
    ends: bool
    cable: int
    pays_out: bool
    step: float | None


@dataclass(frozen=True, slots=True, eq=False)
class PlatformMove:
    """Moves the platform in a straight line.

    Attributes:
        direction: Unit vector, shape (3,).
        in_platform: Whether it is in the platform frame, otherwise in the world frame.
    """

    direction: Array
    in_platform: bool


@dataclass(frozen=True, slots=True)
class CableMove:
    """Moves one winch alone.

    Attributes:
        cable: Its number, from 1.
        pays_out: Whether it is paid out, otherwise wound in.
    """

    cable: int
    pays_out: bool


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """Command of a press; constant while it lasts.

    Attributes:
        number: From 1, rising.
        move: What it moves.
        step: Length of a jog that ends on its own, [m]; None to move while it is held.
        free_since: Time since which no earlier press was held, [s].
    """

    number: int
    move: PlatformMove | CableMove
    step: float | None
    free_since: float


class PressBoard:
    """The supervisor's side: takes reports of presses, from any thread."""

    def __init__(self, now: Callable[[], float], cables: int = 0) -> None:
        """Starts without a press.

        Args:
            now: Clock of the loop, [s].
            cables: Number of cables, moved one at a time; 0 to move the platform.
        """
        self.memory, self._cables = SharedMemory.create(_SIZE), cables
        self._now, self._rule, self._lock = now, PressRule(), threading.Lock()
        self._press: Press | None = None
        self._heard, self._percent, self._ends = math.nan, 100, False
        self._free_since = -math.inf
        self.last_heard = -math.inf
        """Time of the last report of a press, [s]; -inf before the first."""
        self._write()

    def hold(
        self,
        number: int,
        move: PlatformMove | CableMove,
        *,
        step: float | None,
        percent: int,
        age: float = 0.0,
    ) -> bool:
        """Reports a held control; continues its press, begins a new one, or returns False if over.

        Args:
            move: Taken at the beginning of a press, like the step.
            step: See `Press`, [m].
            percent: Of the jog speed, from 1 to 100.
            age: Of the report, [s].

        Raises:
            ValueError: There is no such cable, or the session moves the other kind.
        """
        match move:
            case PlatformMove() if self._cables:
                raise ValueError("this session moves one cable at a time: name cable and sense")
            case CableMove() if not self._cables:
                raise ValueError("this session moves the platform: name a direction")
            case CableMove(cable=cable) if not 1 <= cable <= self._cables:
                raise ValueError(f"there is no cable {cable}: name one from 1 to {self._cables}")
        with self._lock:
            now = self._now()
            heard = now - age
            known = self._press is not None and self._press.number == number
            if not self._rule.held(number, self._heard if known else heard, now):
                if known:
                    self._let_go()
                return False
            if not known:
                self._end_press(now)
                self._press = Press(number, move, step, self._free_since)
            self._heard = max(heard, self._heard) if known else heard
            self._percent, self.last_heard = percent, now
            self._write()
            return True

    def let_go(self, number: int) -> None:
        """Ends the press of this number and all earlier ones."""
        with self._lock:
            self._rule.held(number, math.nan, self._now())
            if self._press is not None and self._press.number <= number:
                self._let_go()

    def end(self) -> None:
        """Requests the end of the session, and ends all presses."""
        with self._lock:
            self._ends = True
            self._let_go()

    def held(self) -> Press | None:
        """The press held now."""
        with self._lock:
            press, now = self._press, self._now()
            if press is None or not self._rule.held(press.number, self._heard, now):
                return None
            return press

    def close(self) -> None:
        """Closes the memory; other processes keep theirs."""
        self.memory.close()

    def _let_go(self) -> None:
        self._end_press(self._now())
        self._write()

    def _end_press(self, now: float) -> None:
        """Ends the press; a silent one ended earlier."""
        if not math.isnan(self._heard):
            self._free_since = min(now, self._heard + TIMEOUT)
        self._heard = math.nan

    def _write(self) -> None:
        press = self._press
        number = 0 if press is None else press.number
        step = math.nan if press is None or press.step is None else press.step
        cable, pays_out = 0, False
        if press is not None and isinstance(press.move, CableMove):
            cable, pays_out = press.move.cable, press.move.pays_out
        entry = _ENTRY.pack(number, self._heard, self._percent, self._ends, cable, pays_out, step)
        self.memory.view[:_SIZE] = entry + _CHECK.pack(zlib.crc32(entry))


class PressReader:
    """The loop's side of a `PressBoard`."""

    def __init__(self, memory: SharedMemory, now: Callable[[], float]) -> None:
        """Reads the entries of a `PressBoard`, at the times of the loop's clock [s]."""
        self._memory, self._now, self._rule = memory, now, PressRule()
        self._entry = _ENTRY.pack(0, math.nan, 100, False, 0, False, math.nan)

    def read(self) -> PressState:
        """Present state; a half-written entry is ignored."""
        content = bytes(self._memory.view[:_SIZE])
        now = self._now()  # after the entry: a report must not be later than this
        entry, check = content[: _ENTRY.size], content[_ENTRY.size :]
        if check == _CHECK.pack(zlib.crc32(entry)):
            self._entry = entry
        number, heard, percent, ends, cable, pays_out, step = _ENTRY.unpack(self._entry)
        held = number > 0 and self._rule.held(number, heard, now)
        share = min(max(percent, 1), 100) / 100.0
        length = None if math.isnan(step) else step
        return PressState(number if held else 0, share, ends, cable, pays_out, length)
