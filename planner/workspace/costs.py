"""The paper's indices as costs: each scaled to 0..1 between its extremes over the workspace box.

Source: Xu & Park, Eqs. 4, 5 and 8 and Fig. 7; see docs/paper.md for the corrections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cdpr.poses import Array
from planner.lattice import Lattice
from planner.workspace.maps import Question, Values, values_at

INDICES = ("condition_number", "force_volume")


@dataclass(frozen=True, slots=True)
class Extremes:
    """Smallest and largest condition number and inverse volume over the workspace box."""

    condition: tuple[float, float]
    inverse_volume: tuple[float, float]

    @classmethod
    def over_workspace(cls, question: Question) -> Extremes:
        """Those on the planner's lattice, so that maps and plans mean the same cost."""
        rig = question.rig
        lattice = Lattice.over(rig.workspace_lower, rig.workspace_upper)
        points = lattice.points(np.arange(lattice.count))
        values = values_at(replace(question, quantities=INDICES), points)
        condition, inverse = values["condition_number"], 1.0 / values["force_volume"]
        return cls(
            (float(np.nanmin(condition)), float(np.nanmax(condition))),
            (float(np.nanmin(inverse)), float(np.nanmax(inverse))),
        )


def costs(values: Values, extremes: Extremes) -> Values:
    """Dexterity cost γ_d, wrench cost γ_f and their sum, shapes as given, from the two indices."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / values["force_volume"]
    dexterity = _scaled(values["condition_number"], *extremes.condition)
    wrench = _scaled(inverse, *extremes.inverse_volume)
    return {"dexterity_cost": dexterity, "wrench_cost": wrench, "cost": dexterity + wrench}


def _scaled(values: Array, low: float, high: float) -> Array:
    if not low < high:
        return np.zeros_like(values)
    scaled: Array = (values - low) / (high - low)
    return scaled
