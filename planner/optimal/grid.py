"""Trilinear interpolation on a regular lattice, compiled; `planner.lattice` is its definition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import leaf
from planner.exact.vectors import Vector

Array = NDArray[np.float64]


@leaf
def interpolated(grid: Array, values: Array, point: Vector) -> float:
    """The value at a point; outside the lattice that of the nearest point on its border.

    Args:
        grid: Lower corner and spacing, shape (2, 3), [m].
        values: At the lattice's points, shape (i, j, k), each at least 2.
        point: World frame, [m].
    """
    x, i = _cell(point[0], grid[0, 0], grid[1, 0], values.shape[0])
    y, j = _cell(point[1], grid[0, 1], grid[1, 1], values.shape[1])
    z, k = _cell(point[2], grid[0, 2], grid[1, 2], values.shape[2])
    low = values[i, j, k] * (1.0 - z) + values[i, j, k + 1] * z
    high = values[i, j + 1, k] * (1.0 - z) + values[i, j + 1, k + 1] * z
    front = low * (1.0 - y) + high * y
    low = values[i + 1, j, k] * (1.0 - z) + values[i + 1, j, k + 1] * z
    high = values[i + 1, j + 1, k] * (1.0 - z) + values[i + 1, j + 1, k + 1] * z
    return front * (1.0 - x) + (low * (1.0 - y) + high * y) * x  # type: ignore[no-any-return]


@leaf
def _cell(value: float, lower: float, spacing: float, count: int) -> tuple[float, int]:
    """Place within a cell, 0 … 1, and the number of the cell, along one axis."""
    scaled = (value - lower) / spacing
    scaled = min(max(scaled, 0.0), count - 1.0)
    cell = min(int(scaled), count - 2)
    return scaled - cell, cell
