"""Wrench feasibility: whether the tension limits suffice for every required wrench, with margin."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput
from model.statics.wrench_sets import (
    FACET_COLUMNS,
    FORCE_ROWS,
    WRENCH_SIZE,
    WrenchFacets,
    blocks,
    cables_at_limits,
    checked_length,
    checked_limits,
    checked_structure_matrix,
    checked_wrench,
    facet_gains,
    subsets,
    wrench_facets,
)


@dataclass(frozen=True, slots=True, eq=False)
class WrenchBox:
    """The required external wrenches: a centre and the half width of each component.

    Attributes:
        centre: shape (6,) or (..., 6), [N, N·m], world frame; usually gravity.
        half_widths: shape (6,) or (..., 6), [N, N·m], not negative; zeros for one wrench only.
    """

    centre: NDArray[np.float64]
    half_widths: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check and freeze the arrays.

        Raises:
            BadInput: A shape is wrong, a value is not finite, or a half-width is negative.
        """
        for name in ("centre", "half_widths"):
            array = checked_wrench(getattr(self, name), name.replace("_", "-")).copy()
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if (self.half_widths < 0.0).any():
            raise BadInput("a half-width of the external wrenches is negative")

    @classmethod
    def of_one(cls, wrench: ArrayLike) -> WrenchBox:
        """Return the box that holds this wrench alone, shape (..., 6), [N, N·m]."""
        return cls(np.asarray(wrench, dtype=np.float64), np.zeros(6))


def capacity_margin(
    structure_matrix: ArrayLike,
    t_min: ArrayLike,
    t_max: ArrayLike,
    external: WrenchBox,
    characteristic_length: float,
) -> NDArray[np.float64]:
    """Return the distance of the required wrenches from the boundary of the available set.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        t_min: Smallest tensions, shape (m,) or (..., m), or one number, [N].
        t_max: Largest tensions, shape (m,) or (..., m), or one number, [N].
        external: The external wrenches to hold, gravity included.
        characteristic_length: [m], divides the moments.

    Returns:
        Signed distance, shape (...), [N]: positive inside, where it is the Euclidean distance to
        the boundary; negative outside, where it is the distance to the most exceeded facet
        plane; minus infinity where the structure matrix is rank-deficient.

    Raises:
        BadInput: A shape is wrong, a value is not finite, or limits are crossed.

    Source: Guay, Cardou, Cruz-Ruiz & Caro, "Measuring how well a structure supports varying
        external wrenches", 2014 (capacity margin).
    """
    matrix = checked_structure_matrix(structure_matrix)
    low, high = checked_limits(t_min, t_max, matrix.shape[-1])
    batch, shape = matrix.shape[:-2], matrix.shape[-2:]
    matrices = matrix.reshape(-1, *shape)
    lows, highs = (_for_each_pose(limit, batch) for limit in (low, high))
    centres, half_widths = (
        _for_each_pose(part, batch) for part in (external.centre, external.half_widths)
    )
    margins = np.zeros(len(matrices))
    for block in blocks(len(matrices), math.comb(shape[1], FACET_COLUMNS)):
        facets = wrench_facets(matrices[block], lows[block], highs[block], characteristic_length)
        box = WrenchBox(centres[block], half_widths[block])
        margins[block] = _margins(facets, box, characteristic_length)
    return margins.reshape(batch)


