"""What a search is told: sampler, cost, mode, seed and sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cdpr.errors import BadInput
from planner.paper.readings import TEXT, Readings

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
    readings: Readings = TEXT

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
