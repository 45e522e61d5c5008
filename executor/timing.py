"""The time law along a path: jerk-limited, slower in tight corners, at rest at both ends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cdpr.poses import Array
from cdpr.rig import Motion
from executor.path import Path, Segment
from executor.s_curve import SCurve, length_to_change, s_curve

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

    All speeding up and slowing down is done on straight segments. A rounded corner is passed at one
    speed, so low that what its bend makes of it stays within the limits of acceleration and jerk;
    so the limits hold for the platform's motion in space, not only along the path. Where two
    straight segments meet at an angle (a corner that could not be rounded) the path stops.

    Raises:
        Fault: No time law was found (never seen; the limits are consistent by construction).
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
    """Speeds where segments meet: as high as both allow and the lengths let them be reached."""
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
