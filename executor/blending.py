"""Rounds the corners of a plan as far as the tolerance and the clearance allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cdpr.poses import Pose, interpolate
from executor.path import Path, Segment, corner, corner_deviation, line, poses_of

#: A corner takes at most this share of each neighbouring line, so that corners never meet.
LONGEST_SHARE = 0.45
#: How often a corner that is too tight is halved before the path stops at it instead.
HALVINGS = 5

IsAllowed = Callable[[Sequence[Pose]], bool]


def rounded(
    waypoints: Sequence[Pose], tolerance: float, weight: float, is_allowed: IsAllowed
) -> Path:
    """The path through waypoints with rounded corners.

    Rounding cuts a corner on its inner side, where an obstacle usually is. Each corner is therefore
    checked; one that is too tight is rounded less, and if nothing helps the path goes through the
    corner itself and stops there.

    Args:
        waypoints: At least two poses, ``world_from_platform``.
        tolerance: Largest distance of a rounded corner from the sharp one, [m]; 0 keeps all sharp.
        weight: Metres of path for a radian of rotation.
        is_allowed: Tells whether all of some dense poses keep the scene's clearances.
    """
    points = _distinct(waypoints)
    segments: list[Segment] = []
    begin = points[0]
    for before, at, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        turn = _largest_allowed(before, at, after, tolerance, weight, is_allowed)
        if turn is None:
            segments.append(line(begin, at, weight))
            begin = at
            continue
        start, end, segment = turn
        segments += [line(begin, start, weight), segment]
        begin = end
    segments.append(line(begin, points[-1], weight))
    return Path(tuple(segments))


def _distinct(waypoints: Sequence[Pose]) -> list[Pose]:
    """Waypoints without repeats; at least two remain."""
    kept = [waypoints[0]]
    for pose in waypoints[1:]:
        if pose.distance_to(kept[-1]) > 1e-9 or pose.angle_to(kept[-1]) > 1e-9:
            kept.append(pose)
    return kept if len(kept) > 1 else [waypoints[0], waypoints[-1]]


def _largest_allowed(
    before: Pose,
    at: Pose,
    after: Pose,
    tolerance: float,
    weight: float,
    is_allowed: IsAllowed,
) -> tuple[Pose, Pose, Segment] | None:
    share = LONGEST_SHARE
    legs = [line(at, end, weight).length for end in (before, after)]
    reach = min(share * min(legs), _reach(before, at, after, legs, tolerance))
    for _ in range(HALVINGS):
        if reach <= 0.0:
            return None
        start = interpolate(at, before, reach / legs[0])
        end = interpolate(at, after, reach / legs[1])
        segment = corner(start, at, end, weight)
        steps = max(9, int(np.ceil(segment.length / 0.001)))
        samples = poses_of(*segment.at(np.linspace(0.0, segment.length, steps)))
        if is_allowed(samples):
            return start, end, segment
        reach /= 2.0
    return None


def _reach(before: Pose, at: Pose, after: Pose, legs: list[float], tolerance: float) -> float:
    """Length of the two legs at which the corner leaves the sharp one by the tolerance, [m]."""
    start = interpolate(at, before, min(1.0, 1e-3 / legs[0]))
    end = interpolate(at, after, min(1.0, 1e-3 / legs[1]))
    deviation = corner_deviation(start, at, end)
    if deviation < 1e-12:  # the two lines are one: any rounding is the line itself
        return float("inf")
    return tolerance * min(1e-3, *legs) / deviation
