"""Size and shape of the set of wrenches that the cables can give.

The set {J t : t_min <= t <= t_max} is a zonotope: the Minkowski sum of one segment per cable. Its
volume is exactly the sum of |det| over every choice of as many segments as there are dimensions; it
depends on t_max - t_min only. The condition number of J (dexterity) measures how evenly the cables
convert tensions into wrenches.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput

# Checks of arguments of this package.


FORCE_ROWS = 3
WRENCH_SIZE = 6
FACET_COLUMNS = WRENCH_SIZE - 1
"""Columns of the structure matrix that span a facet."""
POSES_IN_A_BLOCK = 128
"""Batches are processed in blocks that stay in the processor's cache."""
_ROWS_IN_A_BLOCK = 40_000
_FEW_CABLES = 8
"""Up to this number, facets are taken from the null space."""


def checked_structure_matrix(structure_matrix: ArrayLike) -> NDArray[np.float64]:
    """Return the structure matrix as floats, shape (..., 6, m).

    Raises:
        BadInput: The shape is wrong, or a value is not finite.
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
        BadInput: The shape is wrong, or a value is not finite.
    """
    checked = np.asarray(wrench, dtype=np.float64)
    if checked.ndim < 1 or checked.shape[-1] != WRENCH_SIZE:
        raise BadInput(f"the {name} has shape {checked.shape}, not (..., 6)")
    if not np.isfinite(checked).all():
        raise BadInput(f"the {name} holds a value that is not a finite number")
    return checked


