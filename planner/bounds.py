"""The smallest value of a function along a path, proved from how fast it can change.

A function that changes by no more than ``slope`` per unit of path is, between two samples v and w
at a distance d, at least (v + w - slope d) / 2. Intervals are halved, all undecided ones at a time,
until none can hold a value that matters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cdpr.errors import Fault
from cdpr.poses import Array

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
        raise Fault("a value along the path is no number, so nothing can be proved")
    return values
