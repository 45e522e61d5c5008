"""Wrench feasibility proved over boxes and along edges of pure translation, not sampled.

In the middle of a region take tensions t that give the wrench, well inside their limits. At a
displacement d the tensions t + T d + A⁺ v, with T the exact slope that keeps the wrench to first
order, give the wrench and any v about it but for a residual; tensions of at most its norm over the
smallest singular value of the structure matrix there take that away (no more is needed of them
than that they exist). The residual is bounded: a unit vector along a cable of length l changes by
at most d / l' and leaves its tangent by at most d² / (√3 l'²), with l' = l - d the shortest length.
Where every tension stays inside its limits, the wrench box grown by the reserve is held all over
the region. Over pulleys, whose second derivatives are not bounded here, T is left out.

Where this does not decide, a line may still be proved by the margin in its middle, which no
displacement lowers by more than the largest tensions times the changes of the columns; a margin
below the reserve there refutes it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.capacity import Load, margin_at
from planner.exact.compiled import kernel
from planner.exact.exits import exit_point
from planner.exact.fields import World, anchor, feed, outlet
from planner.exact.self_region import OPEN, PROVED, REFUTED
from planner.exact.structure import factored, structure_columns
from planner.exact.vectors import Vector, along, dot, minus, norm, plus, row, turned

Array = NDArray[np.float64]

_CELLS = 16
_MOST_HALVINGS = 6
_MOST_PIECES = 1024
_DEEPEST = 64
_FINEST = 1e-6
_ROUNDS = 12
_WANTED_SHARE = 0.2
"""Where the tensions of the proof keep away from their limits, as part of their range, if they
can: a choice that makes proofs larger or smaller, never wrong."""


class Holding(NamedTuple):
    """Where the cables are proved to hold what they must with a reserve.

    Attributes:
        reserve: Smallest margin wanted, [N].
        cells: Whether each cell of the workspace box is proved, shape (16, 16, 16).
        everywhere: Whether all of them are.
    """

    reserve: float
    cells: NDArray[np.bool_]
    everywhere: bool


@kernel
def build_holding(world: World, load: Load, reserve: float) -> Holding:
    """Proves the workspace box cell by cell at the world's orientation."""
    cells = np.zeros((_CELLS, _CELLS, _CELLS), dtype=np.bool_)
    size = (world.limits[1] - world.limits[0]) / _CELLS
    box = np.empty(6)
    everywhere = True
    for i in range(_CELLS):
        for j in range(_CELLS):
            for k in range(_CELLS):
                for axis, number in enumerate((i, j, k)):
                    box[axis] = world.limits[0, axis] + number * size[axis]
                    box[axis + 3] = world.limits[0, axis] + (number + 1) * size[axis]
                cells[i, j, k] = _box_held(world, load, reserve, box)
                everywhere = everywhere and cells[i, j, k]
    return Holding(reserve, cells, everywhere)


@kernel
def edge_held(world: World, load: Load, holding: Holding, start: Array, end: Array) -> bool:
    """Whether the cables hold what they must all along a translation, the reserve on top.

    Never yes where that is untrue. Both ends must lie in the workspace box.
    """
    if holding.everywhere or _in_proved_cells(world, holding, start, end):
        return True
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    way = minus(after, before)
    length = norm(way)
    if not math.isfinite(length):
        return False
    lows, highs = np.empty(_DEEPEST), np.empty(_DEEPEST)
    lows[0], highs[0] = 0.0, 1.0
    waiting, tried = 1, 0
    while waiting > 0:
        waiting -= 1
        tried += 1
        low, high = lows[waiting], highs[waiting]
        half = (high - low) / 2.0
        middle = low + half
        off = (half * way[0], half * way[1], half * way[2])
        at = along(before, way, middle)
        found = line_held(world, load, holding.reserve, at, off, half * length)
        if found == PROVED:
            continue
        if found == REFUTED or tried >= _MOST_PIECES or waiting + 2 > _DEEPEST:
            return False
        if half * length < _FINEST:
            return False
        lows[waiting], highs[waiting] = middle, high
        lows[waiting + 1], highs[waiting + 1] = low, middle
        waiting += 2
    return True


