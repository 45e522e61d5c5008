"""Wrench feasibility: whether the tension limits suffice for every required wrench, with margin."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput, Fault
from model.statics.wrench_sets import (
    FACET_COLUMNS,
    FORCE_ROWS,
    RANK_TOLERANCE,
    WRENCH_SIZE,
    WrenchFacets,
    blocks,
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


@dataclass(frozen=True, slots=True, eq=False)
class WrenchFeasibility:
    """Whether every wrench of a box can be held at one pose, with the binding facet.

    Attributes:
        margin: Signed distance [N] from the required wrenches to the nearest (or most exceeded)
            facet, moments divided by the length; minus infinity where the cables do not act in
            every direction.
        binding_normal: shape (6,), outward unit normal of that facet, for wrenches with moments
            divided by the length; where the margin is minus infinity, a direction in which no
            cable acts.
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
        farthest wrench along this direction. It is also zero or less along a direction in which no
        cable acts.
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


def wrench_feasible(
    structure_matrix: ArrayLike,
    t_min: ArrayLike,
    t_max: ArrayLike,
    external: WrenchBox,
    characteristic_length: float,
) -> WrenchFeasibility:
    """Return whether the cables hold every wrench of the box at one pose, with the proof.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        t_min: Smallest tensions, shape (m,), or one number, [N].
        t_max: Largest tensions, shape (m,), or one number, [N].
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
    # The cables give the opposite of the external wrench.
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
    """Return the unit direction in which no cable acts, with the sign of the required wrench."""
    scaled = structure_matrix / _units(characteristic_length)[:, np.newaxis]
    direction = np.linalg.svd(scaled)[0][:, -1]
    needed = direction @ (-external.centre / _units(characteristic_length))
    return -direction if needed < 0.0 else direction.copy()


def _units(characteristic_length: float) -> NDArray[np.float64]:
    return np.repeat([1.0, checked_length(characteristic_length)], FORCE_ROWS)


# Wrench closure: whether the cables, with unlimited tensions, can balance any wrench.
#
# They can exactly when the structure matrix has full rank and all-positive tensions balance each
# other. When they cannot, there is a wrench against which no cable can pull; one quadratic program
# gives either proof. For maps of many poses, `closure_margin` gives the same answer as a number,
# without a proof.


SMALLEST_TENSION = 1e-9
"""Part of the largest self-balancing tension that the smallest must exceed to be positive."""


@dataclass(frozen=True, slots=True, eq=False)
class WrenchClosure:
    """Whether a pose has wrench closure, with the proof.

    Attributes:
        closed: Whether the cables can balance any wrench.
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        proof: Where closed: self-balancing tensions, shape (m,), all positive, the largest 1.
            Otherwise: a unit wrench along which no cable can pull, shape (6,).
    """

    closed: bool
    structure_matrix: NDArray[np.float64]
    proof: NDArray[np.float64]

    @property
    def smallest_tension(self) -> float:
        """The smallest of the self-balancing tensions, the largest being 1; 0 when not closed."""
        return float(self.proof.min()) if self.closed else 0.0

    @property
    def residual(self) -> float:
        """Residual of the proof, recomputed; round-off when it holds.

        Where closed, the norm of the wrench that the self-balancing tensions leave. Otherwise, the
        largest pull of any unit tension along the wrench along which none should pull.
        """
        if self.closed:
            return float(np.linalg.norm(self.structure_matrix @ self.proof))
        return max(0.0, float((self.proof @ self.structure_matrix).max()))


def wrench_closure(structure_matrix: ArrayLike) -> WrenchClosure:
    """Return whether the cables can balance any wrench at one pose, with the proof.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].

    Raises:
        BadInput: The shape is wrong, or a value is not finite.
    """
    matrix = checked_structure_matrix(structure_matrix).copy()
    if matrix.ndim != 2:
        raise BadInput(f"wrench_closure takes one pose, not the shape {matrix.shape}")
    left, singular_values, right = np.linalg.svd(matrix)
    if matrix.shape[1] < WRENCH_SIZE or singular_values[-1] <= RANK_TOLERANCE * singular_values[0]:
        return _result(matrix, closed=False, proof=left[:, -1])
    null_basis = right[WRENCH_SIZE:].T
    z, gains = _most_even(null_basis)
    tensions = null_basis @ z
    if tensions.min() > SMALLEST_TENSION * np.abs(tensions).max():
        return _result(matrix, closed=True, proof=tensions / tensions.max())
    blocked = -left @ (right[:WRENCH_SIZE] @ gains / singular_values)
    return _result(matrix, closed=False, proof=blocked / np.linalg.norm(blocked))


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


def _most_even(null_basis: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return z with the largest smallest tension, and the multipliers of its optimum.

    Solves min ‖z‖² + s² with ``null_basis @ z + s >= 1``, which always has a solution. Where a
    positive z exists, the optimum is a multiple of the best one; where none does, z = 0 and the
    multipliers are gains ``Jᵀc >= 0`` of some wrench c (Stiemke's lemma).

    Source: Lawson & Hanson, "Solving least squares problems", 1974, ch. 23 (least distance).
    """
    import daqp

    cables, freedom = null_basis.shape
    with_slack = np.column_stack([null_basis, np.ones(cables)])
    solution, _, exit_flag, info = daqp.solve(
        np.eye(freedom + 1),
        np.zeros(freedom + 1),
        -with_slack,
        -np.ones(cables),
        primal_tol=1e-13,
    )
    if exit_flag != 1:
        raise Fault(f"the quadratic program for wrench closure ended with code {exit_flag}")
    return np.asarray(solution[:freedom]), np.maximum(np.asarray(info["lam"]), 0.0)


def _result(
    matrix: NDArray[np.float64], *, closed: bool, proof: NDArray[np.float64]
) -> WrenchClosure:
    matrix.flags.writeable = False
    frozen = proof.copy()
    frozen.flags.writeable = False
    return WrenchClosure(closed, matrix, frozen)
