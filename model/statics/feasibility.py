"""Wrench feasibility: do the tension limits suffice for every wrench that may act, by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput
from model.statics.wrench_sets import (
    FORCE_ROWS,
    WrenchFacets,
    blocks,
    checked_length,
    checked_limits,
    checked_structure_matrix,
    checked_wrench,
    wrench_facets,
)


@dataclass(frozen=True, slots=True, eq=False)
class WrenchBox:
    """The external wrenches that must be held: a centre and how far each component may differ.

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


@dataclass(frozen=True, slots=True, eq=False)
class WrenchFeasibility:
    """Whether every wrench of a box can be held at one pose, with the plane that decides.

    Attributes:
        margin: Signed distance [N] from the required wrenches to the nearest (or most exceeded)
            facet, moments divided by the length; minus infinity where the cables do not act in
            every direction.
        binding_normal: shape (6,), unit vector out of the set through that facet, for wrenches
            with moments divided by the length; where the margin is minus infinity, a direction in
            which no cable acts.
        structure_matrix: shape (6, m).
        t_min: shape (m,), [N].
        t_max: shape (m,), [N].
        external: The wrenches to hold.
        characteristic_length: [m].
    """

    margin: float
    binding_normal: NDArray[np.float64]
    structure_matrix: NDArray[np.float64]
    t_min: NDArray[np.float64]
    t_max: NDArray[np.float64]
    external: WrenchBox
    characteristic_length: float

    @property
    def feasible(self) -> bool:
        """Whether the cables hold every wrench of the box within their limits."""
        return self.margin >= 0.0

    def recomputed_margin(self) -> float:
        """Return the gap along the binding normal [N], from the cables' own wrenches.

        A negative value proves that the box is not held: no tensions within the limits reach its
        farthest wrench along this direction. It is zero or less, too, along a direction in which
        no cable acts.
        """
        normal = self.binding_normal.copy()
        normal[FORCE_ROWS:] /= self.characteristic_length
        gains = normal @ self.structure_matrix
        reach = np.maximum(gains * self.t_min, gains * self.t_max).sum()
        needed = -normal @ self.external.centre + np.abs(normal) @ self.external.half_widths
        return float(reach - needed)


def capacity_margin(
    structure_matrix: ArrayLike,
    t_min: ArrayLike,
    t_max: ArrayLike,
    external: WrenchBox,
    characteristic_length: float,
) -> NDArray[np.float64]:
    """Return how far the required wrenches are inside the set of available ones.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        t_min: Smallest tensions, shape (m,) or (..., m), or one number, [N].
        t_max: Largest tensions, likewise.
        external: The external wrenches to hold, gravity among them.
        characteristic_length: [m], divides the moments.

    Returns:
        Signed distance, shape (...), [N]: positive inside, where it is the Euclidean distance to
        the boundary; negative outside, where it is the distance to the most exceeded facet
        plane; minus infinity where the structure matrix has no full rank.

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
    for block in blocks(len(matrices)):
        facets = wrench_facets(matrices[block], lows[block], highs[block], characteristic_length)
        box = WrenchBox(centres[block], half_widths[block])
        margins[block] = _margins(facets, box, characteristic_length)
    return margins.reshape(batch)


def wrench_feasible(
    structure_matrix: ArrayLike,
    t_min: ArrayLike,
    t_max: ArrayLike,
    external: WrenchBox,
    characteristic_length: float,
) -> WrenchFeasibility:
    """Return whether the cables hold every wrench of the box at one pose, and what decides.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        t_min: Smallest tensions, shape (m,), or one number, [N].
        t_max: Largest tensions, likewise.
        external: The external wrenches to hold, one box.
        characteristic_length: [m], divides the moments.

    Raises:
        BadInput: A shape is wrong, a value is not finite, or limits are crossed.
    """
    matrix = np.array(structure_matrix, dtype=np.float64)
    if matrix.ndim != 2 or external.centre.ndim != 1 or external.half_widths.ndim != 1:
        raise BadInput("wrench_feasible takes one pose; capacity_margin takes many")
    facets = wrench_facets(matrix, t_min, t_max, characteristic_length)
    if facets.full_rank:
        margin, normal = _binding(facets, external, characteristic_length)
    else:
        margin, normal = -np.inf, _idle_direction(matrix, external, characteristic_length)
    low, high = (limit.copy() for limit in checked_limits(t_min, t_max, matrix.shape[1]))
    for array in (normal, matrix, low, high):
        array.flags.writeable = False
    return WrenchFeasibility(margin, normal, matrix, low, high, external, characteristic_length)


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
    """Return the room of the box at the lower and at the upper plane of each pair."""
    # The cables give the opposite of what acts from outside.
    centre = -external.centre / _units(characteristic_length)
    half_widths = external.half_widths / _units(characteristic_length)
    along = (facets.normals @ centre[..., np.newaxis])[..., 0]
    spread = (np.abs(facets.normals) @ half_widths[..., np.newaxis])[..., 0]
    return along - spread - facets.lower, facets.upper - along - spread


def _binding(
    facets: WrenchFacets, external: WrenchBox, characteristic_length: float
) -> tuple[float, NDArray[np.float64]]:
    below, above = _gaps(facets, external, characteristic_length)
    lowest, highest = int(np.argmin(below)), int(np.argmin(above))
    if below[lowest] < above[highest]:
        return float(below[lowest]), -facets.normals[lowest]
    return float(above[highest]), facets.normals[highest].copy()


def _idle_direction(
    structure_matrix: NDArray[np.float64], external: WrenchBox, characteristic_length: float
) -> NDArray[np.float64]:
    """Return the unit direction in which no cable acts, turned to where help is needed."""
    scaled = structure_matrix / _units(characteristic_length)[:, np.newaxis]
    direction = np.linalg.svd(scaled)[0][:, -1]
    needed = direction @ (-external.centre / _units(characteristic_length))
    return -direction if needed < 0.0 else direction.copy()


def _units(characteristic_length: float) -> NDArray[np.float64]:
    return np.repeat([1.0, checked_length(characteristic_length)], FORCE_ROWS)