@kernel
def edges_held(
    world: World, load: Load, holding: Holding, starts: Array, ends: Array
) -> NDArray[np.bool_]:
    """`edge_held` for many edges, shape (k, 3) each, [m]; shape (k,)."""
    held = np.empty(len(starts), dtype=np.bool_)
    for i in range(len(starts)):
        held[i] = edge_held(world, load, holding, starts[i], ends[i])
    return held


@kernel
def line_held(
    world: World, load: Load, reserve: float, middle: Vector, off: Vector, radius: float
) -> int:
    """Whether wrenches are held from ``middle - off`` to ``middle + off``, [m].

    Args:
        world: Where.
        load: What must be held.
        reserve: Smallest margin wanted, [N].
        middle: Of the line, [m].
        off: From the middle to its end, [m].
        radius: The length of ``off``, [m].

    Returns:
        `PROVED`, `REFUTED` or `OPEN`.
    """
    spans = np.empty((1, 3))
    spans[0] = off
    if tensions_prove(world, load, reserve, middle, spans, radius):
        return PROVED
    margin = margin_at(world, load, world.platform[:3], middle)
    if not margin >= reserve:
        return REFUTED
    count = len(world.cables)
    changes, weights = np.empty(count), np.empty(count)
    if not _changes(world, load, middle, radius, changes, weights):
        return OPEN
    for i in range(count):
        margin -= load.high * weights[i] * changes[i]
    return PROVED if margin >= reserve else OPEN


@kernel
def tensions_prove(
    world: World,
    load: Load,
    reserve: float,
    middle: Vector,
    spans: Array,
    radius: float,
) -> bool:
    """Whether tensions that follow the displacement prove a region; see the module's text.

    Args:
        world: Where.
        load: What must be held.
        reserve: Smallest margin wanted, [N].
        middle: Of the region, [m].
        spans: The region is the middle and shares from -1 to 1 of each row, shape (k, 3), [m].
        radius: No point of the region is farther from its middle, [m].
    """
    count = len(world.cables)
    columns, inverse = np.empty((count, 6)), np.empty((count, 6))
    null_space = np.empty((count, count - 6))
    structure_columns(world, world.platform[:3], middle, load.length, columns)
    if factored(columns, inverse, null_space) == 0.0:
        return False
    changes, weights = np.empty(count), np.empty(count)
    if not _changes(world, load, middle, radius, changes, weights):
        return False
    return _tensions_hold(world, load, reserve, spans, columns, inverse, changes, weights, middle)


@kernel
def _changes(
    world: World, load: Load, middle: Vector, radius: float, changes: Array, weights: Array
) -> bool:
    """Bounds of how far each cable's unit vector changes over a region; False if one has none.

    Also the norms of the maps from unit vectors to columns of the structure matrix.
    """
    for cable in range(len(world.cables)):
        arm = turned(world.platform[:3], anchor(world, cable))
        at = plus(middle, arm)
        shortest = norm(minus(exit_point(world, cable, at), at)) - radius
        if world.pulley > 0.0:
            offset, axis = minus(at, outlet(world, cable)), feed(world, cable)
            reach = norm(along(offset, axis, -dot(offset, axis))) - radius
            # The exit moves too; from the anchor to the pulley's outlet no length is shorter.
            from_centre = norm(offset) - world.pulley - radius
            if not (reach > 0.0 and from_centre > world.pulley):
                return False
            free = math.sqrt(from_centre * from_centre - world.pulley * world.pulley)
            shortest = min(reach, free)
        if not shortest > 0.0:
            return False
        changes[cable] = radius / shortest
        weights[cable] = math.sqrt(1.0 + dot(arm, arm) / (load.length * load.length))
    return True


