"""Vectors of three floats as tuples: compiled code keeps them in registers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel, leaf

Vector = tuple[float, float, float]


@kernel
def dot(a: Vector, b: Vector) -> float:
    """The scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def minus(a: Vector, b: Vector) -> Vector:
    """The difference a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def plus(a: Vector, b: Vector) -> Vector:
    """The sum a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def along(start: Vector, direction: Vector, share: float) -> Vector:
    """The point ``start + share * direction``."""
    return (
        start[0] + share * direction[0],
        start[1] + share * direction[1],
        start[2] + share * direction[2],
    )


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@kernel
def norm(a: Vector) -> float:
    """The length."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@leaf
def row(array: NDArray[np.float64], index: int) -> Vector:
    """A row of an array, shape (k, 3)."""
    return (array[index, 0], array[index, 1], array[index, 2])


@leaf
def turned(matrix: NDArray[np.float64], a: Vector) -> Vector:
    """The product of a matrix, shape (3, 3), and a vector."""
    return (
        matrix[0, 0] * a[0] + matrix[0, 1] * a[1] + matrix[0, 2] * a[2],
        matrix[1, 0] * a[0] + matrix[1, 1] * a[1] + matrix[1, 2] * a[2],
        matrix[2, 0] * a[0] + matrix[2, 1] * a[1] + matrix[2, 2] * a[2],
    )
