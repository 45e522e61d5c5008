"""What the search of poses is told: the seed and how long it may go on."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cdpr.errors import BadInput


@dataclass(frozen=True, slots=True)
class TurningSettings:
    """Settings of the search.

    Attributes:
        seed: Of the random numbers.
        budget: How long paths are sought and improved, [s]; what is prepared before is not in it.
        rounds: Instead of the budget, for the same path again: exactly so many rounds.
    """

    seed: int = 0
    budget: float = 0.500
    rounds: int | None = None

    def __post_init__(self) -> None:
        """Refuses what no search could use.

        Raises:
            BadInput: The seed is negative, or a limit is not positive.
        """
        if self.seed < 0:
            raise BadInput(f"the seed must not be negative, it is {self.seed}")
        if not 0.0 < self.budget < math.inf:
            raise BadInput(f"the budget must be above 0 ms, it is {self.budget * 1e3:g} ms")
        if self.rounds is not None and self.rounds < 1:
            raise BadInput(f"there must be at least one round, not {self.rounds}")
