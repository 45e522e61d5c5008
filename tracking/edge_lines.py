"""Robust straight lines through the points of edges, and where they meet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array
from tracking.edge_steps import Steps

#: An edge is used only if this share of its profiles lies on its line.
LEAST_SHARE = 0.4
#: Points that scatter more than this about their line are not those of an edge, [px].
MOST_NOISE = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Lines of edges in ideal pixels, four a tag."""

    points: Array  # (e, 2) on the lines
    directions: Array  # (e, 2) unit
    offset_deviation: Array  # (e,) [px] at ``points``
    tilt_deviation: Array  # (e,) [rad]
    noise: Array  # (e,) [px]
    good: NDArray[np.bool_]  # (e,)
    blur: Array  # (e,) width over which brightness rises, [px]


def fit_lines(points: Array, steps: Steps, span: Array) -> Lines:
    """Robust lines through points, shape (e, n, 2), of weight 0 or 1, spanning ``span`` [px]."""
    weight = steps.good
    chord = points[:, -1] - points[:, 0]
    chord /= np.maximum(np.linalg.norm(chord, axis=1, keepdims=True), 1e-9)
    normal = np.stack([chord[:, 1], -chord[:, 0]], axis=1)
    origin = points.mean(axis=1)
    relative = points - origin[:, None, :]
    t = np.einsum("enk,ek->en", relative, chord)
    r = np.einsum("enk,ek->en", relative, normal)
    robust = weight
    for _ in range(5):
        total = np.maximum(robust.sum(axis=1), 1e-9)
        middle = (robust * t).sum(axis=1) / total
        centred = t - middle[:, None]
        square = np.maximum((robust * centred**2).sum(axis=1), 1e-9)
        height = (robust * r).sum(axis=1) / total
        slope = (robust * centred * r).sum(axis=1) / square
        error = r - height[:, None] - slope[:, None] * centred
        size = np.where(weight > 0, np.abs(error), np.nan)
        scale = 1.4826 * _median(size) + 0.005
        robust = weight * np.maximum(1.0 - (error / (4.0 * scale[:, None])) ** 2, 0.0) ** 2
    inlier = robust > 0.1
    count = inlier.sum(axis=1)
    noise = np.sqrt((inlier * error**2).sum(axis=1) / np.maximum(count - 2, 1))
    # Profiles closer together than a pixel and a half read the same pixels.
    independent = np.maximum(np.minimum(count, count / points.shape[1] * span / 1.5), 3.0)
    deviation = np.hypot(noise, steps.level_scatter) / np.sqrt(independent)
    arm = np.sqrt(square / total)
    direction = chord + slope[:, None] * normal
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Lines(
        points=origin + middle[:, None] * chord + height[:, None] * normal,
        directions=direction,
        offset_deviation=deviation,
        tilt_deviation=deviation / np.maximum(arm, 1e-6),
        noise=noise,
        good=(count >= LEAST_SHARE * points.shape[1]) & (noise < MOST_NOISE),
        blur=steps.blur,
    )


def doubted(lines: Lines, floor: Array) -> Lines:
    """Lines that are off by ``floor``, shape (e,), [px], beside what their points scatter."""
    more = np.hypot(lines.offset_deviation, floor) / np.maximum(lines.offset_deviation, 1e-9)
    return replace(
        lines,
        offset_deviation=lines.offset_deviation * more,
        tilt_deviation=lines.tilt_deviation * more,
    )


def _median(values: Array) -> Array:
    """Median of each row without its NaNs; large for a row of nothing else."""
    filled = np.sort(np.where(np.isnan(values), np.inf, values), axis=1)
    count = np.sum(np.isfinite(filled), axis=1)
    rows = np.arange(len(values))
    return np.where(count > 0, filled[rows, np.maximum(count - 1, 0) // 2], 1e3)


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
