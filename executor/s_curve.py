"""Jerk-limited motion over a given length, from one speed to another, never backwards.

Acceleration is zero at both ends: speed up to a peak, cruise, slow down. Each change of speed takes
the shortest time that the limits allow, so for given ends the highest peak is the fastest motion.

Ruckig solves the more general problem, but where the length just suffices (the usual case after
corner speeds were cut to what can be reached) it was seen to move backwards or to give up in one
case of ten to ten thousand; here the peak is bisected and every phase goes forward by construction.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

from cdpr.errors import Fault
from cdpr.rig import Motion

_BISECTIONS = 80


@dataclass(frozen=True, slots=True)
class _Phase:
    """A time of constant jerk: begin [s], length, speed and acceleration there, jerk."""

    begin: float
    travelled: float
    speed: float
    acceleration: float
    jerk: float

    def after(self, time: float) -> tuple[float, float, float]:
        """Travelled length, speed and acceleration some time [s] after the begin."""
        acceleration = self.acceleration + self.jerk * time
        speed = self.speed + (self.acceleration + self.jerk * time / 2.0) * time
        way = (self.speed + (self.acceleration / 2.0 + self.jerk * time / 6.0) * time) * time
        return self.travelled + way, speed, acceleration


@dataclass(frozen=True, slots=True)
class SCurve:
    """Motion over a length.

    Attributes:
        phases: Of constant jerk, one after the other.
        length: [m].
        end_speed: [m/s].
        duration: [s].
    """

    phases: tuple[_Phase, ...]
    length: float
    end_speed: float
    duration: float

    def at(self, time: float) -> tuple[float, float, float]:
        """Travelled length [m], speed [m/s] and acceleration [m/s²] at a time [s]."""
        if time >= self.duration:
            return self.length, self.end_speed, 0.0
        index = bisect_right(self.phases, max(time, 0.0), key=lambda phase: phase.begin) - 1
        phase = self.phases[index]
        travelled, speed, acceleration = phase.after(max(time, 0.0) - phase.begin)
        return min(travelled, self.length), max(speed, 0.0), acceleration


def s_curve(length: float, speeds: tuple[float, float], cap: float, motion: Motion) -> SCurve:
    """The fastest motion over a length between two speeds.

    Args:
        length: [m].
        speeds: At the begin and at the end, neither above ``cap``, [m/s].
        cap: Largest speed, [m/s].
        motion: Limits of acceleration and jerk.

    Raises:
        Fault: The length does not suffice to change the speed.
    """
    start, end = speeds
    peak = _peak(length, speeds, cap, motion)
    ramps = length_to_change(start, peak, motion) + length_to_change(end, peak, motion)
    if ramps > length * (1.0 + 1e-9) or peak <= 0.0 < length:
        raise Fault(
            f"no time law: {length * 1000:.6f} mm do not suffice to go from {start * 1000:.3f} to"
            f" {end * 1000:.3f} mm/s",
            where="trajectory",
            next_step="this is a defect of the program; please report it with the plan",
        )
    cruise = max(0.0, length - ramps) / peak if peak else 0.0
    steps = [*_ramp(peak - start, motion, 1.0), (cruise, 0.0), *_ramp(peak - end, motion, -1.0)]
    return _joined(steps, length, speeds)


def length_to_change(slow: float, fast: float, motion: Motion) -> float:
    """Length to change speed in the shortest time, [m]; the ramp is symmetric about its middle."""
    return (slow + fast) / 2.0 * sum(time for time, _ in _ramp(fast - slow, motion, 1.0))


def _ramp(change: float, motion: Motion, sign: float) -> list[tuple[float, float]]:
    """Times and jerks of a change of speed: up from the slow one (+1) or down to it (−1)."""
    change = max(change, 0.0)
    jerk = sign * motion.jerk
    if change <= motion.acceleration**2 / motion.jerk:
        rise = math.sqrt(change / motion.jerk)
        return [(rise, jerk), (rise, -jerk)]
    rise = motion.acceleration / motion.jerk
    return [(rise, jerk), (change / motion.acceleration - rise, 0.0), (rise, -jerk)]


def _peak(length: float, speeds: tuple[float, float], cap: float, motion: Motion) -> float:
    def ramps(peak: float) -> float:
        return sum(length_to_change(speed, peak, motion) for speed in speeds)

    low, high = max(speeds), max(cap, *speeds)
    if ramps(high) <= length:
        return high
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if ramps(middle) <= length else (low, middle)
    return low


def _joined(steps: list[tuple[float, float]], length: float, speeds: tuple[float, float]) -> SCurve:
    phases = [_Phase(0.0, 0.0, speeds[0], 0.0, steps[0][1])]
    for (time, _), (_, jerk) in pairwise(steps):
        last = phases[-1]
        travelled, speed, acceleration = last.after(time)
        phases.append(_Phase(last.begin + time, travelled, speed, acceleration, jerk))
    return SCurve(tuple(phases), length, speeds[1], phases[-1].begin + steps[-1][0])
