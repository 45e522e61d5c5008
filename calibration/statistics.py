"""Confidence intervals, jackknife, robust loss, even sampling and duplicate views."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.special import gammaincinv, stdtrit

from model.pose import Array

CONFIDENCE = 0.95
"""Confidence of every interval that a calibration states."""


_MOST_APART = 1e13
"""Ratio of eigenvalues from which a matrix scaled to a diagonal of 1 is singular."""

# Bounds of two distributions; `scipy.stats` has them, too, and takes half a second to import.


def chi_squared_bound(freedom: float) -> float:
    """The 95 % quantile of the chi-squared distribution with these degrees of freedom."""
    return 2.0 * float(gammaincinv(freedom / 2.0, CONFIDENCE))


def student_factor(freedom: int) -> float:
    """Half width of a 95 % interval in deviations, which have these degrees of freedom."""
    return float(stdtrit(freedom, 0.5 + CONFIDENCE / 2.0))


@dataclass(frozen=True, slots=True)
class Interval:
    """The range that holds a number with 95 % confidence.

    Attributes:
        value: The estimate.
        half_width: Half width of the interval, in the same unit.
        skew: Middle of the interval beyond the estimate, in the same unit.
    """

    value: float
    half_width: float
    skew: float = 0.0

    @classmethod
    def between(cls, low: float, high: float, value: float | None = None) -> Interval:
        """The interval with these bounds; the estimate is its middle when left out."""
        middle = (low + high) / 2.0
        value = middle if value is None else value
        return cls(value, (high - low) / 2.0, middle - value)

    @classmethod
    def by_factor(cls, value: float, factor: float) -> Interval:
        """The interval from the estimate divided by a factor to the estimate times it."""
        return cls.between(value / factor, value * factor, value)

    @property
    def bounds(self) -> list[float]:
        """Lower and upper bound."""
        middle = self.value + self.skew
        return [middle - self.half_width, middle + self.half_width]

    def __str__(self) -> str:
        """Value and half width, to two digits of the half width."""
        if not 0.0 < self.half_width < math.inf:
            return f"{self.value:.6g} {self.half_width_text}"
        return f"{self.value:z.{self._decimals}f} {self.half_width_text}"

    @property
    def half_width_text(self) -> str:
        """The half width alone, for values that are 0 by definition; both, where they differ."""
        if not 0.0 < self.half_width < math.inf:
            return f"± {self.half_width:g}"
        if self.skew:
            above, below = self.half_width + self.skew, self.half_width - self.skew
            return f"+{above:.{self._decimals}f} -{below:.{self._decimals}f}"
        return f"± {self.half_width:.{self._decimals}f}"

    @property
    def _decimals(self) -> int:
        return max(0, 1 - math.floor(math.log10(self.half_width)))


def covariance_of(information: Array) -> Array | None:
    """The inverse of an information matrix, shape (n, n); None if it is singular.

    It is symmetric and positive also where the matrix is nearly singular.
    """
    scale = np.sqrt(np.diag(information))
    if not (scale > 0.0).all():
        return None
    values, directions = np.linalg.eigh(information / np.outer(scale, scale))
    if not values[0] * _MOST_APART > values[-1]:
        return None
    root = directions / np.sqrt(values) / scale[:, None]
    return np.asarray(root @ root.T)


# Jackknife: leaving out parts of the data shows scatter that the noise model misses.


def jackknife(without: Array) -> Array:
    """Covariance from the changes of n numbers when each of p parts is left out, shape (n, n).

    Args:
        without: Estimates without each part, shape (p, n).

    Source: Efron & Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 11.
    """
    spread, count = without - without.mean(axis=0), len(without)
    return np.asarray((count - 1) / count * spread.T @ spread)


def widened(covariance: Array, without: Array) -> Array:
    """A covariance scaled up to the jackknife's, averaged over all directions.

    It is unchanged where the excess of the jackknife's is within chance: two standard deviations
    of a mean of that many squares. In that average, directions that few parts determine count too
    much: half of the parts' mean leverage, numbers by parts, is taken off. With four images of nine
    numbers the average is eight times too large, in simulations.

    Args:
        covariance: From the residuals' scatter, shape (n, n).
        without: As in `jackknife`.
    """
    count, size = without.shape
    ratio = float(np.trace(np.linalg.solve(covariance, jackknife(without)))) / size
    ratio *= max(1.0 - size / (2.0 * count), 0.125)
    by_chance = 2.0 * float(np.sqrt(2.0 / (size * (count - 1))))
    return np.asarray(covariance * (ratio if ratio > 1.0 + by_chance else 1.0))


# Chance bound on the RMS of several quantities, which differs from that of each alone.


def rms_bound(covariance: Array, slopes: Array) -> float:
    """95 % bound on the RMS of quantities that depend linearly on normal errors.

    The sum of squares is approximated by a scaled chi-squared variable of equal mean and variance.
    For one quantity the bound is 1.96 deviations; for many independent ones little above their RMS.

    Args:
        covariance: Of the n errors, shape (n, n).
        slopes: Derivatives of k quantities by them, shape (k, n).

    Source: Satterthwaite, Biometrics Bulletin 2(6), 1946.
    """
    spread = covariance @ (slopes.T @ slopes) / len(slopes)
    mean, square = float(np.trace(spread)), float(np.trace(spread @ spread))
    if not 0.0 < square < np.inf:
        return max(mean, 0.0)  # known exactly, or unknown
    return float(np.sqrt(square / mean * chi_squared_bound(mean**2 / square)))


# Huber's loss: outliers count linearly, not quadratically.


def huber(distances: Array, bend: float) -> Array:
    """Huber's loss of non-negative distances: quadratic up to ``bend``."""
    cost: Array = np.where(distances <= bend, distances**2, 2.0 * bend * distances - bend**2)
    return cost


