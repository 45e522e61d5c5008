"""Wrench feasibility proved, not sampled, over boxes and along edges of pure translation.

A region is proved by tensions that follow the displacement from its middle
(`planner.wrench.feasibility_proof`).

Where this does not decide, the margin in the middle of a line may prove it: a displacement lowers
the margin by at most the largest tensions times the changes of the columns. A margin below the
reserve there refutes the line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.collision.self_collision_regions import OPEN, PROVED, REFUTED
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, along, minus, norm
from planner.kernels.scene_arrays import World
from planner.wrench.capacity import LoadArrays, margin_at
from planner.wrench.feasibility_proof import column_changes, tensions_prove

Array = NDArray[np.float64]

_CELLS = 16
_MOST_HALVINGS = 6
_MOST_PIECES = 1024
_DEEPEST = 64
_FINEST = 1e-6


class Holding(NamedTuple):
    """Where the cables are proved to hold the required wrenches with a reserve.

    Attributes:
        reserve: Smallest margin required, [N].
        cells: Whether each cell of the workspace box is proved, shape (16, 16, 16).
        everywhere: Whether all of them are.
    """

    reserve: float
    cells: NDArray[np.bool_]
    everywhere: bool


@kernel
def build_holding(world: World, load: LoadArrays, reserve: float) -> Holding:
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
                cells[i, j, k] = box_held(world, load, reserve, box)
                everywhere = everywhere and cells[i, j, k]
    return Holding(reserve, cells, everywhere)


@kernel
def edge_held(world: World, load: LoadArrays, holding: Holding, start: Array, end: Array) -> bool:
    """Whether the required wrenches are held all along a translation, with the reserve.

    Never True where that is violated. Both ends must lie in the workspace box.
    """
    if holding.everywhere or _in_proved_cells(world, holding, start, end):
        return True
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    delta = minus(after, before)
    length = norm(delta)
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
        off = (half * delta[0], half * delta[1], half * delta[2])
        at = along(before, delta, middle)
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
def line_held(
    world: World, load: LoadArrays, reserve: float, middle: Vector, off: Vector, radius: float
) -> int:
    """Whether wrenches are held from ``middle - off`` to ``middle + off``, [m].

    Args:
        reserve: Smallest margin required, [N].
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
    if not column_changes(world, load, middle, radius, changes, weights):
        return OPEN
    for i in range(count):
        margin -= load.high * weights[i] * changes[i]
    return PROVED if margin >= reserve else OPEN


@kernel
def _in_proved_cells(world: World, holding: Holding, start: Array, end: Array) -> bool:
    """Whether all cells that the bounding box of an edge touches are proved."""
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
def box_held(world: World, load: LoadArrays, reserve: float, whole: Array) -> bool:
    """Whether a box, lower and upper corner in shape (6,), is proved by bisection."""
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
