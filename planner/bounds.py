"""The smallest value of a function along a path, proved from how fast it can change.

A function that changes by no more than ``slope`` per unit of path is, between two samples v and w
at a distance d, at least (v + w - slope d) / 2. Intervals are halved, all undecided ones at a time,
until none can hold a value that matters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from model.clearance import ClearanceModel
from model.errors import Fault
from model.pose import Array, Pose
from planner.path import PosePath

SHORTEST = 1e-6
MOST_SAMPLES = 40000


@dataclass(frozen=True, slots=True, eq=False)
class Smallest:
    """Where a function along a path is smallest.

    Attributes:
        value: The smallest sample.
        at: Its place on the path.
        proved: No value anywhere on the path is below this.
        samples: How many were taken.
    """

    value: float
    at: float
    proved: float
    samples: int


def smallest_along(
    places: Array,
    evaluate: Callable[[Array], Array],
    slope: float,
    required: float,
    tolerance: float,
) -> Smallest:
    """Finds the smallest value to a tolerance, and finer where that is needed to prove a limit.

    Args:
        places: Where to sample first, increasing, both ends of the path among them, shape (k,).
        evaluate: Values at places, shape (k,) → (k,).
        slope: Largest change of the value per unit of path.
        required: The limit: where every sample keeps it, the proof is to keep it too.
        tolerance: Wanted of ``value - proved``.

    Raises:
        Fault: A value is no number.
    """
    values = _known(evaluate(places))
    best = int(np.argmin(values))
    smallest, at, samples = float(values[best]), float(places[best]), len(places)
    low, high = places[:-1], places[1:]
    low_values, high_values = values[:-1], values[1:]
    proved = smallest
    while len(low):
        bounds = (low_values + high_values - slope * (high - low)) / 2.0
        target = to_be_proved(smallest, required, tolerance)
        final = (bounds >= target) | (high - low < SHORTEST)
        if samples > MOST_SAMPLES:
            final[:] = True
        proved = min(proved, float(bounds[final].min(initial=np.inf)))
        low, high = low[~final], high[~final]
        low_values, high_values = low_values[~final], high_values[~final]
        if not len(low):
            break
        middle = (low + high) / 2.0
        values = _known(evaluate(middle))
        samples += len(middle)
        best = int(np.argmin(values))
        if values[best] < smallest:
            smallest, at = float(values[best]), float(middle[best])
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
        low_values = np.concatenate([low_values, values])
        high_values = np.concatenate([values, high_values])
    return Smallest(smallest, at, min(proved, smallest), samples)


def to_be_proved(smallest: float, required: float, tolerance: float) -> float:
    """What the rest of a path must be shown to reach, beside its smallest sample."""
    target = smallest - tolerance
    return max(target, required) if smallest >= required else target


def _known(values: Array) -> Array:
    """Values as they are; one that is no number would prove whatever stands beside it."""
    if np.isnan(values).any():
        raise Fault("a value along the path is not a number, so nothing can be proved")
    return values


# The smallest obstacle clearance of a path in translation, proved a whole stretch at a time.
#
# A plane between an obstacle and the robot at one pose still parts them, by a gap in closed form,
# while the platform shifts. Where that gap is large enough over a stretch of the path, all of it is
# proved; else the stretch is halved. Far fewer poses are looked at than where only the speed of
# change is known (`planner.bounds`), most of all where a path passes along an obstacle.


FIRST = 0.040
"""Longest stretch to begin with, [m] of motion."""


def smallest_over_stretches(
    model: ClearanceModel, track: PosePath, required: float, tolerance: float
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
        raise Fault("a distance along the path is unknown, so nothing can be proved")
    return found.distance
