"""What a search makes small: a weighted sum of length, kinematic cost, clearance and margin."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from cdpr.errors import BadInput

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

    @property
    def is_length(self) -> bool:
        """Whether nothing but the length counts."""
        return self.kinematic + self.clearance + self.capacity == 0.0


OBJECTIVES = {
    "length": Weights(length=1.0),
    "kinematic": Weights(kinematic=1.0),
    "clearance": Weights(clearance=1.0, length=_TIE),
    "capacity": Weights(capacity=1e-3, length=_TIE),
}
"""What the objectives that have a name make small."""
