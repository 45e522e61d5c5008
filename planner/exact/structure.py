"""The structure matrix with scaled moments, and its factors: pseudo-inverse and null space."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.exits import exit_point
from planner.exact.fields import World, anchor
from planner.exact.vectors import Vector, cross, minus, norm, plus, turned

Array = NDArray[np.float64]

FLAT = 1e-9
"""Smallest over largest diagonal factor below which the cables do not act in every direction."""


@kernel
def structure_columns(
    world: World, rotation: Array, position: Vector, length: float, columns: Array
) -> None:
    """Writes the columns of the structure matrix, moments divided by ``length``, as rows.

    Args:
        world: Where.
        rotation: ``world_from_platform``, shape (3, 3).
        position: World frame, [m].
        length: Characteristic length, [m].
        columns: Written to; shape (m, 6); not numbers where a cable cannot run.
    """
    for cable in range(len(world.cables)):
        arm = turned(rotation, anchor(world, cable))
        at = plus(position, arm)
        way = minus(exit_point(world, cable, at), at)
        size = norm(way)
        unit = (way[0] / size, way[1] / size, way[2] / size)
        moment = cross(arm, unit)
        columns[cable, 0], columns[cable, 1], columns[cable, 2] = unit
        for k in range(3):
            columns[cable, 3 + k] = moment[k] / length


@kernel
def factored(columns: Array, inverse: Array, null_space: Array) -> float:
    """The pseudo-inverse and the null space of a structure matrix A, by Householder reflections.

    Args:
        columns: Aᵀ, shape (m ≥ 6, 6).
        inverse: Written to: A⁺, shape (m, 6).
        null_space: Written to: an orthonormal basis as columns, shape (m, m - 6).

    Returns:
        Smallest over largest absolute diagonal factor; 0 where A holds no numbers.
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
    # Aᵀ = Q R, hence A⁺ Rᵀ = Q: each row solved from its end.
    for i in range(count):
        for k in range(5, -1, -1):
            value = square[i, k]
            for j in range(k + 1, 6):
                value -= inverse[i, j] * upper[k, j]
            inverse[i, k] = value / upper[k, k]
        for k in range(6, count):
            null_space[i, k - 6] = square[i, k]
    return smallest / largest
