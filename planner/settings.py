"""Settings of a search: sampler, cost, mode, seed and sizes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Literal

from model.errors import BadInput, NoSolution
from planner.path import Progress
from planner.rrt.variants import TEXT, AlgorithmVariant

SamplerName = Literal["adaptive", "goal-bias"]
CostName = Literal["kinematic", "length"]
Mode = Literal["paper", "rewire"]

CLEARANCE_RESERVE = 0.05e-3
"""Added to every clearance the scene asks for, [m], so that round-off in a plan's file (1 nm) and
between the planner's distances and those of `check` can never turn a plan into a refused one."""

ATTEMPT_WITH_ROOM = 0.25
"""Part of the iterations after which the rewiring mode no longer insists on room for the blends."""

MARGIN_RESERVE = 0.002
"""Part of the largest tension by which required wrenches must lie inside the available ones."""

IMPROVING_ITERATIONS = 500
"""How long the rewiring mode goes on after its first path. Source: measured on the paper's scenes;
after as many more the paths were 1 % cheaper, as post-processing does the rest."""


@dataclass(frozen=True, slots=True)
class PlannerSettings:
    """Settings of the search; the sizes are the paper's (Table 2), SI.

    Attributes:
        sampler: "adaptive" (paper, section 4.2) or "goal-bias" (the goal with probability 0.5).
        cost: "kinematic" (integral of γ_d + γ_f along the path) or "length".
        mode: "paper" stops at the first path and never rewires (Algorithm 1); "rewire" is RRT*.
        seed: Of the random generator.
        step: Length η of an edge, [m].
        neighbour_radius: r_c, [m].
        goal_radius: r_g, from which the goal itself is tried, [m].
        max_iterations: After which the search gives up.
        readings: Of the text where it is open.
    """

    sampler: SamplerName = "adaptive"
    cost: CostName = "kinematic"
    mode: Mode = "rewire"
    seed: int = 0
    step: float = 0.040
    neighbour_radius: float = 0.080
    goal_radius: float = 0.050
    max_iterations: int = 20000
    readings: AlgorithmVariant = TEXT

    def __post_init__(self) -> None:
        """Refuses what no search could use.

        Raises:
            BadInput: A name is unknown or a size is not positive.
        """
        known = {
            "sampler": ("adaptive", "goal-bias"),
            "cost": ("kinematic", "length"),
            "mode": ("paper", "rewire"),
        }
        for name, choices in known.items():
            if getattr(self, name) not in choices:
                what = f"unknown {name} {getattr(self, name)!r}"
                raise BadInput(what, next_step=f"use one of: {', '.join(choices)}")
        for name in ("step", "neighbour_radius", "goal_radius", "max_iterations"):
            if not 0 < getattr(self, name) < float("inf"):
                raise BadInput(f"{name} must be above 0, it is {getattr(self, name)}")
        if self.seed < 0:
            raise BadInput(f"the seed must not be negative, it is {self.seed}")


# What a search makes small: a weighted sum of length, kinematic cost, clearance and margin.


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
                "without a weight of length or kinematic the path length is unbounded",
                next_step="give length a small weight as well, such as length=0.02",
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


# Searches that go on improving: what they are to make small, and how long they may go on.


LEAST_ROUNDS = 12
"""Done whatever the clock says, so that a busy machine finds a path, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnytimeSettings:
    """Settings of every search in rounds.

    Attributes:
        weights: What is made small.
        longest: Longest path allowed, [m]; infinite for any.
        seed: Of the random numbers.
        budget: How long paths are sought and improved, [s]; what is prepared before is not in it.
        rounds: Instead of the budget, for reproducible paths: the exact number of rounds.
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
        """Whether a search may end after these rounds and seconds; ``least`` for the clock."""
        if self.rounds is not None:
            return rounds >= self.rounds
        return rounds >= least and spent >= self.budget

    def tell(self, progress: Progress, rounds: int, spent: float, cost: float) -> None:
        """Progress of a search, in rounds where their number is given, else in seconds."""
        if self.rounds is not None:
            progress(float(rounds), float(self.rounds), cost)
        else:
            progress(min(spent, self.budget), self.budget, cost)

    @property
    def longer(self) -> str:
        """What a user does for a longer search."""
        return "raise --budget-ms" if self.rounds is None else "raise --rounds"

    def not_found(self, rounds: int, gap: float) -> str:
        """Message after a number of rounds without a path; ``gap`` between the trees, [m]."""
        of_budget = f" of the {self.budget * 1e3:g} ms budget" if self.rounds is None else ""
        return (
            f"no path after {rounds} rounds{of_budget}; the trees from start and goal come within"
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
            why=f"the path found has {length:.1f} mm, the straight line {straight * 1e3:.1f} mm",
            next_step=f"allow a longer path, or {self.longer}; `--cost length` without a limit"
            " shows how short paths can be",
            values={**values, "longest_mm": limit, "found_mm": length},
        )


# Settings of the search that keeps the orientation of the start.


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimalSettings(AnytimeSettings):
    """Settings of the search that keeps the orientation of the start."""


# Settings of the search that may rotate the platform.


@dataclass(frozen=True, slots=True, kw_only=True)
class TurningSettings(AnytimeSettings):
    """Settings of the search that may turn the platform; its moves take longer to decide."""

    budget: float = 0.500
