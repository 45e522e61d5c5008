"""A number and how far off it may be."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

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


# Huber's loss: what is far off counts by its distance, not by its square.


def huber(distances: Array, bend: float) -> Array:
    """The loss of distances, which are not negative; their square up to ``bend``."""
    cost: Array = np.where(distances <= bend, distances**2, 2.0 * bend * distances - bend**2)
    return cost


def share_of(distances: Array, bend: float) -> Array:
    """The weight that makes a square of what counts less."""
    share: Array = bend / np.maximum(distances, bend)
    return share
