"""Cells of the workspace box, each with a bit for each comparison that is still open in it.

What cannot be proved over the whole workspace at once most often can over nearly all of it. An edge
then asks only for what is open in the cells that it passes.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import leaf
from planner.exact.vectors import Vector

Array = NDArray[np.float64]
Masks = NDArray[np.uint64]

CELLS: Final = 32
"""Along each axis; a power of two."""
WORD: Final = 64
"""Comparisons in one word of a mask."""


def words_for(comparisons: int) -> int:
    """How many words hold a bit for each comparison."""
    return (comparisons + WORD - 1) // WORD


@leaf
def open_along(masks: Masks, limits: Array, start: Vector, end: Vector, word: int) -> np.uint64:
    """What is open in at least one of the cells that a straight way passes.

    A way along the border of cells passes one of them: a cell holds its border.

    Args:
        masks: Shape (CELLS, CELLS, CELLS, words).
        limits: Lower and upper corner of the workspace box, shape (2, 3), [m].
        start: In that box, [m].
        end: Likewise.
        word: Which word of the masks.
    """
    i, j, k = _cell(limits, start, 0), _cell(limits, start, 1), _cell(limits, start, 2)
    found = masks[i, j, k, word]
    x, y, z = (
        _next_border(limits, start, end, i, 0),
        _next_border(limits, start, end, j, 1),
        _next_border(limits, start, end, k, 2),
    )
    while min(x, y, z) < 1.0:
        if x <= y and x <= z:
            i += 1 if end[0] > start[0] else -1
            x = _next_border(limits, start, end, i, 0)
        elif y <= z:
            j += 1 if end[1] > start[1] else -1
            y = _next_border(limits, start, end, j, 1)
        else:
            k += 1 if end[2] > start[2] else -1
            z = _next_border(limits, start, end, k, 2)
        found |= masks[i, j, k, word]
    return found  # type: ignore[no-any-return]


@leaf
def _cell(limits: Array, point: Vector, axis: int) -> int:
    share = (point[axis] - limits[0, axis]) / (limits[1, axis] - limits[0, axis])
    return min(max(int(share * CELLS), 0), CELLS - 1)


@leaf
def _next_border(limits: Array, start: Vector, end: Vector, cell: int, axis: int) -> float:
    """The share of the way at which it leaves a cell along an axis; infinite if it does not."""
    way = end[axis] - start[axis]
    border = cell + 1 if way > 0.0 else cell
    if way == 0.0 or border <= 0 or border >= CELLS:
        return np.inf
    low, high = limits[0, axis], limits[1, axis]
    return (low + border * (high - low) / CELLS - start[axis]) / way  # type: ignore[no-any-return]
