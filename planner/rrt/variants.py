"""Choices that the paper leaves open, by name (docs/paper.md gives the arguments for each)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from model.errors import BadInput

FailureRate = Literal["k/(k+1)", "k/(k+2)", "tree", "node"]
Focus = Literal["last-failed", "most-failed", "highest-rate"]
ConeDraw = Literal["radius", "volume"]
Steer = Literal["full-step", "to-sample"]

FAILURE_RATES: tuple[FailureRate, ...] = get_args(FailureRate)
FOCUSES: tuple[Focus, ...] = get_args(Focus)
CONE_DRAWS: tuple[ConeDraw, ...] = get_args(ConeDraw)
STEERS: tuple[Steer, ...] = get_args(Steer)


@dataclass(frozen=True, slots=True)
class AlgorithmVariant:
    """One reading of section 4, and two additions that are not in the text.

    Attributes:
        failure_rate: The rate e_r, the probability of sampling backward. With k the failed
            expansions since the last success: "k/(k+1)" or "k/(k+2)"; failures over searches of
            the whole "tree"; or of the "node" that was expanded last.
        focus: The node x_c: the "last-failed" one, the "most-failed" one, or the one with the
            "highest-rate" of failures to searches (of equals the latest with the most failures).
        cone_draw: Points of the forward cone: "radius", r and θ₁ uniform in their ranges (Eq. 10
            as written), or uniform in "volume".
        steer: Whether a new node is always a "full-step" away, past the sample if that is nearer
            (Eq. 9 as written), or at most as far as "to-sample", as RRT* has it; the rewiring mode
            always does the latter. It applies to the goal bias too.
        spacing: New nodes nearer than this to a node are rejected and count as failures, [m];
            0 rejects none. Not in the text; it applies to the goal bias too.
        goal_sight: Whether every new node tries the straight edge to the goal. Not in the text; it
            applies to the goal bias too.
    """

    failure_rate: FailureRate = "k/(k+1)"
    focus: Focus = "last-failed"
    cone_draw: ConeDraw = "radius"
    steer: Steer = "full-step"
    spacing: float = 0.0
    goal_sight: bool = False

    def __post_init__(self) -> None:
        """Refuses unknown names.

        Raises:
            BadInput: A name is unknown or the spacing is negative or not finite.
        """
        known: dict[str, tuple[str, ...]] = {
            "failure_rate": FAILURE_RATES,
            "focus": FOCUSES,
            "cone_draw": CONE_DRAWS,
            "steer": STEERS,
        }
        for name, choices in known.items():
            if getattr(self, name) not in choices:
                what = f"unknown {name} {getattr(self, name)!r}"
                raise BadInput(what, next_step=f"use one of: {', '.join(choices)}")
        if not 0.0 <= self.spacing < float("inf"):
            raise BadInput(f"the spacing must be 0 mm or more, it is {self.spacing * 1000.0:g} mm")


DEFAULT = AlgorithmVariant()
"""Equations as written; e_r and x_c by measurement, as the text has several readings of both."""
