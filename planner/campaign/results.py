"""All trials of a campaign, by study, case and arm."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.pose import Array
from planner.campaign.studies import (
    BOTH_REJECT,
    ENDS,
    FIGURE_9,
    NEAREST_TO_THE_CLAIM,
    VARIANTS,
    arms_of,
    figure_9_arm,
)
from planner.campaign.trial import OWN, WIDE, Arm, Case, Ends, Trial

# Means, deviations and bootstrap intervals of campaigns.


_RESAMPLES = 2000
_SEED = 20230516
_LEVELS = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Summary:
    """A sample in figures.

    Attributes:
        count: Its size.
        mean: Its mean.
        deviation: Its standard deviation.
        low: Lower end of the 95 % bootstrap interval of the mean.
        high: Its upper end.
    """

    count: int
    mean: float
    deviation: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Change:
    """How a figure of one planner differs from another's, as a part of the other's.

    Attributes:
        each: In every environment.
        mean: Over the environments.
        low: Lower end of the 95 % bootstrap interval of `mean`.
        high: Its upper end.
    """

    each: tuple[float, ...]
    mean: float
    low: float
    high: float


def summary(values: Array) -> Summary:
    """Figures of a sample, shape (k,), k ≥ 1."""
    means = values[_resampled(len(values))].mean(axis=1)
    low, high = (float(x) for x in np.percentile(means, _LEVELS))
    deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return Summary(len(values), float(values.mean()), deviation, low, high)


def change_of_means(pairs: Sequence[tuple[Array, Array]]) -> Change:
    """Change of the mean from the second sample of each pair to the first.

    Args:
        pairs: One of each environment; the samples of a pair have the same seeds in the same order,
            shape (k,) each, and are resampled together, as random ends tie them to each other.
    """
    return _change(pairs, _mean)


def change_of_deviations(pairs: Sequence[tuple[Array, Array]]) -> Change:
    """Change of the standard deviation; see `change_of_means`."""
    return _change(pairs, _deviation)


def _change(pairs: Sequence[tuple[Array, Array]], figure: Callable[[Array], Array]) -> Change:
    each = [float(figure(one[None])[0] / figure(other[None])[0] - 1.0) for one, other in pairs]
    resampled = np.zeros(_RESAMPLES)
    for k, (one, other) in enumerate(pairs):
        rows = _resampled(len(one), k)
        resampled += figure(one[rows]) / figure(other[rows]) - 1.0
    low, high = (float(x) for x in np.percentile(resampled / len(pairs), _LEVELS))
    return Change(tuple(each), float(np.mean(each)), low, high)


def _mean(samples: Array) -> Array:
    means: Array = samples.mean(axis=1)
    return means


def _deviation(samples: Array) -> Array:
    if samples.shape[1] < 2:
        return np.full(len(samples), np.nan)
    deviations: Array = np.maximum(samples.std(axis=1, ddof=1), 1e-300)
    return deviations


def _resampled(size: int, stream: int = 0) -> NDArray[np.int64]:
    """Rows to draw with replacement, shape (resamples, size)."""
    random = np.random.default_rng([_SEED, stream])
    return random.integers(size, size=(_RESAMPLES, size))


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


# What the paper claims of Fig. 9, beside what was found.


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
