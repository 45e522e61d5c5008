"""The answer to a tension problem, and the answer that there is none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from cdpr.errors import Refused

TensionMethod = Literal["least_norm", "centroid", "barycentre"]


@dataclass(frozen=True, slots=True, eq=False)
class TensionSolution:
    """Tensions that balance a wrench within limits; the arrays are read-only.

    Attributes:
        tensions: shape (m,), [N].
        method: How they were chosen among all that balance the wrench.
        structure_matrix: shape (6, m); force rows [-], moment rows [m].
        external_wrench: shape (6,), [N, N·m], gravity among it.
        t_min: shape (m,), [N].
        t_max: shape (m,), [N].
    """

    tensions: NDArray[np.float64]
    method: TensionMethod
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
        """What is left unbalanced, shape (6,), [N, N·m]; computed anew from the tensions."""
        return np.asarray(self.structure_matrix @ self.tensions + self.external_wrench)

    @property
    def bound_violation(self) -> float:
        """How far the worst tension is outside its limits [N]; zero when all are inside."""
        below = (self.t_min - self.tensions).max()
        above = (self.tensions - self.t_max).max()
        return max(0.0, float(below), float(above))


class TensionInfeasible(Refused):
    """No tensions within the limits balance the wrench.

    Args:
        shortfall: By how much every limit would have to give way [N]; infinity where the cables
            do not act in every direction.
        at_largest: Cables (counted from 0) that would have to pull harder than they may.
        at_smallest: Cables (counted from 0) that would have to pull less than they must.
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
                why="the structure matrix has no full rank: the pose is singular",
                next_step="choose another pose or orientation",
                values={"shortfall_n": shortfall},
            )
            return
        super().__init__(
            f"no tensions within the limits balance the wrench: every limit would have to give"
            f" way by {shortfall:.4g} N",
            why=_blame(at_largest, at_smallest),
            next_step="lower the load, widen the tension limits, or choose a pose farther inside"
            " the workspace",
            values={"shortfall_n": shortfall},
        )


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
