"""What a planner hands over: a path, the path it was made from, and how it was found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array

Progress = Callable[[float, float, float], None]
"""Told by a search: what is done, the most there will be, and how near or how good it has come."""


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
