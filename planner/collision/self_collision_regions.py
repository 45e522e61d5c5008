"""Cables against each other and against the platform, proved over whole regions of poses.

A region is the hull of corner positions (two for an edge, eight for a box) at one orientation. Two
cables lie on lines at the distance |N| / ‖D‖, with N and D affine in the position p; so N - c ‖D‖
is concave, and non-negative everywhere if it is at the corners. The room at a plane with a fixed
normal is the minimum of functions affine in p.

A cable keeps c to the platform if all of it beyond its stub is before a plane with normal n that is
c before the platform's box. Its exit is before it at all positions if it is at the corners. If the
anchor is before the plane too (it then lies off the box), so is all of the cable, half-spaces being
convex. If the anchor is behind it by h, the stub's end is before it if s n·w - h ‖w‖ ≥ 0, with w
from anchor to exit, affine in p, and s the stub: concave again.

Motion of exits on pulleys and rotation of the platform are subtracted as bounds. In a small region
such a bound alone is a proof, so bisection ends wherever there is room.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.kernels.jit import kernel, leaf
from planner.kernels.primitives import (
    Vector,
    along,
    cross,
    dot,
    minus,
    norm,
    plus,
    rotated,
    row,
    segment_box_between,
    segment_pair_between,
)
from planner.kernels.scene_arrays import World, anchor, exit_point, exit_travel, half_size

# Cells of the workspace box, each with a bit for each comparison that is still open in it.
#
# A comparison that cannot be proved over the whole workspace usually can over nearly all of it. An
# edge then checks only what is open in the cells that it passes.


Masks = NDArray[np.uint64]

CELLS: Final = 32
"""Along each axis; a power of two."""
WORD: Final = 64
"""Comparisons in one word of a mask."""


def words_for(comparisons: int) -> int:
    """Number of words that hold one bit per comparison."""
    return (comparisons + WORD - 1) // WORD


@leaf
def open_along(masks: Masks, limits: Array, start: Vector, end: Vector, word: int) -> np.uint64:
    """The comparisons open in at least one of the cells that a straight move passes.

    A move along the border of cells passes one of them: a cell holds its border.

    Args:
        masks: Shape (CELLS, CELLS, CELLS, words).
        limits: Lower and upper corner of the workspace box, shape (2, 3), [m].
        start: In that box, [m].
        end: In that box, [m].
        word: Index of the word in the masks.
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
    """The share of a move at which it leaves a cell along an axis; infinite if it does not."""
    delta = end[axis] - start[axis]
    border = cell + 1 if delta > 0.0 else cell
    if delta == 0.0 or border <= 0 or border >= CELLS:
        return np.inf
    low, high = limits[0, axis], limits[1, axis]
    return (low + border * (high - low) / CELLS - start[axis]) / delta  # type: ignore[no-any-return]


Array = NDArray[np.float64]
Integers = NDArray[np.int64]

PROVED, OPEN, REFUTED = 1, 0, -1

_LINE_ROUND_OFF = 1e-14


class Robot(NamedTuple):
    """Comparisons of a robot's parts, and those still open.

    Attributes:
        pairs: Cables of each compared pair, shape (q, 2).
        stubs: Length left out of both at the anchors and at the exits, shape (q, 2), [m].
        stub: Length of cable at its anchor that may be near the platform, [m].
        pair_needed: Between the lines of two cables, their radii included, [m].
        platform_needed: Between the line of a cable and the platform, radius included, [m].
        open_pairs: Pairs not proved over the whole workspace, shape (k,).
        open_cables: Cables not proved against the platform over the whole workspace, shape (l,).
        open_cells: Bit masks of these comparisons, pairs first, that are open in each cell, shape
            (c, c, c, words).
    """

    pairs: Integers
    stubs: Array
    stub: float
    pair_needed: float
    platform_needed: float
    open_pairs: Integers
    open_cables: Integers
    open_cells: Masks


