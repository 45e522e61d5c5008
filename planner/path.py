"""What a planner hands over: a path, the path it was made from, and how it was found."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.pose import Array

Progress = Callable[[float, float, float], None]
"""Reported by a search: work done, its limit, and how close or how good it is so far."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A path from start to goal that keeps every limit; coordinates of the space searched.

    Attributes:
        path: The finished path, shape (k, n).
        raw: The path before post-processing, shape (j, n).
        nodes: Of the search tree, shape (i, n); both paths' ends are among them.
        parents: Of each node, -1 for the root, shape (i,).
        iterations: How many samples were drawn.
        edge_checks: How many edges were asked about, post-processing included.
    """

    path: Array
    raw: Array
    nodes: Array
    parents: NDArray[np.int64]
    iterations: int
    edge_checks: int


# The best path that is no longer than asked: a price λ of length is raised until it holds.
#
# With the objective plus λ times the length, a higher λ gives a shorter path. After every few
# rounds λ is moved by halving towards the least that keeps the limit; the best path that did is
# kept.


LEAST_ROUNDS_WITH_LIMIT = 80
"""Done whatever the clock says: the price is found in steps of some rounds."""
_ROUNDS = 6
"""Between changes of λ."""
_MOST = 64.0
"""λ with which the length is practically all that counts, in units of the objective."""


class LengthLimit:
    """The search for λ, updated after every round.

    Attributes:
        price: λ, what a metre costs beside the objective.
        path: The best path found that is short enough, shape (k, n); None without one.
    """

    def __init__(self, longest: float, unit: float) -> None:
        """Begins without a price of length.

        Args:
            longest: Longest path allowed, [m].
            unit: What a metre of a usual path costs by the objective.
        """
        self.price = 0.0
        self.path: Array | None = None
        self._longest, self._unit = longest, unit
        self._low, self._high = 0.0, math.inf
        self._rounds = 0
        self._least = math.inf

    def after_round(self, path: Array, length: float, cost: Callable[[], float]) -> bool:
        """Looks at the best path at this price, and changes the price when it is time to.

        Args:
            path: Of the round before, shape (k, n).
            length: Its length, [m].
            cost: Computes its cost by the objective alone.

        Returns:
            Whether the price is another now.
        """
        short_enough = length <= self._longest
        if short_enough:
            self._keep(path, cost())
        self._rounds += 1
        return self._rounds % _ROUNDS == 0 and self._moved(short_enough)

    def _keep(self, path: Array, cost: float) -> None:
        if cost < self._least:
            self._least, self.path = cost, path

    def _moved(self, short_enough: bool) -> bool:
        if short_enough:
            self._high = self.price
        else:
            self._low = self.price
        if self._high == 0.0:
            return False  # the objective alone keeps the limit
        if self._high == math.inf:
            self.price = min(max(4.0 * self.price, 0.25 * self._unit), _MOST)
        else:
            self.price = (self._low + self._high) / 2.0
        return True
