"""Size of the set of wrenches that the cables can give.

The set ``{J t : t_min <= t <= t_max}`` is a zonotope: the sum of one segment a cable. Its volume
is exactly the sum of |det| over every choice of as many segments as there are dimensions, and
does not depend on t_min but only on t_max - t_min.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cdpr.errors import BadInput
from cdpr.statics.arguments import (
    FORCE_ROWS,
    blocks,
    checked_per_cable,
    checked_structure_matrix,
    with_scaled_moments,
)


def force_volume(structure_matrix: ArrayLike, tension_ranges: ArrayLike) -> NDArray[np.float64]:
    """Return the volume of the set of forces, whatever moment comes with them.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        tension_ranges: t_max - t_min, shape (m,) or (..., m), or one number, [N].

    Returns:
        Volume, shape (...), [N³].

    Raises:
        BadInput: A shape is wrong, a value is not finite, or a range is negative.

    Source: Xu & Park, Eqs. 5-8 and Fig. 2b.
    """
    matrix = checked_structure_matrix(structure_matrix)
    return zonotope_volume(_generators(matrix, tension_ranges)[..., :FORCE_ROWS, :])


def wrench_volume(
    structure_matrix: ArrayLike, tension_ranges: ArrayLike, characteristic_length: float
) -> NDArray[np.float64]:
    """Return the volume of the set of wrenches, moments divided by the characteristic length.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        tension_ranges: t_max - t_min, shape (m,) or (..., m), or one number, [N].
        characteristic_length: [m].

    Returns:
        Volume, shape (...), [N⁶]; zero (to round-off) where the matrix has no full rank.

    Raises:
        BadInput: A shape is wrong, a value is not finite, a range is negative, or the length is
            not positive.
    """
    matrix = checked_structure_matrix(structure_matrix)
    scaled = with_scaled_moments(matrix, characteristic_length)
    return zonotope_volume(_generators(scaled, tension_ranges))


def zonotope_volume(generators: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the volume of the sum of segments in n dimensions.

    Args:
        generators: shape (..., n, m), one segment a column.

    Returns:
        Σ |det| over all n-subsets of the columns, shape (...).

    Source: Shephard, "Combinatorial properties of associated zonotopes", 1974.
    """
    dimension, count = generators.shape[-2:]
    batch = generators.shape[:-2]
    volumes = np.zeros(int(np.prod(batch)))
    if count >= dimension:
        flat = generators.reshape(-1, dimension, count)
        chosen = subsets(count, dimension)
        for block in blocks(len(flat)):
            columns = np.swapaxes(flat[block][:, :, chosen], 1, 2)
            volumes[block] = np.abs(_determinants(columns)).sum(axis=-1)
    return volumes.reshape(batch)


@cache
def subsets(count: int, size: int) -> NDArray[np.intp]:
    """Return every ``size``-subset of ``range(count)``, one a row, in a read-only array."""
    chosen = np.array(list(combinations(range(count), size)), dtype=np.intp).reshape(-1, size)
    chosen.flags.writeable = False
    return chosen


def _determinants(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    if matrices.shape[-1] != 3:
        return np.asarray(np.linalg.det(matrices), dtype=np.float64)
    # The planner asks for thousands of these, and LAPACK is eight times slower at this size.
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrices, (-2, -1), (0, 1))
    return np.asarray(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g))


def _generators(
    structure_matrix: NDArray[np.float64], tension_ranges: ArrayLike
) -> NDArray[np.float64]:
    ranges = checked_per_cable(tension_ranges, structure_matrix.shape[-1], "tension_ranges")
    if (ranges < 0.0).any():
        raise BadInput("a tension range is negative: t_max is below t_min")
    return structure_matrix * ranges[..., np.newaxis, :]