@kernel
def pair_over_region(
    world: World,
    robot: Robot,
    pair: int,
    rotation: Array,
    corners: Array,
    middle: Vector,
    angle: float,
) -> int:
    """Whether two cables keep their distance over a region: `PROVED`, `REFUTED` or `OPEN`.

    Args:
        pair: Index of the pair.
        rotation: ``world_from_platform`` in the middle, shape (3, 3).
        corners: Positions whose hull is the region, shape (k, 3), [m].
        middle: A position in it, [m].
        angle: Largest rotation of the platform from ``rotation``, [rad].
    """
    i, j = robot.pairs[pair, 0], robot.pairs[pair, 1]
    at_anchor, at_exit = robot.stubs[pair, 0], robot.stubs[pair, 1]
    needed, reach = robot.pair_needed, _reach(corners, middle)
    arm_i, arm_j = rotated(rotation, anchor(world, i)), rotated(rotation, anchor(world, j))
    b_i, b_j = plus(middle, arm_i), plus(middle, arm_j)
    a_i, a_j = exit_point(world, i, b_i), exit_point(world, j, b_j)
    w_i, w_j = minus(a_i, b_i), minus(a_j, b_j)
    l_i, l_j = norm(w_i), norm(w_j)
    if not (math.isfinite(l_i) and math.isfinite(l_j) and l_i > 0.0 and l_j > 0.0):
        return REFUTED
    between = segment_pair_between(
        along(b_i, w_i, at_anchor / l_i),
        along(a_i, w_i, -at_exit / l_i),
        along(b_j, w_j, at_anchor / l_j),
        along(a_j, w_j, -at_exit / l_j),
    )
    distance = norm(between)
    if not distance >= needed:
        return REFUTED
    moved = _drift(world, i, b_i, reach, angle) + _drift(world, j, b_j, reach, angle)
    if not moved < np.inf:
        return OPEN
    if _by_motion(distance - moved - needed, reach + moved, at_anchor + at_exit, l_i, l_j):
        return PROVED
    if _by_lines(a_i, a_j, arm_i, arm_j, corners, needed + moved):
        return PROVED
    if at_anchor + at_exit == 0.0 and distance > 0.0:
        normal = (between[0] / distance, between[1] / distance, between[2] / distance)
        if _by_plane(normal, a_i, a_j, arm_i, arm_j, corners, needed + moved):
            return PROVED
    return OPEN


@kernel
def platform_over_region(
    world: World,
    robot: Robot,
    cable: int,
    rotation: Array,
    corners: Array,
    middle: Vector,
    angle: float,
) -> int:
    """Whether a cable keeps its distance to the platform over a region; see `pair_over_region`."""
    needed, stub, half = robot.platform_needed, robot.stub, half_size(world)
    fixed = anchor(world, cable)
    at = plus(middle, rotated(rotation, fixed))
    leaving = exit_point(world, cable, at)
    far = _into(rotation, minus(leaving, middle))
    delta = minus(far, fixed)
    length = norm(delta)
    if not (math.isfinite(length) and length > 0.0):
        return REFUTED
    between = segment_box_between(along(fixed, delta, stub / length), far, half)
    distance = norm(between)
    if not distance >= needed:
        return REFUTED
    reach = _reach(corners, middle)
    exit_moved = _exit_drift(world, cable, at, reach + angle * norm(fixed))
    moved = exit_moved + angle * (norm(far) + reach + exit_moved)
    if not moved < np.inf:
        return OPEN
    if _by_motion(distance - needed, reach + moved, stub, length, length):
        return PROVED
    normal = (between[0] / distance, between[1] / distance, between[2] / distance)
    face = abs(normal[0]) * half[0] + abs(normal[1]) * half[1] + abs(normal[2]) * half[2]
    height = needed + face - dot(normal, fixed)
    if height <= 0.0 and length - reach - moved < stub:
        return OPEN
    for k in range(len(corners)):
        shift = _into(rotation, minus(row(corners, k), middle))
        if not dot(normal, minus(far, shift)) - face - moved >= needed:
            return OPEN
        to_exit = minus(delta, shift)
        room = stub * dot(normal, to_exit) - height * norm(to_exit)
        if height > 0.0 and not room >= (stub + height) * moved:
            return OPEN
    return PROVED


