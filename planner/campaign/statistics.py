"""Means, deviations and bootstrap intervals of campaigns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array

_RESAMPLES = 2000
_SEED = 20230516
_LEVELS = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Summary:
    """A sample in figures.

    Attributes:
        count: Its size.
        mean: Its mean.
        deviation: Its standard deviation.
        low: Lower end of the 95 % bootstrap interval of the mean.
        high: Its upper end.
    """

    count: int
    mean: float
    deviation: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Change:
    """How a figure of one planner differs from another's, as a part of the other's.

    Attributes:
        each: In every environment.
        mean: Over the environments.
        low: Lower end of the 95 % bootstrap interval of `mean`.
        high: Its upper end.
    """

    each: tuple[float, ...]
    mean: float
    low: float
    high: float


def summary(values: Array) -> Summary:
    """Figures of a sample, shape (k,), k ≥ 1."""
    means = values[_resampled(len(values))].mean(axis=1)
    low, high = (float(x) for x in np.percentile(means, _LEVELS))
    deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return Summary(len(values), float(values.mean()), deviation, low, high)


def change_of_means(pairs: Sequence[tuple[Array, Array]]) -> Change:
    """Change of the mean from the second sample of each pair to the first.

    Args:
        pairs: One of each environment; the samples of a pair have the same seeds in the same order,
            shape (k,) each, and are resampled together, as random ends tie them to each other.
    """
    return _change(pairs, _mean)


def change_of_deviations(pairs: Sequence[tuple[Array, Array]]) -> Change:
    """Change of the standard deviation; see `change_of_means`."""
    return _change(pairs, _deviation)


def _change(pairs: Sequence[tuple[Array, Array]], figure: Callable[[Array], Array]) -> Change:
    each = [float(figure(one[None])[0] / figure(other[None])[0] - 1.0) for one, other in pairs]
    resampled = np.zeros(_RESAMPLES)
    for k, (one, other) in enumerate(pairs):
        rows = _resampled(len(one), k)
        resampled += figure(one[rows]) / figure(other[rows]) - 1.0
    low, high = (float(x) for x in np.percentile(resampled / len(pairs), _LEVELS))
    return Change(tuple(each), float(np.mean(each)), low, high)


def _mean(samples: Array) -> Array:
    means: Array = samples.mean(axis=1)
    return means


def _deviation(samples: Array) -> Array:
    if samples.shape[1] < 2:
        return np.full(len(samples), np.nan)
    deviations: Array = np.maximum(samples.std(axis=1, ddof=1), 1e-300)
    return deviations


def _resampled(size: int, stream: int = 0) -> NDArray[np.int64]:
    """Rows to draw with replacement, shape (resamples, size)."""
    random = np.random.default_rng([_SEED, stream])
    return random.integers(size, size=(_RESAMPLES, size))
