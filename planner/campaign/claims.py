"""What the paper claims of Fig. 9, beside what was found."""

from __future__ import annotations

from dataclasses import dataclass

from planner.campaign.cases import OWN, WIDE
from planner.campaign.results import Change, Results
from planner.campaign.studies import (
    BOTH_REJECT,
    ENDS,
    FIGURE_9,
    NEAREST_TO_THE_CLAIM,
    VARIANTS,
    arms_of,
    figure_9_arm,
)
from planner.campaign.trial import Ends

NODES, NODES_DEVIATION = -0.205, 0.0
COST, COST_DEVIATION = -0.182, 0.0

PLACES: tuple[tuple[str, Ends], ...] = tuple((box, ends) for box in (OWN, WIDE) for ends in ENDS)


@dataclass(frozen=True, slots=True)
class Finding:
    """One claim in one box with one kind of ends.

    Attributes:
        claim: In the paper's words, shortened.
        claimed: Change that it claims, as a part; 0 where only "smaller" is claimed.
        box: Where it was looked at.
        ends: From where to where.
        change: What was found.
    """

    claim: str
    claimed: float
    box: str
    ends: Ends
    change: Change

    @property
    def verdict(self) -> str:
        """Whether the claim holds here, in words."""
        change = self.change
        if change.high < self.claimed:
            return "reached"
        if self.claimed and change.mean <= self.claimed:
            return "reached on average"
        if change.low <= self.claimed:
            return "not reached, but within the interval" if self.claimed else "no difference seen"
        if change.high < 0.0:
            return "smaller, but by less than claimed"
        return "no difference seen" if change.low <= 0.0 else "the opposite"


#: Who rejects new nodes within 30 mm of another: the claim depends on it.
_REJECTING = (
    ("adaptive alone rejects near nodes", NEAREST_TO_THE_CLAIM),
    ("both reject them", BOTH_REJECT),
)


def findings(results: Results) -> tuple[Finding, ...]:
    """Every claim in every box with every kind of ends."""
    found = []
    costs = figure_9_arm("adaptive", "kinematic"), figure_9_arm("adaptive", "length")
    for box, ends in PLACES:
        for name, comparison in _REJECTING:
            mean, deviation = results.change(VARIANTS, box, ends, arms_of(comparison), "nodes")
            found.append(Finding(f"20.5 % fewer nodes, {name}", NODES, box, ends, mean))
            claim = f"smaller deviation of the nodes, {name}"
            found.append(Finding(claim, NODES_DEVIATION, box, ends, deviation))
        for name, quantity in (("the tree's path", "raw_cost"), ("the finished path", "cost")):
            mean, deviation = results.change(FIGURE_9, box, ends, costs, quantity)
            claim = f"18.2 % better kinematic cost, {name}"
            found.append(Finding(claim, COST, box, ends, mean))
            claim = f"smaller deviation of the kinematic cost, {name}"
            found.append(Finding(claim, COST_DEVIATION, box, ends, deviation))
    return tuple(found)
