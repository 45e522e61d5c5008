"""Rounds the corners of a plan as far as the tolerance and the clearance allow."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from executor.trajectory.path import MIDDLE_SHARE, Path, Segment, corner, direction, line, poses_of
from model.pose import Pose, interpolate

#: A corner takes at most this share of each neighbouring line, so that corners never meet.
LONGEST_SHARE = 0.45
#: How often a corner that is too tight is halved before the path stops at it instead.
HALVINGS = 5
#: A turn of more than 105° is not rounded: its curve is so tight that a stop takes less time
#: (measured for both ready rigs), and that of a turn straight back has no direction at all.
SHARPEST_TURN = float(np.radians(105.0))
#: Waypoints that change the path by less are left out, [m] and [rad].
SAME = 1e-9

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
        tolerance: Largest distance of a rounded corner from the sharp one, rotation counted as
            ``weight`` metres for a radian, [m]; 0 keeps all sharp.
        weight: Metres of path for a radian of rotation.
        is_allowed: Returns whether all of some dense poses keep the scene's clearances.
    """
    points = _needed(waypoints, weight)
    segments: list[Segment] = []
    begin = points[0]
    for before, at, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        turn = _largest_allowed((before, at, after), tolerance, weight, is_allowed)
        if turn is None:
            segments.append(line(begin, at, weight))
            begin = at
            continue
        start, end, segment = turn
        segments += [line(begin, start, weight), segment]
        begin = end
    segments.append(line(begin, points[-1], weight))
    return Path(tuple(segments))


def _needed(waypoints: Sequence[Pose], weight: float) -> list[Pose]:
    """Waypoints without repeats and without those on the way between their neighbours."""
    kept = [waypoints[0]]
    for pose in waypoints[1:]:
        if _same(pose, kept[-1]):
            continue
        if len(kept) > 1 and _on_the_way(kept[-2], kept[-1], pose, weight):
            kept.pop()
        kept.append(pose)
    return kept if len(kept) > 1 else [waypoints[0], waypoints[-1]]


def _same(a: Pose, b: Pose) -> bool:
    return a.distance_to(b) <= SAME and a.angle_to(b) <= SAME


def _on_the_way(before: Pose, at: Pose, after: Pose, weight: float) -> bool:
    """Whether the straight move from the first to the last passes through the second."""
    legs = [line(before, at, weight).length, line(at, after, weight).length]
    return _same(interpolate(before, after, legs[0] / sum(legs)), at)


def _largest_allowed(
    turn: tuple[Pose, Pose, Pose], tolerance: float, weight: float, is_allowed: IsAllowed
) -> tuple[Pose, Pose, Segment] | None:
    before, at, after = turn
    lengths = [line(before, at, weight).length, line(at, after, weight).length]
    # Both moves as they are run, from before to after: a half turn read backwards goes astray.
    legs = [
        direction(at, interpolate(before, at, 0.5), weight),
        direction(at, interpolate(at, after, 0.5), weight),
    ]
    if -legs[0] @ legs[1] < np.cos(SHARPEST_TURN):
        return None
    deviation = MIDDLE_SHARE * float(np.linalg.norm(legs[0] + legs[1]))  # for a metre of leg
    reach = min(LONGEST_SHARE * min(lengths), tolerance / max(deviation, 1e-12))
    for _ in range(HALVINGS):
        if reach <= 0.0:
            return None
        start = interpolate(before, at, 1.0 - reach / lengths[0])
        end = interpolate(at, after, reach / lengths[1])
        segment = corner(start, at, end, weight)
        steps = max(9, int(np.ceil(segment.length / 0.001)))
        samples = poses_of(*segment.at(np.linspace(0.0, segment.length, steps)))
        if is_allowed(samples):
            return start, end, segment
        reach /= 2.0
    return None
