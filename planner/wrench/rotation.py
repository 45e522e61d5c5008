"""Wrench feasibility proved, not sampled, along edges on which the platform rotates.

Over an interval of the edge the pose depends on a share s from -1 to 1. An anchor at b moves at the
velocity o + h × R b, with o half of the translation and h half of the rotation; its acceleration is
at most |h| |h × b|. This bounds the first and second derivatives of the columns of the structure
matrix and of the weight's moment. In the middle there are tensions t, with the exact slope T that
keeps the wrench to first order; the residual of t + T s is corrected as in
`planner.wrench.feasibility_proof`. Where that does not decide, the margin in the middle may: it
decreases by at most the largest tensions times the changes of the columns. Else the interval is
bisected.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.collision.rotating_edges import rotated_by
from planner.collision.self_collision_regions import OPEN, PROVED, REFUTED
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, along, cross, dot, minus, norm, plus, rotated
from planner.kernels.scene_arrays import World, anchor, exit_point, feed, outlet
from planner.wrench.capacity import LoadArrays, factored, load_at, margin_of, structure_columns
from planner.wrench.feasibility_proof import inner_tensions, levers, missing_wrench, tensions_stay

Array = NDArray[np.float64]

_MOST_PIECES = 1024
_DEEPEST = 64
_FINEST = 1e-6
_THOROUGH = 0.13
"""Part of an edge up to which an interval that tensions do not prove has its margin computed,
which takes ten times as long with ten cables."""


@kernel
def rotating_edge_held(
    world: World,
    load: LoadArrays,
    reserve: float,
    start: Array,
    end: Array,
    rotation: Array,
    turn: Array,
) -> bool:
    """Whether the required wrenches are held all along a straight move with a steady rotation.

    Never True where that is violated.

    Args:
        world: Rig and obstacles; its own orientation is not used.
        load: Required wrenches; the weight's moment is rotated with the platform.
        reserve: Smallest capacity margin required, [N].
        start: World frame, shape (3,), [m].
        end: World frame, shape (3,), [m].
        rotation: ``world_from_platform`` at the start, shape (3, 3).
        turn: Rotation vector from start to end, platform frame, shape (3,), [rad].
    """
    before, after = (start[0], start[1], start[2]), (end[0], end[1], end[2])
    delta, spin = minus(after, before), (turn[0], turn[1], turn[2])
    size = norm(delta) + load.length * norm(spin)
    if not math.isfinite(size):
        return False
    lows, highs = np.empty(_DEEPEST), np.empty(_DEEPEST)
    lows[0], highs[0] = 0.0, 1.0
    waiting, tried = 1, 0
    while waiting > 0:
        waiting -= 1
        tried += 1
        low, high = lows[waiting], highs[waiting]
        half, middle = (high - low) / 2.0, (low + high) / 2.0
        off = (half * delta[0], half * delta[1], half * delta[2])
        bend = (half * spin[0], half * spin[1], half * spin[2])
        at, there = along(before, delta, middle), rotated_by(rotation, turn, middle)
        thorough = high - low <= _THOROUGH
        found = piece_held(world, load, reserve, at, off, there, bend, thorough)
        if found == PROVED:
            continue
        if found == REFUTED or tried >= _MOST_PIECES or waiting + 2 > _DEEPEST:
            return False
        if half * size < _FINEST:
            return False
        lows[waiting], highs[waiting] = middle, high
        lows[waiting + 1], highs[waiting + 1] = low, middle
        waiting += 2
    return True


@kernel
def piece_held(
    world: World,
    load: LoadArrays,
    reserve: float,
    middle: Vector,
    off: Vector,
    rotation: Array,
    bend: Vector,
    thorough: bool,
) -> int:
    """Whether wrenches are held over an interval of an edge: `PROVED`, `REFUTED` or `OPEN`.

    Args:
        reserve: Smallest margin required, [N].
        middle: Position in the middle, [m].
        off: From there to the interval's end, [m].
        rotation: ``world_from_platform`` in the middle, shape (3, 3).
        bend: Half of the interval's rotation as a rotation vector, platform frame, [rad].
        thorough: Whether the margin is computed where tensions prove nothing.
    """
    count = len(world.cables)
    columns, inverse = np.empty((count, 6)), np.empty((count, 6))
    basis = np.empty((count, count))
    structure_columns(world, rotation, middle, load.length, columns)
    if factored(columns, inverse, basis) == 0.0:
        return REFUTED
    here, spin = load_at(load, rotation), rotated(rotation, bend)
    heavy = rotated(rotation, (load.lever[0], load.lever[1], load.lever[2]))
    swung = cross(spin, heavy)
    changes, bends = np.empty(count), np.empty(count)
    bounded = column_motion(world, load, middle, off, rotation, spin, changes, bends)
    if bounded:
        tensions = inner_tensions(here, columns, inverse)
        travels, owed = np.zeros(count), np.empty(6)
        _owed(world, here, middle, off, rotation, spin, swung, columns, tensions, owed)
        for i in range(count):
            for k in range(6):
                travels[i] += inverse[i, k] * owed[k]
            travels[i] = abs(travels[i])
        left = norm(swung) * norm(spin) / 2.0 / load.length
        left += missing_wrench(here, columns, tensions)
        if tensions_stay(here, reserve, inverse, tensions, travels, changes, bends, left):
            return PROVED
    if not thorough:
        return OPEN
    margin = margin_of(here, inverse, basis)
    if not margin >= reserve:
        return REFUTED
    if not bounded:
        return OPEN
    margin -= norm(swung) / load.length
    for i in range(count):
        margin -= load.high * changes[i]
    return PROVED if margin >= reserve else OPEN


@kernel
def column_motion(
    world: World,
    load: LoadArrays,
    middle: Vector,
    off: Vector,
    rotation: Array,
    spin: Vector,
    changes: Array,
    bends: Array,
) -> bool:
    """Bounds of the change of each column over an interval, and of its second-order part.

    False where a column has no bound.
    """
    for cable in range(len(world.cables)):
        arm = rotated(rotation, anchor(world, cable))
        swing, radius = cross(spin, arm), norm(arm)
        swept = norm(swing)
        curl = swept * norm(spin)
        travel = norm(plus(off, swing)) + curl
        reach, free = levers(world, cable, plus(middle, arm), travel)
        if not (reach > 0.0 and free > 0.0):
            return False
        first = travel / min(reach, free)
        moment = (swept + radius * first) / load.length
        changes[cable] = math.sqrt(first * first + moment * moment)
        second = _unit_bend(world.pulley, travel, curl, reach, free)
        moment = (curl + 2.0 * swept * first + radius * second) / load.length
        bends[cable] = math.sqrt(second * second + moment * moment) / 2.0
    return True


@kernel
def _unit_bend(pulley: float, speed: float, curl: float, reach: float, free: float) -> float:
    """A bound of the second derivative of the unit vector along a cable.

    Along w it is 2 |w'|² / (√3 w²) + |w''| / w. On a pulley of radius r the vector rotates in the
    plane of the pulley at the rate v / l across the cable, with l changing at no more than
    v + r v / l, and about the swivel axis at the rate v / ρ; the derivatives of both are added.

    Args:
        pulley: Radius r, [m]; 0 for point exits.
        speed: Largest speed of the anchor.
        reach: Least distance ρ from the swivel axis, [m].
        free: Least free length l, [m].
    """
    squared = speed * speed
    if pulley == 0.0:
        return 2.0 / math.sqrt(3.0) * squared / (free * free) + curl / free
    rolls, swivels = speed / free, speed / reach
    pushed = curl + squared / reach
    bends = (1.0 + pulley / free) * rolls * rolls + pushed / free + pushed / reach
    return bends + (rolls + swivels) * (rolls + swivels)


@kernel
def _owed(
    world: World,
    load: LoadArrays,
    middle: Vector,
    off: Vector,
    rotation: Array,
    spin: Vector,
    swung: Vector,
    columns: Array,
    tensions: Array,
    owed: Array,
) -> None:
    """Writes the first-order change of required minus given wrench, shape (6,), [N]."""
    owed[:] = 0.0
    owed[3], owed[4] = swung[1] / load.length, -swung[0] / load.length
    for cable in range(len(columns)):
        arm = rotated(rotation, anchor(world, cable))
        at = plus(middle, arm)
        swing = cross(spin, arm)
        bent = _turning(world, cable, at, plus(off, swing))
        unit = (columns[cable, 0], columns[cable, 1], columns[cable, 2])
        moment, carried = cross(arm, bent), cross(swing, unit)
        for k in range(3):
            owed[k] -= tensions[cable] * bent[k]
            owed[3 + k] -= tensions[cable] * (moment[k] + carried[k]) / load.length


@kernel
def _turning(world: World, cable: int, at: Vector, velocity: Vector) -> Vector:
    """Derivative of the unit vector from an anchor, [m], to its exit as the anchor moves."""
    delta = minus(exit_point(world, cable, at), at)
    length = norm(delta)
    unit = (delta[0] / length, delta[1] / length, delta[2] / length)
    across = along(velocity, unit, -dot(unit, velocity))
    if world.pulley == 0.0:
        return (-across[0] / length, -across[1] / length, -across[2] / length)
    offset, axis = minus(at, outlet(world, cable)), feed(world, cable)
    radial = along(offset, axis, -dot(offset, axis))
    reach = norm(radial)
    aside = cross(axis, radial)  # as long as the reach: motion per radian of swivel
    swivels = dot(aside, velocity) / (reach * reach)
    rolled = along(across, aside, -swivels)
    swivelled = cross(axis, unit)
    return (
        swivels * swivelled[0] - rolled[0] / length,
        swivels * swivelled[1] - rolled[1] / length,
        swivels * swivelled[2] - rolled[2] / length,
    )
