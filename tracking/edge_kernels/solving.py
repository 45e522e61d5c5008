"""Small symmetric systems of linear equations."""

from __future__ import annotations

import math

from cdpr.compiled import compiled
from cdpr.poses import Array


@compiled
def factored(matrix: Array, size: int) -> bool:
    """Cholesky's factor of a matrix, in place of its lower half; False if it is not positive."""
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > 0.0:
                matrix[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@compiled
def solved(factor: Array, vector: Array, size: int) -> None:
    """Solves with a factor, in place of the right-hand side."""
    for i in range(size):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]