@kernel
def _by_motion(room: float, moved: float, stubs: float, l_i: float, l_j: float) -> bool:
    """Proof by motion: points of cables whose ends move by ≤ d change distance by ≤ d.

    Stubs add a term, as their ends move along the cables.
    """
    shortest = min(l_i, l_j) - moved
    if shortest <= 0.0:
        return False
    return room >= moved * (1.0 + 2.0 * stubs / shortest)


@kernel
def _by_lines(
    a_i: Vector, a_j: Vector, arm_i: Vector, arm_j: Vector, corners: Array, needed: float
) -> bool:
    gap = minus(a_j, a_i)
    sign = 0.0
    for k in range(len(corners)):
        at = row(corners, k)
        u_i, u_j = minus(plus(at, arm_i), a_i), minus(plus(at, arm_j), a_j)
        across = cross(u_i, u_j)
        value = dot(gap, across)
        if sign == 0.0:
            sign = 1.0 if value > 0.0 else -1.0
        round_off = _LINE_ROUND_OFF * norm(gap) * norm(u_i) * norm(u_j)
        # Parallel lines, for which both sides are zero, do not pass.
        if not sign * value > needed * norm(across) + round_off:
            return False
    return True


@kernel
def _by_plane(
    normal: Vector,
    a_i: Vector,
    a_j: Vector,
    arm_i: Vector,
    arm_j: Vector,
    corners: Array,
    needed: float,
) -> bool:
    exit_i, exit_j = dot(normal, a_i), dot(normal, a_j)
    for k in range(len(corners)):
        at = row(corners, k)
        anchor_i, anchor_j = dot(normal, plus(at, arm_i)), dot(normal, plus(at, arm_j))
        if not min(exit_j, anchor_j) - max(exit_i, anchor_i) >= needed:
            return False
    return True


@kernel
def _drift(world: World, cable: int, at: Vector, reach: float, angle: float) -> float:
    """Deviation of a cable from the one with fixed exit and unrotated anchor, [m]."""
    turning = angle * norm(anchor(world, cable))
    return turning + _exit_drift(world, cable, at, reach + turning)


@kernel
def _exit_drift(world: World, cable: int, at: Vector, reach: float) -> float:
    """Travel of an exit while its anchor stays within ``reach`` of a point, [m]."""
    return exit_travel(world, cable, at, at, 2.0 * reach) / 2.0


@kernel
def _reach(corners: Array, middle: Vector) -> float:
    farthest = 0.0
    for k in range(len(corners)):
        farthest = max(farthest, norm(minus(row(corners, k), middle)))
    return farthest


@kernel
def _into(rotation: Array, a: Vector) -> Vector:
    """A vector of the world in the axes of the platform."""
    return (
        rotation[0, 0] * a[0] + rotation[1, 0] * a[1] + rotation[2, 0] * a[2],
        rotation[0, 1] * a[0] + rotation[1, 1] * a[1] + rotation[2, 1] * a[2],
        rotation[0, 2] * a[0] + rotation[1, 2] * a[1] + rotation[2, 2] * a[2],
    )


# Comparisons proved over the workspace box, as a whole or by its cells.


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
    """Comparison ``which`` over a region: first the pairs, then each cable with the platform."""
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
    """Sets a bit of the cells over which a comparison is not proved; ``which`` as in `compared`.

    Args:
        masks: See `Robot.open_cells`; changed.
        word: Index of the word in the masks.
        bit: A word with only that bit set.
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
