"""Tension distribution: the tensions to command, out of all that balance a wrench.

All tensions that balance a wrench are ``particular + null_basis @ z``. With as many cables as
degrees of freedom there is one; with one cable more, z is in an interval; with two more, in a
convex polygon that is computed exactly. Beyond that, a quadratic program finds the tensions nearest
to a reference. They are continuous in the pose and the wrench as long as the feasible set has an
interior.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import hypot
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput, Fault, Refused
from model.statics.wrench_sets import (
    DEPENDENT_COLUMNS,
    RANK_TOLERANCE,
    WRENCH_SIZE,
    cables_at_limits,
    checked_limits,
    checked_per_cable,
    checked_structure_matrix,
    checked_wrench,
    wrench_facets,
)

# The solution of a tension problem, and the error where there is none.


@dataclass(frozen=True, slots=True, eq=False)
class TensionSolution:
    """Tensions that balance a wrench within limits; the arrays are read-only.

    Attributes:
        tensions: shape (m,), [N].
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        external_wrench: shape (6,), [N, N·m], gravity included.
        t_min: shape (m,), [N].
        t_max: shape (m,), [N].
    """

    tensions: NDArray[np.float64]
    structure_matrix: NDArray[np.float64]
    external_wrench: NDArray[np.float64]
    t_min: NDArray[np.float64]
    t_max: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        for array in (
            self.tensions,
            self.structure_matrix,
            self.external_wrench,
            self.t_min,
            self.t_max,
        ):
            array.flags.writeable = False

    @property
    def wrench_residual(self) -> NDArray[np.float64]:
        """The unbalanced wrench, shape (6,), [N, N·m]; recomputed from the tensions."""
        return np.asarray(self.structure_matrix @ self.tensions + self.external_wrench)

    @property
    def bound_violation(self) -> float:
        """Distance of the worst tension outside its limits [N]; zero when all are inside."""
        below = (self.t_min - self.tensions).max()
        above = (self.tensions - self.t_max).max()
        return max(0.0, float(below), float(above))


class TensionInfeasible(Refused):
    """No tensions within the limits balance the wrench.

    Args:
        shortfall: Amount by which every limit would have to be relaxed [N]; infinity where the
            cables do not act in every direction.
        at_largest: Cables (counted from 0) at their largest tension.
        at_smallest: Cables (counted from 0) at their smallest tension.
    """

    code: ClassVar[str] = "tension_infeasible"

    def __init__(
        self, shortfall: float, at_largest: tuple[int, ...] = (), at_smallest: tuple[int, ...] = ()
    ) -> None:
        self.shortfall = shortfall
        self.at_largest = at_largest
        self.at_smallest = at_smallest
        if np.isinf(shortfall):
            super().__init__(
                "the cables do not act in every direction at this pose",
                why="the structure matrix is rank-deficient: the pose is singular",
                next_step="choose another pose or orientation",
                values={"shortfall_n": shortfall},
            )
            return
        super().__init__(
            f"no tensions within the limits balance the wrench: every limit would have to"
            f" be relaxed by {shortfall:.4g} N",
            why=_blame(at_largest, at_smallest),
            next_step=f"{remedy(at_largest, at_smallest)}, or choose a pose farther inside the"
            " workspace",
            values={"shortfall_n": shortfall},
        )


def remedy(at_largest: tuple[int, ...], at_smallest: tuple[int, ...]) -> str:
    """What to change where these cables' limits keep tensions from balancing a wrench."""
    if not at_largest:  # such as those of a light platform below all its outlets
        return "lower the smallest tensions, add weight"
    if not at_smallest:
        return "lower the load, raise the largest tensions"
    return "lower the load, widen the tension limits"


def _blame(at_largest: tuple[int, ...], at_smallest: tuple[int, ...]) -> str:
    parts = [
        f"cable{'s' if len(cables) > 1 else ''} {', '.join(str(i + 1) for i in cables)} {cannot}"
        for cables, cannot in (
            (at_largest, "cannot pull harder than t_max"),
            (at_smallest, "cannot pull less than t_min"),
        )
        if cables
    ]
    return " while ".join(parts)


# The feasible tensions of a robot with two redundant cables: a convex polygon.
#
# Plain floats, not arrays: with at most two lines per cable the polygon has few corners, and an
# array operation costs more than clipping with one line.


Point = tuple[float, float]
HalfPlane = tuple[float, float, float]
"""(a, b, c) for the side ``a x + b y + c >= 0``."""


def square(reach: float) -> list[Point]:
    """Return the square |x|, |y| <= reach, counter-clockwise."""
    return [(-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)]


def clipped(polygon: list[Point], half_planes: Iterable[HalfPlane]) -> list[Point]:
    """Return the part of a convex polygon inside every half-plane; empty if there is none."""
    for a, b, c in half_planes:
        sides = [a * x + b * y + c for x, y in polygon]
        if min(sides) >= 0.0:
            continue
        if max(sides) < 0.0:
            return []
        polygon = _cut(polygon, sides)
    return polygon


