"""Where profiles of brightness across an edge step from dark to bright."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.poses import Array

#: Taps along a profile, and further ones beyond each end for the levels of ink and paper.
TAPS = 17
LEVEL_TAPS = 4
#: Smallest step of brightness that counts as an edge, [grey levels].
LEAST_CONTRAST = 5.0
#: How much of the scatter of ink and paper the points of an edge have in common; the rest is in
#: their own scatter.
LEVEL_SHARE = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Where profiles step from dark to bright."""

    offset: Array  # (e, n) outward positive, [px]
    good: Array  # (e, n) 1 where there is one step and no more, else 0
    blur: Array  # (e,) width over which brightness rises, [px]
    level_scatter: Array  # (e,) what scatter of ink and paper does to an offset, [px]


#: Finds the steps in profiles: values, places, across, half.
StepFinder = Callable[[Array, Array, Array, Array], Steps]


def steepest(values: Array, places: Array, across: Array, half: Array) -> Steps:
    """Where each profile rises most, to a few tenths of a pixel; as `step_positions`.

    White modules inside the border and cables in the white around it do not move it, as they move
    the area of a profile that starts pixels away from the edge.
    """
    inner = slice(LEVEL_TAPS, -LEVEL_TAPS)
    values, across = values[..., inner], across[..., inner]
    rise = values[..., 2:] - values[..., :-2]
    peak = np.argmax(rise, axis=-1)
    slope = np.take_along_axis(rise, peak[..., None], axis=-1)[..., 0]
    usual = np.median(slope, axis=1)
    offset = np.take_along_axis(across[:, :, 1:-1], peak[..., None], axis=-1)[..., 0]
    good = (slope > 0.4 * usual[:, None]) & (slope > 0.25 * LEAST_CONTRAST)
    contrast = np.median(values.max(axis=-1) - values.min(axis=-1), axis=1)
    blur = contrast / np.maximum(usual, 1.0) * (4.0 * half / TAPS)
    return Steps(np.where(good, offset, 0.0), good.astype(np.float64), blur, np.zeros(len(half)))


def step_positions(values: Array, places: Array, across: Array, half: Array) -> Steps:
    """Where each profile steps from dark to bright.

    Args:
        values: Brightness at the taps, shape (e, n, k).
        places: Of the profiles along their edge, shape (e, n), [px].
        across: Of the taps, outward positive, shape (e, n, k), [px].
        half: Half length of the profiles, shape (e,), [px].
    """
    ends, inner = LEVEL_TAPS + 2, slice(LEVEL_TAPS, -LEVEL_TAPS)
    dark_end, bright_end = values[..., :ends].mean(axis=-1), values[..., -ends:].mean(axis=-1)
    values, across = values[..., inner], across[..., inner]
    usual = np.quantile(dark_end, 0.4, axis=1), np.quantile(bright_end, 0.7, axis=1)
    near = np.maximum(0.12 * (usual[1] - usual[0]), 6.0)
    dark, dark_scatter = _level(dark_end, places, usual[0], near)
    bright, bright_scatter = _level(bright_end, places, usual[1], near)
    contrast = bright - dark
    enough = contrast > LEAST_CONTRAST
    share = (values - dark[..., None]) / np.where(enough, contrast, 1.0)[..., None]
    offset = half[:, None] * (1.0 - 2.0 * share.mean(axis=-1)) + across.mean(axis=-1)
    good = enough & (np.abs(offset) < 0.8 * half[:, None])
    good &= _is_one_step(share, across - offset[..., None], half)
    # The area moves by half a profile for a whole contrast of error in either level.
    level = (
        LEVEL_SHARE
        * half
        / np.maximum(usual[1] - usual[0], 1.0)
        * np.hypot(dark_scatter, bright_scatter)
    )
    return Steps(np.where(good, offset, 0.0), good.astype(np.float64), np.zeros(len(half)), level)


def _is_one_step(share: Array, across: Array, half: Array) -> NDArray[np.bool_]:
    """Whether profiles are dark before and bright behind their step: no cable lies there."""
    clear = np.maximum(1.2, 0.4 * half)[:, None, None]
    noise = 1.4826 * np.median(np.abs(share[..., 0] - share[..., 1]), axis=1) / np.sqrt(2.0)
    tolerance = np.maximum(0.2, 5.0 * noise)[:, None, None]
    wrong = np.where(across > clear, np.abs(share - 1.0) > tolerance, False)
    wrong |= np.where(across < -clear, np.abs(share) > tolerance, False)
    return np.asarray(~wrong.any(axis=-1))


def _level(brightness: Array, places: Array, usual: Array, near: Array) -> tuple[Array, Array]:
    """Brightness beside an edge as a straight function of place, blind to what crosses it.

    Returns:
        The function at ``places``, shape (e, n), and the scatter about it, RMS, shape (e,).
    """
    weight = (np.abs(brightness - usual[:, None]) < near[:, None]).astype(np.float64)
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    x = places - (weight * places).sum(axis=1, keepdims=True) / total
    mean = (weight * brightness).sum(axis=1, keepdims=True) / total
    square = np.maximum((weight * x * x).sum(axis=1, keepdims=True), 1e-9)
    slope = (weight * x * (brightness - mean)).sum(axis=1, keepdims=True) / square
    line = mean + slope * x
    scatter = np.sqrt((weight * (brightness - line) ** 2).sum(axis=1) / total[:, 0])
    return np.asarray(line), np.asarray(scatter)
