"""The set of available wrenches as the space between pairs of parallel hyperplanes.

Every facet of the zonotope ``{J t : t_min <= t <= t_max}`` is spanned by n - 1 columns of J, so
its normal c is orthogonal to them: ``y = Jᵀc`` is zero on these columns. Such a y lies in the row
space of J, that is, orthogonal to the null space; supported on m - n + 1 cables only, it is the
generalised cross product of their null-space rows. For m - n = 2 this takes 3-vectors where the
columns themselves would take 5×5 minors, and it is the same set of normals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cdpr.statics.arguments import (
    WRENCH_SIZE,
    checked_limits,
    checked_structure_matrix,
    with_scaled_moments,
)
from cdpr.statics.wrench_set import subsets

RANK_TOLERANCE = 1e-10
"""σ_min / σ_max at and below which the cables do not act in every direction."""
DEPENDENT_COLUMNS = 1e-12
"""Length of a cross product of null-space rows (each at most 1) that is round-off, no normal."""


@dataclass(frozen=True, slots=True)
class WrenchFacets:
    """Pairs of parallel facet planes: the set is ``lower <= normals @ wrench <= upper``.

    The wrench is that of the cables (``J t``), with its moments divided by the length.

    Attributes:
        normals: shape (..., k, 6), unit vectors; zero where dependent columns span no facet.
        cable_gains: ``normals @ J``, shape (..., k, m): wrench along the normal by unit tension.
        lower: shape (..., k), [N].
        upper: shape (..., k), [N].
        full_rank: shape (...); where it is false the set is flat and the planes say nothing.
    """

    normals: NDArray[np.float64]
    cable_gains: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    full_rank: NDArray[np.bool_]


def wrench_facets(
    structure_matrix: ArrayLike,
    t_min: ArrayLike,
    t_max: ArrayLike,
    characteristic_length: float,
) -> WrenchFacets:
    """Return the facet planes of the set of available wrenches.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        t_min: Smallest tensions, shape (m,) or (..., m), or one number, [N].
        t_max: Largest tensions, likewise.
        characteristic_length: [m], divides the moments.

    Raises:
        BadInput: A shape is wrong, a value is not finite, or limits are crossed.

    Source: Bouchard, Gosselin & Moore, "On the ability of a cable-driven robot to generate a
        prescribed set of wrenches", 2010 (hyperplane shifting).
    """
    matrix = checked_structure_matrix(structure_matrix)
    low, high = checked_limits(t_min, t_max, matrix.shape[-1])
    scaled = with_scaled_moments(matrix, characteristic_length)
    normals, usable, full_rank = _normals(scaled)
    gains = normals @ scaled
    middle = (gains @ ((low + high) / 2.0)[..., np.newaxis])[..., 0]
    reach = (np.abs(gains) @ ((high - low) / 2.0)[..., np.newaxis])[..., 0]
    reach[~usable] = np.inf
    return WrenchFacets(normals, gains, middle - reach, middle + reach, full_rank)


def _normals(
    scaled: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the unit normals, which of them are facets' normals, and where the rank is full."""
    cable_count = scaled.shape[-1]
    freedom = cable_count - WRENCH_SIZE
    if freedom < 0:
        batch = scaled.shape[:-2]
        none = np.zeros((*batch, 0), dtype=np.bool_)
        return np.zeros((*batch, 0, WRENCH_SIZE)), none, np.zeros(batch, dtype=np.bool_)
    left, singular_values, right = np.linalg.svd(scaled)
    largest, smallest = singular_values[..., 0], singular_values[..., -1]
    full_rank = smallest > RANK_TOLERANCE * largest
    inverse = 1.0 / np.where(full_rank[..., np.newaxis], singular_values, 1.0)
    row_space, null_space = right[..., :WRENCH_SIZE, :], right[..., WRENCH_SIZE:, :]
    gains = facet_gains(null_space)
    normals = gains @ np.swapaxes(row_space, -1, -2) * inverse[..., np.newaxis, :]
    normals = normals @ np.swapaxes(left, -1, -2)
    usable = np.einsum("...i,...i", gains, gains) > DEPENDENT_COLUMNS**2
    usable &= full_rank[..., np.newaxis]
    lengths = np.sqrt(np.einsum("...i,...i", normals, normals))
    scale = np.divide(1.0, lengths, out=np.zeros_like(lengths), where=usable)
    return normals * scale[..., np.newaxis], usable, full_rank


def facet_gains(null_space: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``Jᵀc`` of every facet normal c; its length fades where columns become dependent.

    Args:
        null_space: Orthonormal rows that span the null space of J, shape (..., d, m).

    Returns:
        shape (..., k, m), in the order of ``subsets(m, d + 1)``, whose cables have the gains.
    """
    freedom, cable_count = null_space.shape[-2:]
    chosen = subsets(cable_count, freedom + 1)
    products = generalised_cross(np.moveaxis(null_space[..., chosen], -3, -2))
    gains = np.zeros((*null_space.shape[:-2], len(chosen), cable_count))
    gains[..., np.arange(len(chosen))[:, np.newaxis], chosen] = products
    return gains


def generalised_cross(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector orthogonal to d vectors of d + 1 components.

    Args:
        rows: shape (..., d, d + 1), one vector a row.

    Returns:
        shape (..., d + 1); its length is the volume that the vectors span.
    """
    count = rows.shape[-2]
    if count == 0:
        return np.ones((*rows.shape[:-2], 1))
    if count == 1:
        return np.stack([rows[..., 0, 1], -rows[..., 0, 0]], axis=-1)
    if count == 2:
        return np.asarray(np.cross(rows[..., 0, :], rows[..., 1, :]))
    minors = [np.linalg.det(np.delete(rows, skipped, axis=-1)) for skipped in range(count + 1)]
    signs = (-1.0) ** np.arange(count + 1)
    return np.asarray(np.stack(minors, axis=-1) * signs)