def _cut(polygon: list[Point], sides: list[float]) -> list[Point]:
    kept: list[Point] = []
    x0, y0 = polygon[-1]
    side0 = sides[-1]
    for (x1, y1), side1 in zip(polygon, sides, strict=True):
        if (side0 < 0.0) != (side1 < 0.0) and side0 != 0.0 and side1 != 0.0:
            part = side0 / (side0 - side1)
            kept.append((x0 + part * (x1 - x0), y0 + part * (y1 - y0)))
        if side1 >= 0.0:
            kept.append((x1, y1))
        x0, y0, side0 = x1, y1, side1
    return kept


def nearest_on_boundary(polygon: list[Point], target: Point) -> Point:
    """Return the point on the edges of the polygon nearest to the target."""
    x, y = target
    best, best_distance = polygon[0], _distance(polygon[0], target)
    x0, y0 = polygon[-1]
    for x1, y1 in polygon:
        ux, uy = x1 - x0, y1 - y0
        squared_length = ux * ux + uy * uy
        part = ((x - x0) * ux + (y - y0) * uy) / squared_length if squared_length else 0.0
        part = min(1.0, max(0.0, part))
        point = (x0 + part * ux, y0 + part * uy)
        distance = _distance(point, target)
        if distance < best_distance:
            best, best_distance = point, distance
        x0, y0 = x1, y1
    return best


def _distance(p: Point, q: Point) -> float:
    return hypot(p[0] - q[0], p[1] - q[1])


ROUND_OFF = 1e-10
"""Tolerance of the limits, as part of the largest, before a wrench counts as infeasible."""


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
    reference: ArrayLike = 0.0,
) -> TensionSolution:
    """Return tensions within the limits with ``structure_matrix @ tensions + external_wrench = 0``.

    Args:
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        external_wrench: shape (6,), [N, N·m], world frame, gravity included.
        t_min: Smallest tensions, shape (m,), or one number, [N].
        t_max: Largest tensions, shape (m,), or one number, [N].
        reference: The tensions are the nearest to these, shape (m,), or one number, [N].

    Raises:
        TensionInfeasible: No such tensions exist; with the shortfall.
        BadInput: A shape is wrong, a value is not finite, or limits are crossed.
    """
    matrix = checked_structure_matrix(structure_matrix)
    wrench = checked_wrench(external_wrench, "external wrench")
    if matrix.ndim != 2 or wrench.ndim != 1:
        raise BadInput("solve_tensions accepts one pose and one wrench")
    low, high = checked_limits(t_min, t_max, matrix.shape[1])
    wanted = checked_per_cable(reference, matrix.shape[1], "reference")
    balance = _balance(matrix, wrench, low, high)
    z = _choice(balance, wanted)
    if z is None:
        round_off = ROUND_OFF * max(float(np.abs(low).max()), float(np.abs(high).max()))
        _raise_unless_round_off(matrix, wrench, low, high, round_off)
        z = _choice(balance.relaxed(2.0 * round_off), wanted)
        if z is None:
            raise Fault("two methods disagree on whether tensions exist that balance the wrench")
    # This clips only round-off; wrench_residual shows its effect.
    tensions = np.minimum(np.maximum(balance.tensions(z), low), high)
    return TensionSolution(tensions, matrix.copy(), wrench.copy(), low.copy(), high.copy())


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


def _choice(balance: _Balance, wanted: NDArray[np.float64]) -> ArrayLike | None:
    """Return the chosen null-space coordinates, shape (m - 6,), or None when there are none."""
    freedom = balance.null_basis.shape[1]
    if freedom == 0:
        return np.zeros(0) if balance.holds(np.zeros(0)) else None
    target = wanted @ balance.null_basis
    if balance.holds(target):
        return target
    if freedom == 1:
        return _in_interval(balance, float(target[0]))
    if freedom == 2:
        return _in_polygon(balance, target)
    return _by_quadratic_program(balance, target)


def _in_interval(balance: _Balance, target: float) -> ArrayLike | None:
    slopes = balance.null_basis[:, 0]
    tight = np.abs(slopes) <= DEPENDENT_COLUMNS
    below, above = balance.low - balance.particular, balance.high - balance.particular
    if (below[tight] > 0.0).any() or (above[tight] < 0.0).any():
        return None
    ends = np.sort(np.stack([below[~tight], above[~tight]]) / slopes[~tight], axis=0)
    start, end = float(ends[0].max()), float(ends[1].min())
    if start > end:
        return None
    return [min(max(target, start), end)]


def _in_polygon(balance: _Balance, target: NDArray[np.float64]) -> ArrayLike | None:
    polygon = clipped(square(_reach(balance)), _half_planes(balance))
    if not polygon:
        return None
    return nearest_on_boundary(polygon, (float(target[0]), float(target[1])))


def _reach(balance: _Balance) -> float:
    """Return a bound of ‖z‖, which is at most ‖tensions‖ for an orthonormal null basis."""
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

    Relaxing all limits by s moves a facet plane with gains y outward by s times the sum of |y| and
    keeps its direction; so the largest ratio over all facets is the shortfall.
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
    raise TensionInfeasible(shortfall, *cables_at_limits(gains))
