"""What of a robot's self clearance is proved over the workspace box, as a whole or by its cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.cells import CELLS, Masks
from planner.exact.compiled import kernel
from planner.exact.fields import World
from planner.exact.self_region import (
    PROVED,
    REFUTED,
    Robot,
    pair_over_region,
    platform_over_region,
)
from planner.exact.vectors import Vector

Array = NDArray[np.float64]

_MOST_BOXES = 2048
_DEEPEST = 64


@kernel
def compared(
    world: World,
    robot: Robot,
    which: int,
    rotation: Array,
    corners: Array,
    middle: Vector,
    angle: float,
) -> int:
    """Comparison ``which`` over a region: the pairs in turn, then each cable with the platform."""
    pairs = len(robot.pairs)
    if which < pairs:
        return pair_over_region(world, robot, which, rotation, corners, middle, angle)
    return platform_over_region(world, robot, which - pairs, rotation, corners, middle, angle)


@kernel
def box_proved(world: World, robot: Robot, which: int) -> bool:
    """Whether one comparison is proved over the workspace box; ``which`` as in `compared`."""
    boxes, corners = np.empty((_DEEPEST, 6)), np.empty((8, 3))
    boxes[0, :3], boxes[0, 3:] = world.limits[0], world.limits[1]
    waiting, tried = 1, 0
    rotation = world.platform[:3]
    while waiting > 0:
        waiting -= 1
        tried += 1
        box = boxes[waiting].copy()
        for corner in range(8):
            for axis in range(3):
                corners[corner, axis] = box[axis + 3 * ((corner >> axis) & 1)]
        at = ((box[0] + box[3]) / 2.0, (box[1] + box[4]) / 2.0, (box[2] + box[5]) / 2.0)
        found = compared(world, robot, which, rotation, corners, at, 0.0)
        if found == PROVED:
            continue
        if found == REFUTED or tried >= _MOST_BOXES or waiting + 2 > _DEEPEST:
            return False
        longest = 0
        for axis in range(1, 3):
            if box[axis + 3] - box[axis] > box[longest + 3] - box[longest]:
                longest = axis
        boxes[waiting], boxes[waiting + 1] = box, box
        boxes[waiting, longest + 3], boxes[waiting + 1, longest] = at[longest], at[longest]
        waiting += 2
    return True


@kernel
def mark_open_cells(
    world: World, robot: Robot, which: int, masks: Masks, word: int, bit: np.uint64
) -> None:
    """Sets a bit of the cells over which one comparison is not proved; ``which`` as in `compared`.

    Args:
        world: Where.
        robot: What is needed.
        which: The comparison.
        masks: See `planner.exact.cells`; changed.
        word: Of the masks.
        bit: A word with that bit alone.
    """
    boxes, corners = np.empty((_DEEPEST, 6), dtype=np.int64), np.empty((8, 3))
    boxes[0, :3], boxes[0, 3:] = 0, CELLS
    size = (world.limits[1] - world.limits[0]) / CELLS
    rotation, waiting = world.platform[:3], 1
    while waiting > 0:
        waiting -= 1
        box = boxes[waiting].copy()
        for corner in range(8):
            for axis in range(3):
                number = box[axis + 3 * ((corner >> axis) & 1)]
                corners[corner, axis] = world.limits[0, axis] + number * size[axis]
        at = (
            (corners[0, 0] + corners[7, 0]) / 2.0,
            (corners[0, 1] + corners[7, 1]) / 2.0,
            (corners[0, 2] + corners[7, 2]) / 2.0,
        )
        if compared(world, robot, which, rotation, corners, at, 0.0) == PROVED:
            continue
        longest = 0
        for axis in range(1, 3):
            if box[axis + 3] - box[axis] > box[longest + 3] - box[longest]:
                longest = axis
        middle = (box[longest] + box[longest + 3]) // 2
        if middle == box[longest]:
            masks[box[0], box[1], box[2], word] |= bit
            continue
        boxes[waiting], boxes[waiting + 1] = box, box
        boxes[waiting, longest + 3], boxes[waiting + 1, longest] = middle, middle
        waiting += 2
