"""Huber's loss: what is far off counts by its distance, not by its square."""

from __future__ import annotations

import numpy as np

from cdpr.poses import Array


def huber(distances: Array, bend: float) -> Array:
    """The loss of distances, which are not negative; their square up to ``bend``."""
    cost: Array = np.where(distances <= bend, distances**2, 2.0 * bend * distances - bend**2)
    return cost


def share_of(distances: Array, bend: float) -> Array:
    """The weight that makes a square of what counts less."""
    share: Array = bend / np.maximum(distances, bend)
    return share
