"""Searches that go on improving: what they are to make small, and how long they may go on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from cdpr.errors import BadInput, NoSolution
from planner.route import Progress
from planner.weights import OBJECTIVES, Weights

LEAST_ROUNDS = 12
"""Done whatever the clock says, so that a busy machine finds a path, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnytimeSettings:
    """What every search in rounds is told.

    Attributes:
        weights: What is made small.
        longest: Longest path allowed, [m]; infinite for any.
        seed: Of the random numbers.
        budget: How long paths are sought and improved, [s]; what is prepared before is not in it.
        rounds: Instead of the budget, for the same path again: exactly so many rounds.
    """

    weights: Weights = field(default_factory=lambda: OBJECTIVES["length"])
    longest: float = math.inf
    seed: int = 0
    budget: float = 0.050
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
        if not self.longest > 0.0:
            raise BadInput(f"the longest path must be above 0 mm, not {self.longest * 1e3:g} mm")

    def is_over(self, rounds: int, spent: float, least: int = LEAST_ROUNDS) -> bool:
        """Whether a search may end after so many rounds and seconds; ``least`` for the clock."""
        if self.rounds is not None:
            return rounds >= self.rounds
        return rounds >= least and spent >= self.budget

    def tell(self, progress: Progress, rounds: int, spent: float, cost: float) -> None:
        """Tells how far a search is, in rounds where their number is given, else in seconds."""
        if self.rounds is not None:
            progress(float(rounds), float(self.rounds), cost)
        else:
            progress(min(spent, self.budget), self.budget, cost)

    @property
    def longer(self) -> str:
        """What a user does for a longer search."""
        return "raise --budget-ms" if self.rounds is None else "raise --rounds"

    def not_found(self, rounds: int, gap: float) -> str:
        """What is told after so many rounds without a path; ``gap`` between the trees, [m]."""
        of_budget = f" of the {self.budget * 1e3:g} ms budget" if self.rounds is None else ""
        return (
            f"no path after {rounds} rounds{of_budget}; what start and goal reach comes within"
            f" {gap * 1e3:.1f} mm of each other"
        )

    def too_long(
        self, where: str, found: float, straight: float, values: dict[str, float | str]
    ) -> NoSolution:
        """The error where no path is short enough; the best path's length and the least, [m]."""
        limit, length = self.longest * 1e3, found * 1e3
        return NoSolution(
            f"no path of at most {limit:.1f} mm was found",
            where=where,
            why=f"the path found has {length:.1f} mm, and the straight way {straight * 1e3:.1f} mm",
            next_step=f"allow a longer path, or {self.longer}; `--cost length` without a limit"
            " tells how short paths can be",
            values={**values, "longest_mm": limit, "found_mm": length},
        )
