"""The smallest obstacle clearance of a path in translation, proved a whole stretch at a time.

A plane between an obstacle and the robot at one pose still parts them, by a gap in closed form,
while the platform shifts. Where that gap is large enough over a stretch of the path, all of it is
proved; else the stretch is halved. Far fewer poses are looked at than where only the speed of
change is known (`planner.bounds`), most of all where a path passes along an obstacle.
"""

from __future__ import annotations

from itertools import pairwise

from cdpr.clearance import ClearanceModel
from cdpr.errors import Fault
from cdpr.poses import Pose
from planner.bounds import MOST_SAMPLES, SHORTEST, Smallest, to_be_proved
from planner.track import Track

FIRST = 0.040
"""Longest stretch to begin with, [m] of motion."""


def smallest_over_stretches(
    model: ClearanceModel, track: Track, required: float, tolerance: float
) -> Smallest:
    """Finds the smallest obstacle clearance to a tolerance, and finer to prove a limit.

    Args:
        model: Of a rig with point exits, in a scene with obstacles.
        track: A path on which the platform does not turn.
        required: The limit: where every sample keeps it, the proof is to keep it too, [m].
        tolerance: Wanted of ``value - proved``, [m].

    Raises:
        Fault: A distance is no number.
    """
    places = track.places(FIRST).tolist()
    values = [_distance(model, track.pose(place)) for place in places]
    smallest, at = min(zip(values, places, strict=True))
    waiting = list(pairwise(places))
    samples, proved = len(places), smallest
    while waiting:
        low, high = waiting.pop()
        target = to_be_proved(smallest, required, tolerance)
        middle = (low + high) / 2.0
        pose = track.pose(middle)
        bound = model.at_least(pose, track.positions(low, high), target)
        if bound >= target or high - low < SHORTEST or samples > MOST_SAMPLES:
            proved = min(proved, bound)
            continue
        value = _distance(model, pose)
        samples += 1
        if value < smallest:
            smallest, at = value, middle
        waiting += [(low, middle), (middle, high)]
    return Smallest(smallest, at, min(proved, smallest), samples)


def _distance(model: ClearanceModel, pose: Pose) -> float:
    """The smallest distance; one that is no number would prove whatever stands beside it."""
    found = model.smallest(pose)
    if found is None or found.distance != found.distance:
        raise Fault("a distance along the path is not known, so nothing can be proved")
    return found.distance