def checked_per_cable(values: ArrayLike, cable_count: int, name: str) -> NDArray[np.float64]:
    """Return one finite value per cable, shape (..., m); a single number is used for all.

    Raises:
        BadInput: The number of values is not that of the cables, or one is not finite.
    """
    checked = np.asarray(values, dtype=np.float64)
    if checked.ndim == 0:
        checked = np.full(cable_count, checked)
    if checked.shape[-1] != cable_count:
        raise BadInput(
            f"{name} has {checked.shape[-1]} values for {cable_count} cables",
            next_step=f"give {cable_count} values, one per cable",
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


def blocks(count: int, subset_count: int) -> Iterator[slice]:
    """Yield slices that cover a batch of ``count`` poses block by block.

    Args:
        subset_count: Subsets of the cables per pose; blocks have fewer poses where it is large.
    """
    size = min(max(_ROWS_IN_A_BLOCK // max(subset_count, 1), 1), POSES_IN_A_BLOCK)
    for start in range(0, count, size):
        yield slice(start, start + size)


def force_volume(structure_matrix: ArrayLike, tension_ranges: ArrayLike) -> NDArray[np.float64]:
    """Return the volume of the set of forces, with any moment.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        tension_ranges: t_max - t_min, shape (m,) or (..., m), or one number, [N].

    Returns:
        Volume, shape (...), [N³].

    Raises:
        BadInput: A shape is wrong, a value is not finite, or a range is negative.

    Source: Xu & Park, Eqs. 5-8 and Fig. 2b; Shephard, "Combinatorial properties of associated
        zonotopes", 1974.
    """
    matrix = checked_structure_matrix(structure_matrix)
    ranges = checked_per_cable(tension_ranges, matrix.shape[-1], "tension_ranges")
    if (ranges < 0.0).any():
        raise BadInput("a tension range is negative: t_max is below t_min")
    generators = (matrix * ranges[..., np.newaxis, :])[..., :FORCE_ROWS, :]
    flat = generators.reshape(-1, *generators.shape[-2:])
    volumes = np.zeros(len(flat))
    chosen = subsets(flat.shape[-1], FORCE_ROWS)
    for block in blocks(len(flat), len(chosen)):
        columns = np.swapaxes(flat[block][:, :, chosen], 1, 2)
        volumes[block] = np.abs(_determinants(columns)).sum(axis=-1)
    return volumes.reshape(generators.shape[:-2])


@cache
def subsets(count: int, size: int) -> NDArray[np.intp]:
    """Return every ``size``-subset of ``range(count)``, one per row, in a read-only array."""
    chosen = np.array(list(combinations(range(count), size)), dtype=np.intp).reshape(-1, size)
    chosen.flags.writeable = False
    return chosen


def _determinants(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Determinants of matrices of shape (..., 3, 3)."""
    # The planner needs thousands of these, and LAPACK is eight times slower at this size.
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrices, (-2, -1), (0, 1))
    return np.asarray(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g))


# The available wrench set as the intersection of slabs between parallel hyperplanes.
#
# Every facet of the zonotope ``{J t : t_min <= t <= t_max}`` is spanned by n - 1 columns of J, so
# its normal c is orthogonal to them: ``y = Jᵀc`` is zero on these columns. Such a y lies in the row
# space of J, that is, orthogonal to the null space; supported on m - n + 1 cables only, it is the
# generalised cross product of their null-space rows. For m - n = 2 this takes 3-vectors where the
# columns themselves would take 5×5 minors, and it is the same set of normals. With more cables the
# minors are the smaller ones; they are expanded from those of four columns, these from those of
# three, and so on.


RANK_TOLERANCE = 1e-10
"""σ_min / σ_max at and below which the cables do not act in every direction."""
DEPENDENT_COLUMNS = 1e-12
"""Norm of a cross product of null-space rows (each at most 1) below which it is round-off."""


@dataclass(frozen=True, slots=True)
class WrenchFacets:
    """Pairs of parallel facet planes: the set is ``lower <= normals @ wrench <= upper``.

    The wrench is that of the cables (``J t``), with its moments divided by the length.

    Attributes:
        normals: shape (..., k, 6), unit vectors; zero where dependent columns span no facet.
        cable_gains: ``normals @ J``, shape (..., k, m): wrench along the normal per unit tension.
        lower: shape (..., k), [N].
        upper: shape (..., k), [N].
        full_rank: shape (...); where false, the set is flat and the planes are meaningless.
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
        t_max: Largest tensions, shape (m,) or (..., m), or one number, [N].
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
    """Return unit normals, whether each is a facet's normal, and whether the rank is full."""
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
    gains = facet_gains(right)
    row_space = np.swapaxes(right[..., :WRENCH_SIZE, :], -1, -2)
    normals = gains @ row_space * inverse[..., np.newaxis, :]
    normals = normals @ np.swapaxes(left, -1, -2)
    usable = np.einsum("...i,...i", gains, gains) > DEPENDENT_COLUMNS**2
    usable &= full_rank[..., np.newaxis]
    lengths = np.sqrt(np.einsum("...i,...i", normals, normals))
    scale = np.divide(1.0, lengths, out=np.zeros_like(lengths), where=usable)
    return normals * scale[..., np.newaxis], usable, full_rank


def facet_gains(right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``Jᵀc`` of every facet normal c; its norm vanishes as columns become dependent.

    Args:
        right: Orthonormal rows, shape (..., m, m): six that span the row space of J, then those of
            its null space.

    Returns:
        shape (..., k, m), in the order of ``subsets(m, m - 5)``, whose cables have the gains; those
        of the others are zero, or round-off.
    """
    cable_count = right.shape[-1]
    if cable_count > _FEW_CABLES:
        row_space = right[..., :WRENCH_SIZE, :]
        return np.asarray(_spanned_normals(row_space)[..., ::-1, :] @ row_space)
    null_space = right[..., WRENCH_SIZE:, :]
    chosen = subsets(cable_count, cable_count - WRENCH_SIZE + 1)
    products = generalised_cross(np.moveaxis(null_space[..., chosen], -3, -2))
    gains = np.zeros((*null_space.shape[:-2], len(chosen), cable_count))
    gains[..., np.arange(len(chosen))[:, np.newaxis], chosen] = products
    return gains


def cables_at_limits(gains: NDArray[np.float64]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the cables at their largest and those at their smallest tension on a facet.

    Args:
        gains: Wrench along the facet's outward normal per unit tension, shape (m,).

    Returns:
        Two tuples, counted from 0; the cables that span the facet are in neither.
    """
    counted = DEPENDENT_COLUMNS**0.5 * np.abs(gains).max()
    largest, smallest = (np.flatnonzero(side * gains > counted).tolist() for side in (1.0, -1.0))
    return tuple(largest), tuple(smallest)


def generalised_cross(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector orthogonal to d vectors of d + 1 components.

    Args:
        rows: shape (..., d, d + 1), one vector per row; d is 0, 1 or 2.

    Returns:
        shape (..., d + 1); its norm is the volume that the vectors span.
    """
    count = rows.shape[-2]
    if count == 0:
        return np.ones((*rows.shape[:-2], 1))
    if count == 1:
        return np.stack([rows[..., 0, 1], -rows[..., 0, 0]], axis=-1)
    return np.asarray(np.cross(rows[..., 0, :], rows[..., 1, :]))


def _spanned_normals(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vectors orthogonal to every five columns, their norms the spanned volumes.

    Args:
        columns: shape (..., 6, m).

    Returns:
        shape (..., k, 6), in the order of ``subsets(m, 5)``, the reverse of that of the other
        m - 5 columns.
    """
    minors = np.swapaxes(columns, -1, -2)  # of all choices of columns and rows, by expansion
    for size in range(2, WRENCH_SIZE):
        before, last = _expansion(columns.shape[-1], size)
        rows = subsets(WRENCH_SIZE, size)
        smaller = {tuple(row): i for i, row in enumerate(subsets(WRENCH_SIZE, size - 1).tolist())}
        parts = []
        for row in rows.tolist():
            total = np.zeros((*columns.shape[:-2], len(last)))
            for k, left_out in enumerate(row):
                rest = smaller[tuple(row[:k] + row[k + 1 :])]
                part = columns[..., left_out, :][..., last] * minors[..., rest][..., before]
                total += part if (size - 1 - k) % 2 == 0 else -part
            parts.append(total)
        minors = np.stack(parts, axis=-1)
    signs = (-1.0) ** np.arange(WRENCH_SIZE)
    return np.asarray(minors[..., ::-1] * signs)


@cache
def _expansion(count: int, size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Of every ``size``-subset: the index of the subset without its last member, and that."""
    chosen = subsets(count, size)
    index = {tuple(row): i for i, row in enumerate(subsets(count, size - 1).tolist())}
    before = np.array([index[tuple(row[:-1])] for row in chosen.tolist()], dtype=np.intp)
    return before, chosen[:, -1]


# Dexterity: how evenly the cables convert tensions into wrenches.


def condition_number(
    structure_matrix: ArrayLike, characteristic_length: float
) -> NDArray[np.float64]:
    """Return the condition number of the structure matrix, 1 at best.

    Forces and moments have different units, so the number is meaningful only together with the
    length by which the moments are divided; hence no default.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        characteristic_length: [m]; `rms_anchor_radius` gives the usual one.

    Returns:
        σ_max / σ_min, shape (...); infinite where the matrix is rank-deficient.

    Raises:
        BadInput: A shape is wrong, a value is not finite, or the length is not positive.

    Source: Xu & Park, Eq. 4, with the ratio adapted to the singular values of a 6×m matrix.
    """
    matrix = checked_structure_matrix(structure_matrix)
    scaled = with_scaled_moments(matrix, characteristic_length)
    if matrix.shape[-1] < WRENCH_SIZE:
        return np.full(matrix.shape[:-2], np.inf)
    singular_values = np.linalg.svd(scaled, compute_uv=False)
    largest, smallest = singular_values[..., 0], singular_values[..., -1]
    round_off = np.finfo(np.float64).eps * matrix.shape[-1] * largest
    ratio = np.full(matrix.shape[:-2], np.inf)
    np.divide(largest, smallest, out=ratio, where=smallest > round_off)
    return ratio


def rms_anchor_radius(anchors_in_platform: ArrayLike) -> float:
    """Return the root mean square distance of the anchors from the platform origin.

    Args:
        anchors_in_platform: shape (m, 3), [m], platform frame.

    Returns:
        The radius [m], the usual characteristic length.

    Raises:
        BadInput: The shape is wrong, or a value is not finite.
    """
    anchors = np.asarray(anchors_in_platform, dtype=np.float64)
    if anchors.ndim != 2 or anchors.shape[1] != 3 or len(anchors) == 0:
        raise BadInput(f"the anchors have shape {anchors.shape}, not (m, 3)")
    if not np.isfinite(anchors).all():
        raise BadInput("the anchors hold a value that is not a finite number")
    return float(np.sqrt(np.mean(np.sum(anchors**2, axis=1))))
