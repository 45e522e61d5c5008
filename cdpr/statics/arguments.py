"""What the functions of this package accept, checked at their border."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cdpr.errors import BadInput

FORCE_ROWS = 3
WRENCH_SIZE = 6
POSES_IN_A_BLOCK = 128
"""Batches are worked through in blocks, so that a block stays in the processor's cache."""


def checked_structure_matrix(structure_matrix: ArrayLike) -> NDArray[np.float64]:
    """Return the structure matrix as floats, shape (..., 6, m).

    Raises:
        BadInput: The shape is another one, or a value is not finite.
    """
    matrix = np.asarray(structure_matrix, dtype=np.float64)
    if matrix.ndim < 2 or matrix.shape[-2] != WRENCH_SIZE or matrix.shape[-1] == 0:
        raise BadInput(f"the structure matrix has shape {matrix.shape}, not (..., 6, m)")
    if not np.isfinite(matrix).all():
        raise BadInput("the structure matrix holds a value that is not a finite number")
    return matrix


def checked_wrench(wrench: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return a wrench as floats, shape (..., 6).

    Raises:
        BadInput: The shape is another one, or a value is not finite.
    """
    checked = np.asarray(wrench, dtype=np.float64)
    if checked.ndim < 1 or checked.shape[-1] != WRENCH_SIZE:
        raise BadInput(f"the {name} has shape {checked.shape}, not (..., 6)")
    if not np.isfinite(checked).all():
        raise BadInput(f"the {name} holds a value that is not a finite number")
    return checked


def checked_per_cable(values: ArrayLike, cable_count: int, name: str) -> NDArray[np.float64]:
    """Return one finite value a cable, shape (..., m); a single number serves every cable.

    Raises:
        BadInput: There are values for another number of cables, or one is not finite.
    """
    checked = np.asarray(values, dtype=np.float64)
    if checked.ndim == 0:
        checked = np.full(cable_count, checked)
    if checked.shape[-1] != cable_count:
        raise BadInput(
            f"{name} has {checked.shape[-1]} values for {cable_count} cables",
            next_step=f"give {cable_count} values, one a cable",
        )
    if not np.isfinite(checked).all():
        raise BadInput(f"{name} holds a value that is not a finite number")
    return checked


def checked_limits(
    t_min: ArrayLike, t_max: ArrayLike, cable_count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and largest tension of each cable, shape (..., m) each, [N].

    Raises:
        BadInput: As for `checked_per_cable`, or a smallest tension is above the largest.
    """
    low = checked_per_cable(t_min, cable_count, "t_min")
    high = checked_per_cable(t_max, cable_count, "t_max")
    if (low > high).any():
        raise BadInput("t_min is above t_max for at least one cable")
    return low, high


def checked_length(characteristic_length: float) -> float:
    """Return the characteristic length [m].

    Raises:
        BadInput: It is not a positive finite number.
    """
    if not 0.0 < characteristic_length < np.inf:
        raise BadInput(f"the characteristic length is {characteristic_length} m, not above 0")
    return characteristic_length


def with_scaled_moments(
    structure_matrix: NDArray[np.float64], characteristic_length: float
) -> NDArray[np.float64]:
    """Return the matrix, shape (..., 6, m), with its moment rows divided by the length [m]."""
    scaled = structure_matrix.copy()
    scaled[..., FORCE_ROWS:, :] /= checked_length(characteristic_length)
    return scaled


def blocks(count: int) -> Iterator[slice]:
    """Yield slices that cover a batch of ``count`` poses block by block."""
    for start in range(0, count, POSES_IN_A_BLOCK):
        yield slice(start, start + POSES_IN_A_BLOCK)
