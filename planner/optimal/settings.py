"""What the search is told: the objective, the seed and how long it may go on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

from cdpr.errors import BadInput
from planner.anytime import AnytimeSettings

_TIE = 0.02
"""Cost of a metre beside an objective that leaves most of the path open: 1 mm of clearance is worth
50 mm of way, and 1 N of margin as much."""


@dataclass(frozen=True, slots=True)
class Weights:
    """What is made small: a weighted sum, of which the last two are made large.

    Attributes:
        length: Of the length, [m].
        kinematic: Of the line integral of c = γ_d + γ_f, [m].
        clearance: Of the smallest distance to an obstacle, [m].
        capacity: Of the smallest capacity margin, [N].
    """

    length: float = 0.0
    kinematic: float = 0.0
    clearance: float = 0.0
    capacity: float = 0.0

    def __post_init__(self) -> None:
        """Refuses weights that leave nothing to make small.

        Raises:
            BadInput: A weight is negative or not finite, or neither the length nor the kinematic
                cost has one.
        """
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not 0.0 <= value < math.inf:
                raise BadInput(
                    f"the weight of {entry.name} must be 0 or more, it is {value:g}",
                    next_step="leave it out, or give it a finite number",
                )
        if self.length + self.kinematic == 0.0:
            raise BadInput(
                "without a weight of length or kinematic a path would have no reason to end",
                next_step="give length a small weight too, such as length=0.02",
            )


OBJECTIVES = {
    "length": Weights(length=1.0),
    "kinematic": Weights(kinematic=1.0),
    "clearance": Weights(clearance=1.0, length=_TIE),
    "capacity": Weights(capacity=1e-3, length=_TIE),
}
"""What the objectives that have a name make small."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimalSettings(AnytimeSettings):
    """Settings of the search.

    Attributes:
        weights: What is made small.
        longest: Longest path allowed, [m]; infinite for any.
    """

    weights: Weights = field(default_factory=lambda: OBJECTIVES["length"])
    longest: float = math.inf

    def __post_init__(self) -> None:
        """Refuses what no search could use.

        Raises:
            BadInput: The seed is negative, or a limit is not positive.
        """
        AnytimeSettings.__post_init__(self)  # super() knows no class that was made with slots
        if not self.longest > 0.0:
            raise BadInput(f"the longest path must be above 0 mm, not {self.longest * 1e3:g} mm")
