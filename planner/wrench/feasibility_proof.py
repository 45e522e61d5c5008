"""Wrench feasibility proved over a region by tensions that follow the displacement.

In the middle of a region take tensions t that give the wrench, well inside their limits. At a
displacement d the tensions t + T d + A⁺ v, with T the exact slope that keeps the wrench to first
order, give the wrench plus any v up to a residual. Further tensions, at most the residual's norm
over the smallest singular value of the structure matrix there, cancel it (only their existence
matters). The residual is bounded: a unit vector along a cable of length l changes by at most d / l'
and deviates from its tangent by at most d² / (√3 l'²), with l' = l - d the shortest length. Where
every tension stays inside its limits, the wrench box grown by the reserve is held all over the
region. With pulleys, whose second derivatives are not bounded here, T is omitted.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, along, dot, minus, norm, plus, rotated, row
from planner.kernels.scene_arrays import World, anchor, exit_point, feed, outlet
from planner.wrench.capacity import LoadArrays, factored, structure_columns

Array = NDArray[np.float64]

_ROUNDS = 12
_WANTED_SHARE = 0.2
"""Distance that the proof's tensions keep from their limits where possible, as part of their range:
it decides how large a region a proof covers, never whether it is correct."""


@kernel
def tensions_prove(
    world: World,
    load: LoadArrays,
    reserve: float,
    middle: Vector,
    spans: Array,
    radius: float,
) -> bool:
    """Whether tensions that follow the displacement prove a region; see the module's docstring.

    Args:
        reserve: Smallest margin required, [N].
        middle: Of the region, [m].
        spans: The region is the middle and shares from -1 to 1 of each row, shape (k, 3), [m].
        radius: Largest distance of the region's points from its middle, [m].
    """
    count = len(world.cables)
    columns, inverse = np.empty((count, 6)), np.empty((count, 6))
    basis = np.empty((count, count))
    structure_columns(world, world.platform[:3], middle, load.length, columns)
    if factored(columns, inverse, basis) == 0.0:
        return False
    changes, weights = np.empty(count), np.empty(count)
    if not column_changes(world, load, middle, radius, changes, weights):
        return False
    tensions = inner_tensions(load, columns, inverse)
    slopes = np.zeros((count, 3))
    if world.pulley == 0.0:
        _slopes(world, load, middle, columns, inverse, tensions, slopes)
    travels, bends = np.zeros(count), np.empty(count)
    for i in range(count):
        for k in range(len(spans)):
            travels[i] += abs(dot(row(slopes, i), row(spans, k)))
        bends[i] = weights[i] * changes[i]
        if world.pulley == 0.0:
            bends[i] *= changes[i] / math.sqrt(3.0)
        changes[i] *= weights[i]
    residual = missing_wrench(load, columns, tensions)
    return tensions_stay(load, reserve, inverse, tensions, travels, changes, bends, residual)


@kernel
def column_changes(
    world: World, load: LoadArrays, middle: Vector, radius: float, changes: Array, weights: Array
) -> bool:
    """Bounds of the change of each cable's unit vector over a region; False if one has none.

    Also the norms of the maps from unit vectors to columns of the structure matrix.
    """
    for cable in range(len(world.cables)):
        arm = rotated(world.platform[:3], anchor(world, cable))
        reach, free = levers(world, cable, plus(middle, arm), radius)
        if not (reach > 0.0 and free > 0.0):
            return False
        changes[cable] = radius / min(reach, free)
        weights[cable] = math.sqrt(1.0 + dot(arm, arm) / (load.length * load.length))
    return True


@kernel
def levers(world: World, cable: int, at: Vector, radius: float) -> tuple[float, float]:
    """Least distance of an anchor from its swivel axis and least free length, [m].

    A cable's unit vector rotates by at most its anchor's motion over the smaller of the two.
    Without a pulley both are the free length; where there is no bound, 0 or less.

    Args:
        at: Its anchor in the middle, world frame, [m].
        radius: Largest distance of the anchor from there, [m].
    """
    if world.pulley == 0.0:
        free = norm(minus(exit_point(world, cable, at), at)) - radius
        return free, free
    offset, axis = minus(at, outlet(world, cable)), feed(world, cable)
    reach = norm(along(offset, axis, -dot(offset, axis))) - radius
    # The exit moves too, so the free length is bounded by the distance from anchor to outlet.
    from_centre = norm(offset) - world.pulley - radius
    if not (reach > 0.0 and from_centre > world.pulley):
        return 0.0, 0.0
    return reach, math.sqrt(from_centre * from_centre - world.pulley * world.pulley)


@kernel
def tensions_stay(
    load: LoadArrays,
    reserve: float,
    inverse: Array,
    tensions: Array,
    travels: Array,
    changes: Array,
    bends: Array,
    residual: float,
) -> bool:
    """Whether tensions that leave a small residual wrench can be corrected within their limits.

    Args:
        reserve: Smallest margin required, [N].
        inverse: Pseudo-inverse in the middle of a region, shape (m, 6).
        tensions: There, shape (m,), [N].
        travels: Largest change of each that keeps the wrench to first order, shape (m,), [N].
        changes: Largest change of each column over the region, shape (m,).
        bends: Bound of each column's change that ``travels`` leaves out, shape (m,).
        residual: Other residual wrench, [N].
    """
    count, squared, norm_squared = len(tensions), 0.0, 0.0
    follows = np.empty(count)
    for i in range(count):
        spread, row_squared = 0.0, 0.0
        for k in range(6):
            spread += abs(inverse[i, k]) * load.spread[k]
            row_squared += inverse[i, k] * inverse[i, k]
        norm_squared += row_squared
        follows[i] = travels[i] + spread + reserve * math.sqrt(row_squared)
        residual += abs(tensions[i]) * bends[i] + follows[i] * changes[i]
        squared += changes[i] * changes[i]
    # ‖A⁺‖ ≤ its Frobenius norm, so the smallest singular value of A is at least one over that.
    weakest = 1.0 / math.sqrt(norm_squared) - math.sqrt(squared)
    if not weakest > 0.0:
        return False
    correction = residual / weakest
    for i in range(count):
        room = min(tensions[i] - load.low, load.high - tensions[i])
        if not room >= follows[i] + correction:
            return False
    return True


@kernel
def missing_wrench(load: LoadArrays, columns: Array, tensions: Array) -> float:
    """Residual of the wrench given by the tensions, [N]; round-off, but accounted for."""
    squared = 0.0
    for k in range(6):
        part = load.wrench[k]
        for i in range(len(columns)):
            part -= columns[i, k] * tensions[i]
        squared += part * part
    return math.sqrt(squared)


@kernel
def inner_tensions(load: LoadArrays, columns: Array, inverse: Array) -> Array:
    """Tensions that give the wrench, moved off the limits by alternating projections."""
    count = len(columns)
    margin = _WANTED_SHARE * (load.high - load.low)
    tensions = np.full(count, (load.low + load.high) / 2.0)
    missing = np.empty(6)
    for turn in range(_ROUNDS):
        inside = turn > 0
        for i in range(count):
            wanted = min(max(tensions[i], load.low + margin), load.high - margin)
            inside = inside and wanted == tensions[i]
            tensions[i] = wanted
        if inside:
            break
        for k in range(6):
            missing[k] = load.wrench[k]
            for i in range(count):
                missing[k] -= columns[i, k] * tensions[i]
        for i in range(count):
            for k in range(6):
                tensions[i] += inverse[i, k] * missing[k]
    return tensions


@kernel
def _slopes(
    world: World,
    load: LoadArrays,
    middle: Vector,
    columns: Array,
    inverse: Array,
    tensions: Array,
    slopes: Array,
) -> None:
    """Writes T, the slope of tensions by displacement that keeps the wrench, shape (m, 3)."""
    change = np.zeros((6, 3))  # of the wrench with the displacement, tensions held
    for cable in range(len(columns)):
        arm = rotated(world.platform[:3], anchor(world, cable))
        length = norm(minus(minus(outlet(world, cable), middle), arm))
        share = tensions[cable] / length
        unit = (columns[cable, 0], columns[cable, 1], columns[cable, 2])
        for k in range(3):
            # The unit vector changes by -(I - u uᵀ) d / l.
            bent = (
                share * (unit[0] * unit[k] - (1.0 if k == 0 else 0.0)),
                share * (unit[1] * unit[k] - (1.0 if k == 1 else 0.0)),
                share * (unit[2] * unit[k] - (1.0 if k == 2 else 0.0)),
            )
            change[0, k] += bent[0]
            change[1, k] += bent[1]
            change[2, k] += bent[2]
            change[3, k] += (arm[1] * bent[2] - arm[2] * bent[1]) / load.length
            change[4, k] += (arm[2] * bent[0] - arm[0] * bent[2]) / load.length
            change[5, k] += (arm[0] * bent[1] - arm[1] * bent[0]) / load.length
    for i in range(len(columns)):
        for k in range(3):
            value = 0.0
            for j in range(6):
                value -= inverse[i, j] * change[j, k]
            slopes[i, k] = value
