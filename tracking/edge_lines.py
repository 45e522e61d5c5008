"""Straight lines of edges, and where they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Lines of edges in ideal pixels, four a tag."""

    points: Array  # (e, 2) on the lines
    directions: Array  # (e, 2) unit
    offset_deviation: Array  # (e,) [px] at ``points``
    tilt_deviation: Array  # (e,) [rad]
    good: NDArray[np.bool_]  # (e,)


def meet(lines: Lines, rough: Array) -> Array:
    """Corners where neighbouring good lines meet, else the rough ones; shape (t, 4, 2)."""
    points, directions = lines.points.reshape(-1, 4, 2), lines.directions.reshape(-1, 4, 2)
    before_point, before = np.roll(points, 1, axis=1), np.roll(directions, 1, axis=1)
    cross = directions[..., 0] * before[..., 1] - directions[..., 1] * before[..., 0]
    good = lines.good.reshape(-1, 4)
    good = good & np.roll(good, 1, axis=1) & (np.abs(cross) > 1e-3)
    gap = before_point - points
    share = gap[..., 0] * before[..., 1] - gap[..., 1] * before[..., 0]
    share /= np.where(good, cross, 1.0)
    return np.where(good[..., None], points + share[..., None] * directions, rough)
