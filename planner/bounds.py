"""The smallest value of a function along a path, proved from how fast it can change.

A function that changes by no more than c between two samples v and w is, between them, at least
(v + w - c) / 2. All undecided intervals are bisected together until none can hold a value that
matters.
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

SHORTEST = 1e-7
"""Shortest interval, [m] of motion: with lever arms of 60 m far below the planner's reserves."""
MOST_SAMPLES = 40000
"""Samples after which only the limit is still to be proved; at twice as many bisection ends."""
MOST_PER_SAMPLE = 80
"""On long paths it ends at this many for each of the first: 128 for every 5 mm prove the planners'
smallest reserve, 0.05 mm, also where two cables on pulleys change their distance twice as fast."""


@dataclass(frozen=True, slots=True, eq=False)
class Smallest:
    """Where a function along a path is smallest.

    Attributes:
        value: The smallest sample.
        at: Its position along the path.
        proved: Lower bound of the value everywhere on the path.
        samples: Number of samples.
    """

    value: float
    at: float
    proved: float
    samples: int


def smallest_along(
    positions: Array,
    evaluate: Callable[[Array], Array],
    largest_change: Callable[[Array], Array],
    required: float,
    tolerance: float,
    share: float = 0.0,
) -> Smallest:
    """Finds the smallest value to a tolerance, or finer where a limit is otherwise not proved.

    Where a value stays the same along a path, every interval must be bisected until its change is
    within the tolerance: far above its limit a value is worth less effort. Where the tolerance
    takes too many samples, the proof is of the limit alone.

    Args:
        positions: First samples along the path, increasing, with both ends, shape (k,).
        evaluate: Values at positions, shape (k,) → (k,).
        largest_change: Of the value from the start to positions, shape (k,) → (k,); see
            `planner.path.PosePath.largest_change`.
        required: Limit of the value; if every sample keeps it, the proof must as well.
        tolerance: Largest ``value - proved``, unless it takes more than `MOST_SAMPLES`.
        share: Part of ``value - required`` that the tolerance may be, where that is more.

    Raises:
        Fault: A value is NaN.
    """
    values = _known(evaluate(positions))
    best = int(np.argmin(values))
    smallest, at, samples = float(values[best]), float(positions[best]), len(positions)
    low, high = positions[:-1], positions[1:]
    low_values, high_values = values[:-1], values[1:]
    proved, most = smallest, max(2 * MOST_SAMPLES, MOST_PER_SAMPLE * samples)
    while len(low):
        change = largest_change(high) - largest_change(low)
        bounds = (low_values + high_values - change) / 2.0
        target = to_be_proved(smallest, required, tolerance, share)
        if samples > MOST_SAMPLES:
            target = min(target, required)
        final = (bounds >= target) | (high - low < SHORTEST) | (samples > most)
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


def to_be_proved(smallest: float, required: float, tolerance: float, share: float = 0.0) -> float:
    """The bound to prove for the rest of a path, given its smallest sample."""
    if smallest < required:
        return smallest - tolerance
    if share > 0.0:
        tolerance = max(tolerance, share * (smallest - required))
    return max(smallest - tolerance, required)


def _known(values: Array) -> Array:
    """The values; a NaN would pass every comparison and so prove anything."""
    if np.isnan(values).any():
        raise Fault("a value along the path is not a number, so nothing can be proved")
    return values


# The smallest obstacle clearance of a path in translation, proved over whole intervals.
#
# A plane that separates an obstacle from the robot at one pose still separates them, by a gap in
# closed form, while the platform translates. Where that gap is large enough over an interval of the
# path, the interval is proved; else it is bisected. This takes far fewer poses than a bound on the
# rate of change (`smallest_along`), above all where a path runs along an obstacle.


FIRST = 0.040
"""Longest interval at first, [m] of motion."""


def smallest_over_intervals(
    model: ClearanceModel, path: PosePath, required: float, tolerance: float
) -> Smallest:
    """Finds the smallest obstacle clearance to a tolerance, or finer to prove a limit.

    Args:
        model: Of a rig with point exits, in a scene with obstacles.
        path: A path on which the platform does not rotate.
        required: Limit of the clearance; if every sample keeps it, the proof must as well, [m].
        tolerance: Largest ``value - proved``, [m].

    Raises:
        Fault: A distance is NaN.
    """
    positions = path.samples(FIRST).tolist()
    values = [_distance(model, path.pose(position)) for position in positions]
    smallest, at = min(zip(values, positions, strict=True))
    waiting = list(pairwise(positions))
    samples, proved = len(positions), smallest
    while waiting:
        low, high = waiting.pop()
        target = to_be_proved(smallest, required, tolerance)
        middle = (low + high) / 2.0
        pose = path.pose(middle)
        bound = model.at_least(pose, path.positions(low, high), target)
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
    """The smallest distance; a NaN would pass every comparison and so prove anything."""
    found = model.smallest(pose)
    if found is None or found.distance != found.distance:
        raise Fault("a distance along the path is unknown, so nothing can be proved")
    return found.distance
