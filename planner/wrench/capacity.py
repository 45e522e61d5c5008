"""The capacity margin at a pose; its definition is `model.statics.feasibility.capacity_margin`.

Every facet of the available wrench set belongs to m - 5 cables: the gains of its normal are zero on
all others, and on these they form the vector orthogonal to their rows of the null space.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from model.statics.gravity import STANDARD_GRAVITY
from model.statics.wrench_sets import rms_anchor_radius
from planner.costs import external_wrenches
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, cross, minus, norm, plus, rotated
from planner.kernels.scene_arrays import World, anchor, exit_point

# The structure matrix with scaled moments, and its factors: pseudo-inverse and null space.


FLAT = 1e-9
"""Smallest over largest diagonal factor below which the cables do not act in every direction."""


@kernel
def structure_columns(
    world: World, rotation: Array, position: Vector, length: float, columns: Array
) -> None:
    """Writes the columns of the structure matrix, moments divided by ``length``, as rows.

    Args:
        world: Rig and obstacles.
        rotation: ``world_from_platform``, shape (3, 3).
        position: World frame, [m].
        length: Characteristic length, [m].
        columns: Written, shape (m, 6); NaN where a cable has no exit point.
    """
    for cable in range(len(world.cables)):
        arm = rotated(rotation, anchor(world, cable))
        at = plus(position, arm)
        delta = minus(exit_point(world, cable, at), at)
        size = norm(delta)
        unit = (delta[0] / size, delta[1] / size, delta[2] / size)
        moment = cross(arm, unit)
        columns[cable, 0], columns[cable, 1], columns[cable, 2] = unit
        for k in range(3):
            columns[cable, 3 + k] = moment[k] / length


@kernel
def factored(columns: Array, inverse: Array, null_space: Array) -> float:
    """The pseudo-inverse and the null space of a structure matrix A, by Householder reflections.

    Args:
        columns: Aᵀ, shape (m ≥ 6, 6).
        inverse: Written: A⁺, shape (m, 6).
        null_space: Written: an orthonormal basis as columns, shape (m, m - 6).

    Returns:
        Smallest over largest absolute diagonal factor; 0 where A contains NaN.
    """
    count = len(columns)
    upper = columns.copy()
    square = np.eye(count)
    for k in range(6):
        size = 0.0
        for i in range(k, count):
            size += upper[i, k] * upper[i, k]
        size = math.sqrt(size)
        if not size > 0.0:
            return 0.0
        if upper[k, k] > 0.0:
            size = -size
        reflector = np.zeros(count)
        for i in range(k, count):
            reflector[i] = upper[i, k]
        reflector[k] -= size
        scale = 0.0
        for i in range(k, count):
            scale += reflector[i] * reflector[i]
        if scale > 0.0:
            for j in range(k, 6):
                along = 0.0
                for i in range(k, count):
                    along += reflector[i] * upper[i, j]
                for i in range(k, count):
                    upper[i, j] -= 2.0 * along / scale * reflector[i]
            for i in range(count):
                along = 0.0
                for j in range(k, count):
                    along += square[i, j] * reflector[j]
                for j in range(k, count):
                    square[i, j] -= 2.0 * along / scale * reflector[j]
    smallest, largest = np.inf, 0.0
    for k in range(6):
        smallest, largest = min(smallest, abs(upper[k, k])), max(largest, abs(upper[k, k]))
    if not smallest > FLAT * largest:
        return 0.0
    # Aᵀ = Q R, hence A⁺ Rᵀ = Q: each row by back substitution.
    for i in range(count):
        for k in range(5, -1, -1):
            value = square[i, k]
            for j in range(k + 1, 6):
                value -= inverse[i, j] * upper[k, j]
            inverse[i, k] = value / upper[k, k]
        for k in range(6, count):
            null_space[i, k - 6] = square[i, k]
    return smallest / largest


Integers = NDArray[np.int64]

_DEPENDENT = 1e-12


class LoadArrays(NamedTuple):
    """Required wrenches and tension limits; moments divided by `length`.

    Attributes:
        low: Smallest tension, [N].
        high: Largest tension, [N].
        length: Characteristic length, [m].
        wrench: Centre of the required wrenches, shape (6,), [N].
        spread: Half widths of the box of wrenches about it, shape (6,), [N].
        lever: Sum of weights times their centres, platform frame, shape (3,), [N·m]: the part of
            the wrench that rotates with the platform.
        facets: Cables of each facet, shape (k, m - 5).
    """

    low: float
    high: float
    length: float
    wrench: Array
    spread: Array
    lever: Array
    facets: Integers


def build_load(rig: Rig, scene: Scene, rotation: Array) -> LoadArrays:
    """The required wrenches of a rig in a scene at one orientation, shape (3, 3)."""
    length = float(rms_anchor_radius(rig.anchors))
    units = np.repeat([1.0, length], 3)
    box = external_wrenches(rig, scene, rotation)
    facets = list(combinations(range(rig.cable_count), rig.cable_count - 5))
    return LoadArrays(
        low=float(rig.min_tension),
        high=float(rig.max_tension),
        length=length,
        wrench=-box.centre / units,
        spread=box.half_widths / units,
        lever=_lever(rig, scene),
        facets=np.array(facets, dtype=np.int64),
    )


def _lever(rig: Rig, scene: Scene) -> Array:
    moment = rig.mass * rig.centre_of_mass
    moment = moment + scene.load.payload_mass * scene.load.payload_centre
    lever: Array = STANDARD_GRAVITY * moment
    return lever


@kernel
def load_at(load: LoadArrays, rotation: Array) -> LoadArrays:
    """The same load with the platform rotated to ``rotation``, shape (3, 3)."""
    lever = rotated(rotation, (load.lever[0], load.lever[1], load.lever[2]))
    wrench = load.wrench.copy()
    wrench[3], wrench[4], wrench[5] = lever[1] / load.length, -lever[0] / load.length, 0.0
    return LoadArrays(
        load.low, load.high, load.length, wrench, load.spread, load.lever, load.facets
    )


@kernel
def margin_at(world: World, load: LoadArrays, rotation: Array, position: Vector) -> float:
    """The capacity margin, [N]; minus infinity where cables do not act in every direction."""
    count = len(world.cables)
    columns, inverse = np.empty((count, 6)), np.empty((count, 6))
    null_space = np.empty((count, count - 6))
    structure_columns(world, rotation, position, load.length, columns)
    if factored(columns, inverse, null_space) == 0.0:
        return -np.inf
    return margin_of(load, inverse, null_space)


@kernel
def margins(world: World, load: LoadArrays, positions: Array) -> Array:
    """`margin_at` for many positions, shape (k, 3), [m], at the world's orientation."""
    found = np.empty(len(positions))
    for i in range(len(positions)):
        at = (positions[i, 0], positions[i, 1], positions[i, 2])
        found[i] = margin_at(world, load, world.platform[:3], at)
    return found