def huber_weight(distances: Array, bend: float) -> Array:
    """The IRLS weight of Huber's loss, for the square of each distance."""
    share: Array = bend / np.maximum(distances, bend)
    return share


# Evenly spaced samples from a stream of unknown length.


T = TypeVar("T")


class EvenSample(Generic[T]):
    """Keeps up to twice the wanted number of items, evenly spaced."""

    def __init__(self, wanted: int) -> None:
        """Starts empty.

        Args:
            wanted: Maximum number of items to choose.
        """
        self._wanted, self._every, self._count = wanted, 1, 0
        self._kept: list[T] = []

    def add(self, item: T) -> None:
        """Adds the next item."""
        if self._count % self._every == 0:
            self._kept.append(item)
        self._count += 1
        if len(self._kept) == 2 * self._wanted:
            self._kept, self._every = self._kept[::2], 2 * self._every

    def chosen(self) -> list[T]:
        """At most the wanted number of items, in order."""
        last, wanted = len(self._kept) - 1, min(self._wanted, len(self._kept))
        indices = [round(k * last / max(wanted - 1, 1)) for k in range(wanted)]
        return [self._kept[index] for index in indices]


# Duplicate views: copies of an image, or images of a scene at rest.
#
# Their errors are correlated, so a duplicate adds no information. Saving a copy again as JPEG moves
# its corners about as much as noise does, so one limit finds both.


SAME_VIEW = 0.1
"""Two images whose corners differ by less than this, RMS, show the same view, [px]."""


def is_duplicate_view(corners: Array, before: Array) -> bool:
    """Whether corners have not moved between two images, shape (..., 2) both, [px]."""
    return bool(np.mean(np.sum((corners - before) ** 2, axis=-1)) < SAME_VIEW**2)


def duplicate_reason(first: str) -> str:
    """Why an image that shows the same view as image ``first`` is not used."""
    return f"duplicates {first}: nothing moved in between"


def duplicate_views(views: Mapping[str, Mapping[T, Array]]) -> dict[str, str]:
    """Why views count as duplicates, by image name: of a view of as many points or more.

    Only points that both show are compared: copies may differ by a few.

    Args:
        views: Pixels, shape (..., 2), by the point or tag that they show, by image name.
    """
    kept: dict[str, Mapping[T, Array]] = {}
    reasons = {}
    for name, own in sorted(views.items(), key=lambda view: -len(view[1])):
        first = next((n for n, before in kept.items() if has_not_moved(own, before)), None)
        if first is None:
            kept[name] = own
        else:
            reasons[name] = duplicate_reason(first)
    return reasons


def has_not_moved(own: Mapping[T, Array], before: Mapping[T, Array]) -> bool:
    """Whether the points or tags that two views both show did not move; False without any."""
    both = own.keys() & before.keys()
    if not both:
        return False
    corners, earlier = (np.array([one[k] for k in both]) for one in (own, before))
    return is_duplicate_view(corners, earlier)