def limiting_cables(
    structure_matrix: ArrayLike,
    t_min: float,
    t_max: float,
    external: WrenchBox,
    characteristic_length: float,
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the cables whose limits define the capacity margin of one pose of full rank.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        t_min: Smallest tension, [N].
        t_max: Largest tension, [N].
        external: The external wrenches to hold, gravity included.
        characteristic_length: [m], divides the moments.

    Returns:
        Those at their largest and those at their smallest tension, counted from 0.
    """
    facets = wrench_facets(structure_matrix, t_min, t_max, characteristic_length)
    gaps = np.stack(_gaps(facets, external, characteristic_length))
    side, facet = np.unravel_index(int(np.argmin(gaps)), gaps.shape)
    return cables_at_limits(facets.cable_gains[facet] * (-1.0, 1.0)[side])


def _for_each_pose(values: NDArray[np.float64], batch: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        spread = np.broadcast_to(values, (*batch, values.shape[-1]))
    except ValueError as error:
        raise BadInput(f"values of shape {values.shape} for poses of shape {batch}") from error
    return spread.reshape(-1, values.shape[-1])


def _margins(
    facets: WrenchFacets, external: WrenchBox, characteristic_length: float
) -> NDArray[np.float64]:
    below, above = _gaps(facets, external, characteristic_length)
    gaps = np.minimum(below, above).min(axis=-1, initial=np.inf)
    return np.asarray(np.where(facets.full_rank, gaps, -np.inf))


def _gaps(
    facets: WrenchFacets, external: WrenchBox, characteristic_length: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances of the required wrenches from lower and upper facet planes, (..., k)."""
    # The cables give the opposite of the external wrench.
    centre = -external.centre / _units(characteristic_length)
    half_widths = external.half_widths / _units(characteristic_length)
    along = (facets.normals @ centre[..., np.newaxis])[..., 0]
    spread = (np.abs(facets.normals) @ half_widths[..., np.newaxis])[..., 0]
    return along - spread - facets.lower, facets.upper - along - spread


def _units(characteristic_length: float) -> NDArray[np.float64]:
    return np.repeat([1.0, checked_length(characteristic_length)], FORCE_ROWS)


# Wrench closure: whether the cables, with unlimited tensions, can balance any wrench. They can
# exactly when the structure matrix has full rank and all-positive tensions balance each other.


def closure_margin(
    structure_matrix: ArrayLike, characteristic_length: float
) -> NDArray[np.float64]:
    """Return the distance of poses from gaining or losing wrench closure.

    Every direction in which five independent cables cannot act is a test: the others must pull
    along it in both directions.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        characteristic_length: [m], divides the moments.

    Returns:
        shape (...), [-]. Positive exactly where closed: every wrench of this size can be balanced
        with tensions from 0 to 1. Otherwise zero or negative: the self-balancing tensions, of unit
        norm, miss having one sign by this much. It is continuous at zero, and minus infinity where
        the structure matrix is rank-deficient.

    Raises:
        BadInput: The shape is wrong, a value is not finite, or the length is not positive.

    Source: Gouttefarde & Gosselin, "Analysis of the wrench-closure workspace of planar parallel
        cable-driven mechanisms", 2006 (the same condition for planar robots).
    """
    matrix = checked_structure_matrix(structure_matrix)
    batch, shape = matrix.shape[:-2], matrix.shape[-2:]
    matrices = matrix.reshape(-1, *shape)
    margins = np.zeros(len(matrices))
    for block in blocks(len(matrices), math.comb(shape[1], FACET_COLUMNS)):
        facets = wrench_facets(matrices[block], 0.0, 1.0, characteristic_length)
        margins[block] = _closure_margins(matrices[block], facets)
    return margins.reshape(batch)


def _closure_margins(matrices: NDArray[np.float64], facets: WrenchFacets) -> NDArray[np.float64]:
    freedom = matrices.shape[-1] - WRENCH_SIZE
    margins = np.full(len(matrices), -np.inf)
    if freedom < 0:
        return margins
    usable = np.isfinite(facets.upper)
    one_sided = usable & (_weaker_pull(facets.cable_gains, freedom) <= 0.0)
    closed = facets.full_rank & ~one_sided.any(axis=-1)
    room = np.minimum(facets.upper, -facets.lower).min(axis=-1)
    margins[closed] = room[closed]
    opened = facets.full_rank & ~closed
    gains = facet_gains(np.linalg.svd(matrices[opened])[2])
    missed = np.where(one_sided[opened], _weaker_pull(gains, freedom), 0.0)
    margins[opened] = np.minimum(missed.min(axis=-1), 0.0)
    return margins


def _weaker_pull(gains: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Return the largest pull in the weaker direction along each facet normal, < 0 if none.

    Only cables that do not span the facet count: the gains of the others are round-off.
    """
    acting = subsets(gains.shape[-1], freedom + 1)
    pulls = np.take_along_axis(gains, acting[np.newaxis], axis=-1)
    return np.asarray(np.minimum(pulls.max(axis=-1), -pulls.min(axis=-1)))
