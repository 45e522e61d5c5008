"""A number and how far off it may be."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
