"""The time law along a path: jerk-limited, slower in tight corners, at rest at both ends."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from executor.trajectory.path import Path, Segment
from model.errors import Fault
from model.pose import Array
from model.rig import Motion

# Jerk-limited motion over a given length, from one speed to another, never backwards.
#
# Acceleration is zero at both ends: speed up to a peak, cruise, slow down. Each change of speed
# takes the shortest time that the limits allow, so for given ends the highest peak is the fastest
# motion.
#
# Where the length just suffices (the usual case after corner speeds were reduced to reachable
# ones), the general solver Ruckig moves backwards or fails in one case of ten to ten thousand;
# here the peak is bisected and every phase moves forward by construction.
#
# `speed_change` changes speed alone, from any acceleration and over any length.


_JERK_BISECTIONS = 80


@dataclass(frozen=True, slots=True)
class _Phase:
    """A phase of constant jerk: start time [s]; length, speed and acceleration there; jerk."""

    begin: float
    travelled: float
    speed: float
    acceleration: float
    jerk: float

    def after(self, time: float) -> tuple[float, float, float]:
        """Travelled length, speed and acceleration at a time [s] after its start."""
        acceleration = self.acceleration + self.jerk * time
        speed = self.speed + (self.acceleration + self.jerk * time / 2.0) * time
        distance = (self.speed + (self.acceleration / 2.0 + self.jerk * time / 6.0) * time) * time
        return self.travelled + distance, speed, acceleration


@dataclass(frozen=True, slots=True)
class SCurve:
    """Motion over a length.

    Attributes:
        phases: Of constant jerk, in order.
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


@dataclass(frozen=True, slots=True)
class SpeedChange:
    """A change of speed; afterwards the new speed is kept.

    Attributes:
        phases: Of constant jerk, in order; the last is unbounded.
        duration: Time until the new speed is reached.
    """

    phases: tuple[_Phase, ...]
    duration: float

    def at(self, time: float) -> tuple[float, float, float]:
        """Travelled length, speed and acceleration at a time from 0 on."""
        index = bisect_right(self.phases, time, key=lambda phase: phase.begin) - 1
        phase = self.phases[index]
        return phase.after(time - phase.begin)


def speed_change(
    start: tuple[float, float], end_speed: float, acceleration: float, jerk: float
) -> SpeedChange:
    """The fastest change of speed within acceleration and jerk limits, to zero acceleration.

    The acceleration rises at full jerk to a peak, stays there if the peak is the limit, and
    returns to zero. Units of length and time are the caller's.

    Args:
        start: Initial speed and acceleration; the acceleration is within its limit.
    """
    speed, slope = start
    left = end_speed - speed - slope * abs(slope) / (2.0 * jerk)
    sign = 1.0 if left >= 0.0 else -1.0
    slope, change = sign * slope, sign * (end_speed - speed)
    peak = min(math.sqrt(max(0.0, jerk * change + slope**2 / 2.0)), acceleration)
    ramps = (2.0 * peak**2 - slope**2) / (2.0 * jerk)
    steps = [
        (max(0.0, peak - slope) / jerk, sign * jerk),
        (max(0.0, change - ramps) / peak if peak > 0.0 else 0.0, 0.0),
        (peak / jerk, -sign * jerk),
    ]
    phases = _joined(steps, start)
    duration = phases[-1].begin + steps[-1][0]
    travelled, _, _ = phases[-1].after(steps[-1][0])
    kept = _Phase(duration, travelled, end_speed, 0.0, 0.0)
    return SpeedChange((*phases, kept), duration)


