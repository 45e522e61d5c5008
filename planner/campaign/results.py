"""All trials of a campaign, by study, case and arm."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cdpr.poses import Array
from planner.campaign.statistics import Change, change_of_deviations, change_of_means
from planner.campaign.trial import Arm, Case, Ends, Trial

COUNTED = ("nodes", "searches", "edge_checks", "time_ms")
MEASURED = ("raw_length_mm", "length_mm", "raw_cost", "cost", "clearance_mm")


class Results:
    """What was found.

    Attributes:
        trials: All of them.
        environments: Their names, in the order of the campaign.
    """

    def __init__(self, trials: Iterable[Trial]) -> None:
        """Sorts the trials."""
        self.trials = tuple(trials)
        self._groups: dict[tuple[str, Case, Arm], list[Trial]] = {}
        for trial in self.trials:
            self._groups.setdefault((trial.study, trial.case, trial.arm), []).append(trial)
        self.environments = tuple(dict.fromkeys(trial.case.environment for trial in self.trials))

    def groups(self) -> Iterable[tuple[tuple[str, Case, Arm], list[Trial]]]:
        """Trials of one arm in one case of one study, in the order of the campaign."""
        return self._groups.items()

    def values(self, study: str, case: Case, arm: Arm, quantity: str) -> Array:
        """One quantity of the searches that found a path, shape (k,)."""
        found = [t for t in self._groups[study, case, arm] if t.found]
        return np.array([t.value(quantity) for t in found], dtype=np.float64)

    def lost(self, study: str) -> int:
        """How many searches of a study found no path."""
        return sum(t.study == study and not t.found for t in self.trials)

    def change(
        self, study: str, box: str, ends: Ends, arms: tuple[Arm, Arm], quantity: str
    ) -> tuple[Change, Change]:
        """From the second arm to the first: change of the mean and of the standard deviation.

        Only seeds with which both found a path count.
        """
        pairs = []
        for environment in self.environments:
            case = Case(box, environment, ends)
            one, other = (self._groups[study, case, arm] for arm in arms)
            both = [(a, b) for a, b in zip(one, other, strict=True) if a.found and b.found]
            values = [[t.value(quantity) for t in pair] for pair in both]
            columns = np.array(values).T
            pairs.append((columns[0], columns[1]))
        return change_of_means(pairs), change_of_deviations(pairs)
