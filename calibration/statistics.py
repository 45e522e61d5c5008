"""A number and how far off it may be; a few of many things, spread over all of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.stats import chi2

from model.pose import Array

CONFIDENCE = 0.95
"""Of every interval that a calibration states."""


@dataclass(frozen=True, slots=True)
class Interval:
    """The range that holds a number with 95 % confidence.

    Attributes:
        value: What was found.
        half_width: How far off it may be, in the same unit.
    """

    value: float
    half_width: float

    @classmethod
    def between(cls, low: float, high: float) -> Interval:
        """The interval with these ends."""
        return cls((low + high) / 2.0, (high - low) / 2.0)

    @property
    def bounds(self) -> list[float]:
        """Its ends."""
        return [self.value - self.half_width, self.value + self.half_width]

    def __str__(self) -> str:
        """Value and half width, to two digits of the half width."""
        if not 0.0 < self.half_width < math.inf:
            return f"{self.value:.6g} {self.doubt}"
        return f"{self.value:z.{self._decimals}f} {self.doubt}"

    @property
    def doubt(self) -> str:
        """The half width alone, where the value is 0 by its meaning."""
        if not 0.0 < self.half_width < math.inf:
            return f"± {self.half_width:g}"
        return f"± {self.half_width:.{self._decimals}f}"

    @property
    def _decimals(self) -> int:
        return max(0, 1 - math.floor(math.log10(self.half_width)))


# The jackknife: what leaving a part of the data out changes shows scatter that a model does not.


def jackknife(without: Array) -> Array:
    """Covariance by the changes of n numbers when each of p parts is left out, shape (n, n).

    Args:
        without: Shape (p, n).

    Source: Efron & Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 11.
    """
    spread, count = without - without.mean(axis=0), len(without)
    return np.asarray((count - 1) / count * spread.T @ spread)


def widened(covariance: Array, without: Array) -> Array:
    """A covariance as much wider as the jackknife's is, in the mean of all directions.

    It stays as it is where the jackknife's is wider by no more than chance makes it: by two
    deviations of a mean of as many squares.

    Args:
        covariance: By the scatter, shape (n, n).
        without: As `jackknife` takes it.
    """
    count, size = without.shape
    ratio = float(np.trace(np.linalg.solve(covariance, jackknife(without)))) / size
    ratio *= kept_share(count, size)
    by_chance = 2.0 * float(np.sqrt(2.0 / (size * (count - 1))))
    return np.asarray(covariance * (ratio if ratio > 1.0 + by_chance else 1.0))


def kept_share(parts: int, numbers: int) -> float:
    """Share of a jackknife's variance that is the numbers': parts that weigh much make it too wide.

    Half of their usual weight, numbers by parts, is taken off.
    """
    return max(0.0, 1.0 - numbers / (2.0 * parts))


# How large several numbers together are by chance, which is not how large each of them is.


def rms_bound(covariance: Array, slopes: Array) -> float:
    """What the RMS of quantities exceeds in one case of twenty, by normal errors they depend on.

    Their squares' sum is taken as a multiple of a chi-squared one with the same mean and variance.
    Of one quantity it is 1.96 deviations; of many independent ones hardly more than their RMS.

    Args:
        covariance: Of n errors, shape (n, n).
        slopes: Of k quantities by them, shape (k, n).

    Source: Satterthwaite, Biometrics Bulletin 2(6), 1946.
    """
    spread = covariance @ (slopes.T @ slopes) / len(slopes)
    mean, square = float(np.trace(spread)), float(np.trace(spread @ spread))
    if not 0.0 < square < np.inf:
        return max(mean, 0.0)  # exactly known, or not at all
    return float(np.sqrt(square / mean * chi2.ppf(CONFIDENCE, mean**2 / square)))


# Huber's loss: what is far off counts by its distance, not by its square.


def huber(distances: Array, bend: float) -> Array:
    """The loss of distances, which are not negative; their square up to ``bend``."""
    cost: Array = np.where(distances <= bend, distances**2, 2.0 * bend * distances - bend**2)
    return cost


def share_of(distances: Array, bend: float) -> Array:
    """The weight that makes a square of what counts less."""
    share: Array = bend / np.maximum(distances, bend)
    return share


# A few of many things that come one after the other, spread over all of them.


T = TypeVar("T")


class EvenSample(Generic[T]):
    """Keeps up to twice as many things as are wanted, at equal distances."""

    def __init__(self, wanted: int) -> None:
        """Nothing was added yet.

        Args:
            wanted: How many to choose in the end, at most.
        """
        self._wanted, self._every, self._count = wanted, 1, 0
        self._kept: list[T] = []

    def add(self, thing: T) -> None:
        """The next one."""
        if self._count % self._every == 0:
            self._kept.append(thing)
        self._count += 1
        if len(self._kept) == 2 * self._wanted:
            self._kept, self._every = self._kept[::2], 2 * self._every

    def chosen(self) -> list[T]:
        """The wanted number, in their order; all where there were no more."""
        last, wanted = len(self._kept) - 1, min(self._wanted, len(self._kept))
        places = [round(k * last / max(wanted - 1, 1)) for k in range(wanted)]
        return [self._kept[place] for place in places]


# Images between which nothing moved: copies, or images of what stood still.
#
# They err alike, and together they show no more than one. A copy that was saved again as JPEG has
# its corners elsewhere by as much as noise moves them, so one limit finds both.


SAME_VIEW = 0.1
"""Corners that nothing moved are nearer than that to each other in two images, RMS, [px]."""


def is_duplicate_view(corners: Array, before: Array) -> bool:
    """Whether the same corners are in the same places, shape (..., 2) both, [px]."""
    return bool(np.mean(np.sum((corners - before) ** 2, axis=-1)) < SAME_VIEW**2)


def as_in(first: str) -> str:
    """Why an image is not used that shows the same as another, named ``first``."""
    return f"duplicates {first}: nothing moved in between"