@kernel
def margin_of(load: LoadArrays, inverse: Array, null_space: Array) -> float:
    """The capacity margin, [N], from the factors of the structure matrix."""
    size = load.facets.shape[1]
    middle, half = (load.high + load.low) / 2.0, (load.high - load.low) / 2.0
    gains, rows = np.empty(size), np.empty((max(size - 1, 1), size))
    least = np.inf
    for facet in range(len(load.facets)):
        cables = load.facets[facet]
        for i in range(size):
            for j in range(size - 1):
                rows[j, i] = null_space[cables[i], j]
        orthogonal_vector(rows, size, gains)
        total, reach, offset, squared, along, spread = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(size):
            total += gains[i] * gains[i]
            reach += abs(gains[i]) * half
            offset += gains[i] * middle
        if not total > _DEPENDENT * _DEPENDENT:
            continue
        for k in range(6):
            normal = 0.0
            for i in range(size):
                normal += gains[i] * inverse[cables[i], k]
            squared += normal * normal
            along += normal * load.wrench[k]
            spread += abs(normal) * load.spread[k]
        least = min(least, (reach - spread - abs(along - offset)) / math.sqrt(squared))
    return least


@kernel
def orthogonal_vector(rows: Array, size: int, found: Array) -> None:
    """The generalised cross product: orthogonal to size - 1 rows, its norm their volume.

    Args:
        rows: Shape (size - 1, size) or more; destroyed.
        size: Number of components.
        found: Written, shape (size,); zeros where the rows are dependent.
    """
    if size == 3:
        found[0] = rows[0, 1] * rows[1, 2] - rows[0, 2] * rows[1, 1]
        found[1] = rows[0, 2] * rows[1, 0] - rows[0, 0] * rows[1, 2]
        found[2] = rows[0, 0] * rows[1, 1] - rows[0, 1] * rows[1, 0]
        return
    order, volume = np.arange(size), 1.0
    for k in range(size - 1):
        best, at_row, at_column = 0.0, k, k
        for i in range(k, size - 1):
            for j in range(k, size):
                if abs(rows[i, order[j]]) > best:
                    best, at_row, at_column = abs(rows[i, order[j]]), i, j
        if best == 0.0:
            found[:] = 0.0
            return
        order[k], order[at_column] = order[at_column], order[k]
        for j in range(size):
            rows[k, j], rows[at_row, j] = rows[at_row, j], rows[k, j]
        pivot = rows[k, order[k]]
        volume *= pivot
        for i in range(k + 1, size - 1):
            factor = rows[i, order[k]] / pivot
            for j in range(k, size):
                rows[i, order[j]] -= factor * rows[k, order[j]]
    found[order[size - 1]] = volume
    for k in range(size - 2, -1, -1):
        value = 0.0
        for j in range(k + 1, size):
            value += rows[k, order[j]] * found[order[j]]
        found[order[k]] = -value / rows[k, order[k]]