def s_curve(length: float, speeds: tuple[float, float], cap: float, motion: Motion) -> SCurve:
    """The fastest motion over a length between two speeds.

    Args:
        length: [m].
        speeds: Initial and final, neither above ``cap``, [m/s].
        cap: Largest speed, [m/s].
        motion: Limits of acceleration and jerk.

    Raises:
        Fault: The length is too short for the change of speed.
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
    phases = _joined(steps, (start, 0.0))
    return SCurve(phases, length, end, phases[-1].begin + steps[-1][0])


def length_to_change(slow: float, fast: float, motion: Motion) -> float:
    """Length of the fastest change of speed, [m]; the ramp is symmetric about its middle."""
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
    for _ in range(_JERK_BISECTIONS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if ramps(middle) <= length else (low, middle)
    return low


def _joined(steps: list[tuple[float, float]], start: tuple[float, float]) -> tuple[_Phase, ...]:
    """Phases from times and jerks, from an initial speed and acceleration."""
    phases = [_Phase(0.0, 0.0, *start, steps[0][1])]
    for (time, _), (_, jerk) in pairwise(steps):
        last = phases[-1]
        travelled, speed, acceleration = last.after(time)
        phases.append(_Phase(last.begin + time, travelled, speed, acceleration, jerk))
    return tuple(phases)


_BISECTIONS = 60


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """Travelled length over time.

    Attributes:
        pieces: One jerk-limited motion for each segment of the path.
        offsets: Travelled length at which each begins, [m].
        starts: Time at which each begins, and the end, shape (n + 1,), [s].
    """

    pieces: tuple[SCurve, ...]
    offsets: tuple[float, ...]
    starts: Array

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.starts[-1])

    def at(self, time: float) -> tuple[float, float, float]:
        """Travelled length [m], speed [m/s] and acceleration [m/s²] at a time [s]."""
        time = min(max(time, 0.0), self.duration)
        index = int(np.searchsorted(self.starts, time, "right")) - 1
        index = min(max(index, 0), len(self.pieces) - 1)
        travelled, speed, acceleration = self.pieces[index].at(time - float(self.starts[index]))
        return self.offsets[index] + travelled, speed, acceleration


def time_law(path: Path, motion: Motion) -> TimeLaw:
    """A fast jerk-limited run along a path within the motion limits.

    Speed changes only on straight segments. A rounded corner is passed at constant speed, low
    enough that its curvature keeps to the limits of acceleration and jerk; so the limits hold for
    the platform's motion in space, not only along the path. Where two straight segments meet at an
    angle (a corner that could not be rounded), the platform stops.

    Raises:
        Fault: No time law was found (not expected; the limits are consistent by construction).
    """
    caps = [_speed_cap(segment, motion) for segment in path.segments]
    speeds = _boundary_speeds(path, caps, motion)
    pieces = tuple(
        s_curve(segment.length, ends, cap if segment.straight else max(ends), motion)
        for segment, cap, ends in zip(path.segments, caps, pairwise(speeds), strict=True)
    )
    starts = np.concatenate([[0.0], np.cumsum([piece.duration for piece in pieces])])
    return TimeLaw(pieces, tuple(path.starts[:-1].tolist()), starts)


def _speed_cap(segment: Segment, motion: Motion) -> float:
    cap = motion.speed
    bend, bend_change = segment.bends
    if bend > 0.0:
        cap = min(cap, math.sqrt(motion.acceleration / bend))
    if bend_change > 0.0:
        cap = min(cap, math.cbrt(motion.jerk / bend_change))
    return cap


def _boundary_speeds(path: Path, caps: list[float], motion: Motion) -> list[float]:
    """Speeds where segments meet: as high as both allow and the lengths permit."""
    segments = path.segments
    speeds = [0.0]
    for left, right, cap_left, cap_right in zip(
        segments[:-1], segments[1:], caps[:-1], caps[1:], strict=True
    ):
        sharp = left.straight and right.straight
        speeds.append(0.0 if sharp else min(cap_left, cap_right))
    speeds.append(0.0)
    for i, segment in enumerate(segments):
        speeds[i + 1] = _reachable(speeds[i], speeds[i + 1], segment, motion)
    for i in reversed(range(len(segments))):
        speeds[i] = _reachable(speeds[i + 1], speeds[i], segments[i], motion)
    return speeds


def _reachable(known: float, wanted: float, segment: Segment, motion: Motion) -> float:
    """The largest speed up to ``wanted`` at one end of a segment with ``known`` at the other."""
    if not segment.straight:
        return min(known, wanted)
    if wanted <= known or length_to_change(known, wanted, motion) <= segment.length:
        return wanted
    low, high = known, wanted
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2.0
        if length_to_change(known, middle, motion) <= segment.length:
            low = middle
        else:
            high = middle
    return low


# Rest-to-rest motion in a given time.


#: Ratio of the step's peak speed to its mean speed.
PEAK = 1.875


def smooth_step(share: float) -> float:
    """0 to 1 with zero speed and acceleration at both ends."""
    return share**3 * (10.0 - 15.0 * share + 6.0 * share**2)


def smooth_step_duration(length: float, motion: Motion) -> float:
    """Shortest duration [s] of a `smooth_step` over a length [m] within the motion limits."""
    acceleration, jerk = 10.0 / math.sqrt(3.0), 60.0  # its peaks, of unit length and duration
    return max(
        PEAK * length / motion.speed,
        math.sqrt(acceleration * length / motion.acceleration),
        math.cbrt(jerk * length / motion.jerk),
    )
