"""The time law along a path: jerk-limited, slower in tight corners, at rest at both ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import ruckig

from cdpr.errors import Fault
from cdpr.poses import Array
from cdpr.rig import Motion
from executor.path import Path


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """Travelled length over time.

    Attributes:
        pieces: One jerk-limited move for each segment of the path.
        starts: Time at which each begins, and the end, shape (n + 1,), [s].
    """

    pieces: tuple[ruckig.Trajectory, ...]
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
        position, speed, acceleration = self.pieces[index].at_time(time - self.starts[index])
        return position[0], speed[0], acceleration[0]


def time_law(path: Path, motion: Motion) -> TimeLaw:
    """The fastest jerk-limited run along a path within the motion limits.

    In a rounded corner the speed is held so low that v²κ stays within the acceleration limit; where
    two straight segments meet at an angle (a corner that could not be rounded) the path stops.

    Raises:
        Fault: No time law was found (never seen; the limits are consistent by construction).
    """
    caps = [_speed_cap(s.curvature, motion) for s in path.segments]
    speeds = _boundary_speeds(path, caps, motion)
    pieces, starts = [], [0.0]
    for index, segment in enumerate(path.segments):
        piece = _piece(
            (float(path.starts[index]), speeds[index]),
            (float(path.starts[index]) + segment.length, speeds[index + 1]),
            caps[index],
            motion,
        )
        pieces.append(piece)
        starts.append(starts[-1] + piece.duration)
    return TimeLaw(tuple(pieces), np.array(starts))


def _speed_cap(curvature: float, motion: Motion) -> float:
    if curvature == 0.0:
        return motion.speed
    return min(motion.speed, math.sqrt(motion.acceleration / curvature))


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
        speeds[i + 1] = _reachable(speeds[i], speeds[i + 1], segment.length, motion)
    for i in reversed(range(len(segments))):
        speeds[i] = _reachable(speeds[i + 1], speeds[i], segments[i].length, motion)
    return speeds


def _reachable(known: float, wanted: float, length: float, motion: Motion) -> float:
    """The largest speed up to ``wanted`` that can be reached from ``known`` within a length."""
    if wanted <= known or _change_length(known, wanted, motion) <= length:
        return wanted
    low, high = known, wanted
    for _ in range(60):
        middle = (low + high) / 2.0
        if _change_length(known, middle, motion) <= length:
            low = middle
        else:
            high = middle
    return low


def _change_length(slow: float, fast: float, motion: Motion) -> float:
    """Length to change speed with zero acceleration at both ends (symmetric S-curve), [m]."""
    change = fast - slow
    if change <= motion.acceleration**2 / motion.jerk:
        time = 2.0 * math.sqrt(change / motion.jerk)
    else:
        time = change / motion.acceleration + motion.acceleration / motion.jerk
    return (slow + fast) / 2.0 * time


def _piece(
    start: tuple[float, float], end: tuple[float, float], cap: float, motion: Motion
) -> ruckig.Trajectory:
    request = ruckig.InputParameter(1)
    request.current_position, request.current_velocity = [start[0]], [start[1]]
    request.target_position, request.target_velocity = [end[0]], [end[1]]
    request.current_acceleration, request.target_acceleration = [0.0], [0.0]
    request.max_velocity = [max(cap, start[1], end[1]) * (1.0 + 1e-9)]
    request.max_acceleration, request.max_jerk = [motion.acceleration], [motion.jerk]
    trajectory = ruckig.Trajectory(1)
    result = ruckig.Ruckig(1).calculate(request, trajectory)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise Fault(f"no time law for a segment of the path: ruckig says {result}")
    return trajectory
