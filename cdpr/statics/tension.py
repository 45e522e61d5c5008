"""Tension distribution: the one set of tensions to command, out of all that balance a wrench.

All tensions that balance a wrench are ``particular + null_basis @ z``. With as many cables as
freedoms there is one; with one cable more, z is in an interval; with two more, in a convex polygon
that is found exactly. Beyond that a quadratic program finds the tensions nearest to a reference.

`least_norm` and `centroid` are continuous in the pose and the wrench as long as the feasible set
has an interior; `barycentre` (mean of the corners) jumps where a corner splits in two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cdpr.errors import BadInput, Fault
from cdpr.statics.arguments import (
    WRENCH_SIZE,
    checked_limits,
    checked_per_cable,
    checked_structure_matrix,
    checked_wrench,
)
from cdpr.statics.feasible_polygon import (
    HalfPlane,
    area_centroid,
    clipped,
    corner_mean,
    nearest_on_boundary,
    square,
)
from cdpr.statics.tension_solution import TensionInfeasible, TensionMethod, TensionSolution
from cdpr.statics.wrench_facets import DEPENDENT_COLUMNS, RANK_TOLERANCE, wrench_facets

ROUND_OFF = 1e-10
"""Part of the largest limit by which a limit may be missed before a wrench counts as infeasible."""


@dataclass(frozen=True, slots=True)
class _Balance:
    """All tensions that balance the wrench, and the limits, z = 0 at the least norm."""

    particular: NDArray[np.float64]
    null_basis: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def tensions(self, z: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(self.particular + self.null_basis @ np.asarray(z, dtype=np.float64))

    def holds(self, z: NDArray[np.float64]) -> bool:
        tensions = self.tensions(z)
        return bool((tensions >= self.low).all() and (tensions <= self.high).all())

    def relaxed(self, amount: float) -> _Balance:
        return _Balance(self.particular, self.null_basis, self.low - amount, self.high + amount)


def solve_tensions(
    structure_matrix: ArrayLike,
    external_wrench: ArrayLike,
    t_min: ArrayLike,
    t_max: ArrayLike,
    *,
    method: TensionMethod = "centroid",
    reference: ArrayLike = 0.0,
) -> TensionSolution:
    """Return tensions within the limits with ``structure_matrix @ tensions + external_wrench = 0``.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        external_wrench: shape (6,), [N, N·m], world frame, gravity among it.
        t_min: Smallest tensions, shape (m,), or one number, [N].
        t_max: Largest tensions, likewise.
        method: ``least_norm``: nearest to the reference; ``centroid`` and ``barycentre``: centre
            of area and mean of the corners of the feasible set, for at most two cables more than
            freedoms.
        reference: Wanted tensions for ``least_norm``, shape (m,), or one number, [N].

    Raises:
        TensionInfeasible: No such tensions exist; it says by how much.
        BadInput: A shape is wrong, a value is not finite, limits are crossed, or the method is
            unknown or not defined for this number of cables.

    Source: Mikelsons, Bruckmann, Hiller & Schramm, "A real-time capable force calculation
        algorithm for redundant tendon-based parallel manipulators", 2008 (centroid).
    """
    matrix = checked_structure_matrix(structure_matrix)
    wrench = checked_wrench(external_wrench, "external wrench")
    if matrix.ndim != 2 or wrench.ndim != 1:
        raise BadInput("solve_tensions takes one pose and one wrench")
    low, high = checked_limits(t_min, t_max, matrix.shape[1])
    _check_method(method, matrix.shape[1])
    wanted = checked_per_cable(reference, matrix.shape[1], "reference")
    balance = _balance(matrix, wrench, low, high)
    z = _choice(balance, method, wanted)
    if z is None:
        round_off = ROUND_OFF * max(float(np.abs(low).max()), float(np.abs(high).max()))
        _raise_unless_round_off(matrix, wrench, low, high, round_off)
        z = _choice(balance.relaxed(2.0 * round_off), method, wanted)
        if z is None:
            raise Fault("two routes differ on whether tensions exist that balance the wrench")
    # Only round-off is clipped here; wrench_residual shows what it costs.
    tensions = np.minimum(np.maximum(balance.tensions(z), low), high)
    return TensionSolution(tensions, method, matrix.copy(), wrench.copy(), low.copy(), high.copy())


def _check_method(method: str, cable_count: int) -> None:
    known = get_args(TensionMethod)
    if method not in known:
        raise BadInput(f"unknown tension method '{method}'", next_step=f"use one of {known}")
    if method != "least_norm" and cable_count > WRENCH_SIZE + 2:
        raise BadInput(
            f"the method '{method}' is defined for at most {WRENCH_SIZE + 2} cables,"
            f" not {cable_count}",
            next_step="use 'least_norm'",
        )


def _balance(
    matrix: NDArray[np.float64],
    wrench: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> _Balance:
    left, singular_values, right = np.linalg.svd(matrix)
    if len(right) < WRENCH_SIZE or singular_values[-1] <= RANK_TOLERANCE * singular_values[0]:
        raise TensionInfeasible(np.inf)
    particular = -(wrench @ left / singular_values) @ right[:WRENCH_SIZE]
    return _Balance(particular, right[WRENCH_SIZE:].T, low, high)


def _choice(
    balance: _Balance, method: TensionMethod, wanted: NDArray[np.float64]
) -> ArrayLike | None:
    """Return the chosen null-space coordinates, shape (m - 6,), or None when there are none."""
    freedom = balance.null_basis.shape[1]
    if freedom == 0:
        return np.zeros(0) if balance.holds(np.zeros(0)) else None
    target = wanted @ balance.null_basis
    if method == "least_norm" and balance.holds(target):
        return target
    if freedom == 1:
        return _in_interval(balance, method, float(target[0]))
    if freedom == 2:
        return _in_polygon(balance, method, target)
    return _by_quadratic_program(balance, target)


def _in_interval(balance: _Balance, method: TensionMethod, target: float) -> ArrayLike | None:
    slopes = balance.null_basis[:, 0]
    tight = np.abs(slopes) <= DEPENDENT_COLUMNS
    below, above = balance.low - balance.particular, balance.high - balance.particular
    if (below[tight] > 0.0).any() or (above[tight] < 0.0).any():
        return None
    ends = np.sort(np.stack([below[~tight], above[~tight]]) / slopes[~tight], axis=0)
    start, end = float(ends[0].max()), float(ends[1].min())
    if start > end:
        return None
    return [min(max(target, start), end) if method == "least_norm" else (start + end) / 2.0]


def _in_polygon(
    balance: _Balance, method: TensionMethod, target: NDArray[np.float64]
) -> ArrayLike | None:
    polygon = clipped(square(_reach(balance)), _half_planes(balance))
    if not polygon:
        return None
    if method == "centroid":
        return area_centroid(polygon)
    if method == "barycentre":
        return corner_mean(polygon)
    return nearest_on_boundary(polygon, (float(target[0]), float(target[1])))


def _reach(balance: _Balance) -> float:
    """Return a bound of ‖z‖, which is at most ‖tensions‖ as the null basis is orthonormal."""
    largest = np.maximum(np.abs(balance.low), np.abs(balance.high))
    return 2.0 * float(np.sqrt(largest @ largest)) + 1.0


def _half_planes(balance: _Balance) -> list[HalfPlane]:
    slopes = balance.null_basis.tolist()
    room_below = (balance.particular - balance.low).tolist()
    room_above = (balance.high - balance.particular).tolist()
    lower = [(a, b, c) for (a, b), c in zip(slopes, room_below, strict=True)]
    upper = [(-a, -b, c) for (a, b), c in zip(slopes, room_above, strict=True)]
    return lower + upper


def _by_quadratic_program(
    balance: _Balance, target: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    import daqp

    z, _, exit_flag, _ = daqp.solve(
        np.eye(len(target)),
        -target,
        np.ascontiguousarray(balance.null_basis),
        balance.high - balance.particular,
        balance.low - balance.particular,
        primal_tol=1e-11,
    )
    if exit_flag == -1:
        return None
    if exit_flag != 1:
        raise Fault(f"the quadratic program for the tensions ended with code {exit_flag}")
    return np.asarray(z, dtype=np.float64)


def _raise_unless_round_off(
    matrix: NDArray[np.float64],
    wrench: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    round_off: float,
) -> None:
    """Raise `TensionInfeasible` with the exact shortfall, unless that is round-off.

    Limits that all give way by s move a facet plane with gains y outward by s times the sum of
    |y|, and leave its direction; so the largest ratio over all facets is the shortfall.
    """
    facets = wrench_facets(matrix, low, high, 1.0)
    along = facets.normals @ -wrench
    stiffness = np.maximum(np.abs(facets.cable_gains).sum(axis=-1), np.finfo(np.float64).tiny)
    excess = np.stack([along - facets.upper, facets.lower - along]) / stiffness
    side, facet = np.unravel_index(int(np.argmax(excess)), excess.shape)
    shortfall = float(excess[side, facet])
    if shortfall <= round_off:
        return
    gains = facets.cable_gains[facet] * (1.0 if side == 0 else -1.0)
    counted = DEPENDENT_COLUMNS**0.5 * np.abs(gains).max()
    raise TensionInfeasible(
        shortfall,
        at_largest=tuple(int(i) for i in np.flatnonzero(gains > counted)),
        at_smallest=tuple(int(i) for i in np.flatnonzero(gains < -counted)),
    )
