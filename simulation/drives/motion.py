"""Motion of a simulated drive's motor: following set-points, ramping down, holding. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(slots=True)
class Motor:
    """Position of a motor shaft, and its demand.

    Attributes:
        position: Actual position, [counts].
        demand: Position demanded by the controller, [counts].
        speed: Of the demand, [counts/s].
        top_speed: Largest speed of the motor, [counts/s].
        jammed: The shaft does not move (set from outside).
        stick: Following error at which a resting motor jumps, [counts]; 0 without stick-slip.
    """

    position: float
    demand: float
    top_speed: float
    speed: float = 0.0
    jammed: bool = False
    stick: float = 0.0

    @property
    def following_error(self) -> float:
        """Demand minus actual position, [counts]."""
        return self.demand - self.position

    def follow(self, target: float, time_left: float, elapsed: float, load: int) -> None:
        """Interpolates towards a target due after ``time_left`` [s].

        Args:
            target: [counts].
            time_left: Until the target is due, before this step, [s].
            elapsed: Length of this step, [s].
            load: Sign of the direction blocked by the torque limit, or 0.
        """
        if time_left <= elapsed:
            moved = target - self.demand
        else:
            moved = (target - self.demand) * elapsed / time_left
        self.speed = moved / elapsed if elapsed > 0.0 else 0.0
        self.demand += moved
        self._turn(elapsed, load)

    def ramp_down(self, deceleration: float, elapsed: float, load: int) -> None:
        """Slows down at a rate [counts/s²] and then holds; ``load`` as for `follow`."""
        stopping = min(elapsed, abs(self.speed) / deceleration)
        slowed = 0.0  # exactly: a rounding remainder of the speed might never decay
        if stopping == elapsed:
            slowed = self.speed - math.copysign(deceleration * stopping, self.speed)
        self.demand += 0.5 * (self.speed + slowed) * stopping
        self.speed = slowed
        self._turn(elapsed, load)

    def yield_to(self, load: int, distance: float) -> None:
        """Moves a motor at its torque limit, back with the load or forward against it.

        Args:
            load: Sign of the direction in which the motor pulls.
            distance: Motion in that direction, [counts], up to the demand; negative with the load.
        """
        if not self.jammed:
            self.position += load * min(distance, max(0.0, self.following_error * load))

    def release(self) -> None:
        """Torque off, brake closed: the shaft stays, and the demand is set to it."""
        self.demand, self.speed = self.position, 0.0

    def _turn(self, elapsed: float, load: int) -> None:
        if self.jammed:
            return
        wanted = self.demand - self.position
        if self.stick and abs(wanted) < self.stick:
            return
        reachable = self.top_speed * elapsed
        moved = max(-reachable, min(reachable, wanted))
        if moved * load <= 0.0:
            self.position += moved


# Units of a drive's speed and acceleration in counts, by 60A8h to 60AAh. Pure.
#
# Source: CiA 402-2, objects 60A8h to 60AAh: bits 31 to 24 prefix, 23 to 16 numerator, 15 to 8
# denominator; Maxon EPOS4 firmware specification for C0h, revolutions a minute.


POSITION_UNIT, VELOCITY_UNIT, ACCELERATION_UNIT = 0x60A8, 0x60A9, 0x60AA

_COUNTS, _REVOLUTIONS, _RPM = 0xB5, 0xB4, 0xC0
_SECONDS = {0x00: 1.0, 0x03: 1.0, 0x47: 60.0, 0x56: 1.0, 0x57: 1.0}
"""Seconds in each denominator: none, s, min, s² (CiA 303-2: 57h; 56h in some files)."""


def counts_in(unit: int, counts_per_turn: float) -> float | None:
    """Counts, counts/s or counts/s² in one unit; None for an unknown unit.

    Args:
        unit: Value of 60A8h, 60A9h or 60AAh; 0 for counts.
        counts_per_turn: Of the motor shaft.
    """
    if unit == 0:
        return 1.0
    prefix = unit >> 24 & 0xFF
    exponent = prefix - 0x100 if prefix & 0x80 else prefix
    per_turn = {_COUNTS: 1.0, _REVOLUTIONS: counts_per_turn, _RPM: counts_per_turn / 60.0}
    numerator, seconds = per_turn.get(unit >> 16 & 0xFF), _SECONDS.get(unit >> 8 & 0xFF)
    if numerator is None or seconds is None:
        return None
    return numerator * 10.0**exponent / seconds