@kernel
def _tensions_hold(
    world: World,
    load: Load,
    reserve: float,
    spans: Array,
    columns: Array,
    inverse: Array,
    changes: Array,
    weights: Array,
    middle: Vector,
) -> bool:
    count = len(columns)
    tensions = _inner_tensions(load, columns, inverse)
    slopes = np.zeros((count, 3))
    if world.pulley == 0.0:
        _slopes(world, load, middle, columns, inverse, tensions, slopes)
    follows, residual = np.empty(count), _missing(load, columns, tensions)
    squared, norm_squared = 0.0, 0.0
    for i in range(count):
        travel, spread, row_squared = 0.0, 0.0, 0.0
        for k in range(len(spans)):
            travel += abs(dot(row(slopes, i), row(spans, k)))
        for k in range(6):
            spread += abs(inverse[i, k]) * load.spread[k]
            row_squared += inverse[i, k] * inverse[i, k]
        norm_squared += row_squared
        follows[i] = travel + spread + reserve * math.sqrt(row_squared)
        if world.pulley == 0.0:
            bend = abs(tensions[i]) * changes[i] * changes[i] / math.sqrt(3.0)
            residual += weights[i] * (bend + follows[i] * changes[i])
        else:
            residual += weights[i] * (abs(tensions[i]) + follows[i]) * changes[i]
        squared += (weights[i] * changes[i]) ** 2
    # ‖A⁺‖ is at most its Frobenius norm; so the smallest singular value is at least one over it.
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
def _missing(load: Load, columns: Array, tensions: Array) -> float:
    """How far the tensions are from giving the wrench, [N]: round-off, but not left out."""
    squared = 0.0
    for k in range(6):
        part = load.wrench[k]
        for i in range(len(columns)):
            part -= columns[i, k] * tensions[i]
        squared += part * part
    return math.sqrt(squared)


@kernel
def _inner_tensions(load: Load, columns: Array, inverse: Array) -> Array:
    """Tensions that give the wrench, drawn away from the limits by projections in turn."""
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
    load: Load,
    middle: Vector,
    columns: Array,
    inverse: Array,
    tensions: Array,
    slopes: Array,
) -> None:
    """Writes T: how tensions follow a displacement so that the wrench stays, shape (m, 3)."""
    change = np.zeros((6, 3))  # of the wrench with the displacement, tensions held
    for cable in range(len(columns)):
        arm = turned(world.platform[:3], anchor(world, cable))
        length = norm(minus(minus(outlet(world, cable), middle), arm))
        share = tensions[cable] / length
        unit = (columns[cable, 0], columns[cable, 1], columns[cable, 2])
        for k in range(3):
            # The unit vector turns by -(I - u uᵀ) d / l.
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


@kernel
def _in_proved_cells(world: World, holding: Holding, start: Array, end: Array) -> bool:
    """Whether all cells that the box about an edge touches are proved."""
    first, last = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for axis in range(3):
        low, high = world.limits[0, axis], world.limits[1, axis]
        if not (math.isfinite(start[axis]) and math.isfinite(end[axis])):
            return False
        if min(start[axis], end[axis]) < low or max(start[axis], end[axis]) > high:
            return False
        per_cell = (high - low) / _CELLS
        begin = (min(start[axis], end[axis]) - low) / per_cell - 1e-9
        finish = (max(start[axis], end[axis]) - low) / per_cell + 1e-9
        first[axis] = max(math.floor(begin), 0)
        last[axis] = min(math.floor(finish), _CELLS - 1)
    for i in range(first[0], last[0] + 1):
        for j in range(first[1], last[1] + 1):
            for k in range(first[2], last[2] + 1):
                if not holding.cells[i, j, k]:
                    return False
    return True


@kernel
def _box_held(world: World, load: Load, reserve: float, whole: Array) -> bool:
    """Whether a box, lower and upper corner in shape (6,), is proved by halving it."""
    boxes, halvings = np.empty((_MOST_HALVINGS + 2, 6)), np.zeros(_MOST_HALVINGS + 2, np.int64)
    boxes[0], spans = whole, np.zeros((3, 3))
    waiting = 1
    while waiting > 0:
        waiting -= 1
        box, halved = boxes[waiting].copy(), halvings[waiting]
        off = ((box[3] - box[0]) / 2.0, (box[4] - box[1]) / 2.0, (box[5] - box[2]) / 2.0)
        at = (box[0] + off[0], box[1] + off[1], box[2] + off[2])
        for axis in range(3):
            spans[axis, axis] = off[axis]
        if tensions_prove(world, load, reserve, at, spans, norm(off)):
            continue
        if halved == _MOST_HALVINGS:
            return False
        longest = 0
        for axis in range(1, 3):
            if off[axis] > off[longest]:
                longest = axis
        boxes[waiting], boxes[waiting + 1] = box, box
        boxes[waiting, longest + 3], boxes[waiting + 1, longest] = at[longest], at[longest]
        halvings[waiting], halvings[waiting + 1] = halved + 1, halved + 1
        waiting += 2
    return True
