"""Wrench closure: can the cables, tensions unlimited, balance any wrench at all.

They can exactly when the structure matrix has full rank and tensions that are all positive balance
each other. When they cannot, there is a wrench against which no cable can pull; one quadratic
program gives either proof. For maps of many poses, `closure_margin` gives the same answer as a
number, without a proof.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput, Fault
from model.statics.wrench_sets import (
    RANK_TOLERANCE,
    WRENCH_SIZE,
    WrenchFacets,
    blocks,
    checked_structure_matrix,
    facet_gains,
    subsets,
    wrench_facets,
)

SMALLEST_TENSION = 1e-9
"""Part of the largest self-balancing tension that the smallest must exceed to be positive."""


@dataclass(frozen=True, slots=True, eq=False)
class WrenchClosure:
    """Whether a pose has wrench closure, with the proof.

    Attributes:
        closed: Whether the cables can balance any wrench.
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        proof: Where closed: tensions that balance each other, shape (m,), all positive, the
            largest 1. Otherwise: a unit wrench along which no cable can pull, shape (6,).
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

        Where closed, the size of the wrench that the self-balancing tensions leave. Otherwise, the
        largest pull of any unit tension along the wrench that none should pull along.
        """
        if self.closed:
            return float(np.linalg.norm(self.structure_matrix @ self.proof))
        return max(0.0, float((self.proof @ self.structure_matrix).max()))


def wrench_closure(structure_matrix: ArrayLike) -> WrenchClosure:
    """Return whether the cables can balance any wrench at one pose, with the proof.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].

    Raises:
        BadInput: The shape is another one, or a value is not finite.
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
    """Return how far poses are from gaining or losing wrench closure.

    Every direction that five independent cables cannot act along is a test: the others must pull
    along it both ways.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        characteristic_length: [m], divides the moments.

    Returns:
        shape (...), [-]. Positive exactly where closed: every wrench of this size can be balanced
        with tensions from 0 to 1. Otherwise zero or negative: the self-balancing tensions, of unit
        length, miss the same sign by this much. It crosses zero without a jump, and is minus
        infinity where the structure matrix has no full rank.

    Raises:
        BadInput: The shape is another one, a value is not finite, or the length is not positive.

    Source: Gouttefarde & Gosselin, "Analysis of the wrench-closure workspace of planar parallel
        cable-driven mechanisms", 2006 (the same condition for planar robots).
    """
    matrix = checked_structure_matrix(structure_matrix)
    batch, shape = matrix.shape[:-2], matrix.shape[-2:]
    matrices = matrix.reshape(-1, *shape)
    margins = np.zeros(len(matrices))
    for block in blocks(len(matrices)):
        facets = wrench_facets(matrices[block], 0.0, 1.0, characteristic_length)
        margins[block] = _closure_margins(matrices[block], facets)
    return margins.reshape(batch)


def _closure_margins(matrices: NDArray[np.float64], facets: WrenchFacets) -> NDArray[np.float64]:
    freedom = matrices.shape[-1] - WRENCH_SIZE
    margins = np.full(len(matrices), -np.inf)
    if freedom < 0:
        return margins
    usable = np.isfinite(facets.upper)
    one_way = usable & (_weaker_way(facets.cable_gains, freedom) <= 0.0)
    closed = facets.full_rank & ~one_way.any(axis=-1)
    room = np.minimum(facets.upper, -facets.lower).min(axis=-1)
    margins[closed] = room[closed]
    opened = facets.full_rank & ~closed
    null_space = np.linalg.svd(matrices[opened])[2][..., WRENCH_SIZE:, :]
    missed = np.where(one_way[opened], _weaker_way(facet_gains(null_space), freedom), 0.0)
    margins[opened] = np.minimum(missed.min(axis=-1), 0.0)
    return margins


def _weaker_way(gains: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Return the largest pull the weaker way along each facet's normal, negative if there is none.

    Only cables that do not span the facet count: the gains of the others are round-off.
    """
    acting = subsets(gains.shape[-1], freedom + 1)
    pulls = np.take_along_axis(gains, acting[np.newaxis], axis=-1)
    return np.asarray(np.minimum(pulls.max(axis=-1), -pulls.min(axis=-1)))


def _most_even(null_basis: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return z with the largest smallest tension, and the multipliers of its optimum.

    Solves min ‖z‖² + s² with ``null_basis @ z + s >= 1``, which has a solution always. Where a
    positive z exists, its optimum is a multiple of the best one; where none does, z = 0 and the
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
