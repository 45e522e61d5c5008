"""What the campaign compares (planners, boxes, starts and goals), and its findings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from model.pose import Array
from model.rig import Rig
from model.scene import Scene
from planner.campaign.trial import OWN, SHARES, WIDE, Arm, Batch, Case, Ends, Trial, run_batch
from planner.rrt.variants import (
    CONE_DRAWS,
    DEFAULT,
    FAILURE_RATES,
    FOCUSES,
    STEERS,
    AlgorithmVariant,
)
from planner.settings import CostName, SamplerName

FIGURE_9, VARIANTS, READINGS, BOXES = "figure 9", "variants", "readings", "boxes"
STUDIES = (FIGURE_9, VARIANTS, READINGS, BOXES)

SPACING = 0.030
ENDS: tuple[Ends, ...] = ("scene", "random")
SAMPLERS: tuple[SamplerName, ...] = ("adaptive", "goal-bias")
COSTS: tuple[CostName, ...] = ("kinematic", "length")

TO_SAMPLE = AlgorithmVariant(steer="to-sample")
SPACED = replace(TO_SAMPLE, spacing=SPACING)
SIGHT = replace(TO_SAMPLE, goal_sight=True)

_SEEDS_IN_A_BATCH = 25


@dataclass(frozen=True, slots=True)
class StudyComparison:
    """Adaptive sampling with one reading against the goal bias with another.

    Attributes:
        name: In words.
        adaptive: Readings of the adaptive planner.
        baseline: Readings of the goal bias; only those that apply to it matter.
    """

    name: str
    adaptive: AlgorithmVariant
    baseline: AlgorithmVariant


COMPARISONS = (
    StudyComparison("the default readings", DEFAULT, DEFAULT),
    StudyComparison("steps end at the sample", TO_SAMPLE, TO_SAMPLE),
    StudyComparison("… and adaptive rejects within 30 mm", SPACED, TO_SAMPLE),
    StudyComparison("… and both reject within 30 mm", SPACED, SPACED),
    StudyComparison("adaptive has the goal sight", SIGHT, TO_SAMPLE),
    StudyComparison("both have the goal sight", SIGHT, SIGHT),
)
ADAPTIVE_REJECTS, BOTH_REJECT = COMPARISONS[2], COMPARISONS[3]


def batches(
    rig: Rig, scenes: Sequence[Scene], seeds: int, *, checked: bool = False
) -> tuple[Batch, ...]:
    """All searches of the campaign, in a fixed order.

    Args:
        rig: With its own workspace box.
        seeds: Searches in each arm of each case.
        checked: Whether the independent check checks the paths of Fig. 9.
    """
    rig_json = rig.document.model_dump_json()
    scene_json = {scene.name: scene.document.model_dump_json() for scene in scenes}
    numbers = tuple(range(seeds))
    made = []
    for study, case, arm in _searches(tuple(scene_json)):
        figure = study == FIGURE_9
        for first in range(0, seeds, _SEEDS_IN_A_BATCH):
            made.append(
                Batch(
                    study=study,
                    case=case,
                    arm=arm,
                    rig=rig_json,
                    scene=scene_json[case.environment],
                    seeds=numbers[first : first + _SEEDS_IN_A_BATCH],
                    measured=figure,
                    clearance=figure and case.box == OWN,
                    checked=figure and checked,
                )
            )
    return tuple(made)


def figure_9_arm(sampler: SamplerName, cost: CostName) -> Arm:
    """One of the four planners of Fig. 9."""
    compared = ADAPTIVE_REJECTS
    readings = compared.adaptive if sampler == "adaptive" else compared.baseline
    return Arm(sampler, cost, readings)


def arms_of(comparison: StudyComparison) -> tuple[Arm, Arm]:
    """The adaptive planner and the baseline of a comparison, with the length as cost."""
    return Arm("adaptive", "length", comparison.adaptive), _baseline(comparison.baseline)


def all_readings() -> tuple[StudyComparison, ...]:
    """Every reading without goal sight, against the goal bias with the same steps."""
    found = []
    for rate, focus, draw, steer, spacing in product(
        FAILURE_RATES, FOCUSES, CONE_DRAWS, STEERS, (0.0, SPACING)
    ):
        readings = AlgorithmVariant(rate, focus, draw, steer, spacing)
        name = f"e_r {rate}, x_c {focus}, {draw}, {steer}, {spacing * 1e3:g} mm"
        found.append(StudyComparison(name, readings, AlgorithmVariant(steer=steer)))
    return tuple(found)


def _baseline(readings: AlgorithmVariant) -> Arm:
    return Arm("goal-bias", "length", readings)


def _searches(environments: tuple[str, ...]) -> Iterator[tuple[str, Case, Arm]]:
    for box, environment, ends in product((OWN, WIDE), environments, ENDS):
        case = Case(box, environment, ends)
        for sampler, cost in product(SAMPLERS, COSTS):
            yield FIGURE_9, case, figure_9_arm(sampler, cost)
        for arm in _distinct(COMPARISONS):
            yield VARIANTS, case, arm
    for box, environment in product((OWN, WIDE), environments):
        for arm in _distinct(all_readings()):
            yield READINGS, Case(box, environment), arm
    for box, environment in product(SHARES, environments):
        for arm in _distinct(COMPARISONS[1:4]):
            yield BOXES, Case(box, environment), arm


def _distinct(comparisons: Sequence[StudyComparison]) -> tuple[Arm, ...]:
    return tuple(dict.fromkeys(arm for c in comparisons for arm in arms_of(c)))


# Running all searches of a campaign, in this process or in a pool.


Progress = Callable[[int], None]
"""Called with the number of searches just finished."""


def run_all(batches: Sequence[Batch], pool: Executor | None, progress: Progress) -> list[Trial]:
    """Runs all batches; the trials are in the order of the batches, whichever process ran them.

    Args:
        pool: Other processes or machines; None for this process.
        progress: Called with the number of searches just finished.
    """
    if pool is None:
        trials = []
        for batch in batches:
            trials += run_batch(batch)
            progress(len(batch.seeds))
        return trials
    done: dict[int, list[Trial]] = {}
    tasks = {pool.submit(run_batch, batch): k for k, batch in enumerate(batches)}
    try:
        for task in as_completed(tasks):
            done[tasks[task]] = task.result()
            progress(len(batches[tasks[task]].seeds))
    finally:
        for task in tasks:
            task.cancel()
    return [trial for k in range(len(batches)) for trial in done[k]]


# Means, deviations and bootstrap intervals of campaigns.


_RESAMPLES = 2000
_SEED = 20230516
_LEVELS = (2.5, 97.5)


@dataclass(frozen=True, slots=True)
class Summary:
    """Statistics of a sample.

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
    """Relative difference of a figure between two planners.

    Attributes:
        each: In each environment; NaN where too few seeds found a path with both.
        mean: Over the other environments; NaN without any, as are both ends of its interval.
        low: Lower end of the 95 % bootstrap interval of `mean`.
        high: Its upper end.
    """

    each: tuple[float, ...]
    mean: float
    low: float
    high: float


def summary(values: Array) -> Summary:
    """Figures of a sample, shape (k,); NaN for an empty one."""
    if not len(values):
        return Summary(0, np.nan, np.nan, np.nan, np.nan)
    means = values[_resampled(len(values))].mean(axis=1)
    low, high = (float(x) for x in np.percentile(means, _LEVELS))
    deviation = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return Summary(len(values), float(values.mean()), deviation, low, high)


def change_of_means(pairs: Sequence[tuple[Array, Array]]) -> Change:
    """Change of the mean from the second sample of each pair to the first.

    Args:
        pairs: One per environment; the samples of a pair have the same seeds in the same order,
            shape (k,) each, and are resampled together, as random ends correlate them.
    """
    return _change(pairs, _mean, 1)


def change_of_deviations(pairs: Sequence[tuple[Array, Array]]) -> Change:
    """Change of the standard deviation; see `change_of_means`.

    Where only the second sample has none, the change is unknown, and such resamples are left out.
    """
    return _change(pairs, _deviation, 2)


def _change(
    pairs: Sequence[tuple[Array, Array]], figure: Callable[[Array], Array], least: int
) -> Change:
    """The change of a figure that needs a sample of at least this size; NaN for one it lacks."""
    each, resampled = np.full(len(pairs), np.nan), []
    for k, (one, other) in enumerate(pairs):
        if len(one) >= least:
            each[k] = _relative(figure(one[None]), figure(other[None]))[0]
        if not np.isnan(each[k]):
            rows = _resampled(len(one), k)
            resampled.append(_relative(figure(one[rows]), figure(other[rows])))
    if not resampled:
        return Change(tuple(each.tolist()), np.nan, np.nan, np.nan)
    low, high = (float(x) for x in np.nanpercentile(sum(resampled) / len(resampled), _LEVELS))
    return Change(tuple(each.tolist()), float(np.mean(each[~np.isnan(each)])), low, high)


def _mean(samples: Array) -> Array:
    means: Array = samples.mean(axis=1)
    return means


def _deviation(samples: Array) -> Array:
    deviations: Array = samples.std(axis=1, ddof=1)
    return np.where(np.ptp(samples, axis=1) > 0.0, deviations, 0.0)  # exactly, whatever the mean


def _relative(one: Array, other: Array) -> Array:
    """Relative change; 0 where both are 0, NaN where only the other is."""
    both = np.where(one > 0.0, np.nan, 0.0)
    return np.divide(one - other, other, out=both, where=other > 0.0)


def _resampled(size: int, stream: int = 0) -> NDArray[np.int64]:
    """Rows to draw with replacement, shape (resamples, size)."""
    random = np.random.default_rng([_SEED, stream])
    return random.integers(size, size=(_RESAMPLES, size))


COUNTED = ("nodes", "searches", "edge_checks", "time_ms")
MEASURED = ("raw_length_mm", "length_mm", "raw_cost", "cost", "clearance_mm")


class Results:
    """All trials of a campaign.

    Attributes:
        trials: In order.
        environments: Names, in the order of the campaign.
    """

    def __init__(self, trials: Iterable[Trial]) -> None:
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
        """Number of searches of a study that found no path."""
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
            columns = np.array(values, dtype=np.float64).reshape(-1, 2).T
            pairs.append((columns[0], columns[1]))
        return change_of_means(pairs), change_of_deviations(pairs)


# The paper's claims about Fig. 9, beside the findings.


NODES, NODES_DEVIATION = -0.205, 0.0
COST, COST_DEVIATION = -0.182, 0.0

CONDITIONS: tuple[tuple[str, Ends], ...] = tuple(product((OWN, WIDE), ENDS))


@dataclass(frozen=True, slots=True)
class Finding:
    """One claim in one box with one kind of ends.

    Attributes:
        claim: In the paper's words, shortened.
        claimed: Relative change claimed; 0 where only "smaller" is claimed.
        box: Name of the workspace box.
        ends: Kind of start and goal.
        change: The change found.
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
        if np.isnan(change.mean):
            return "too few paths to compare"
        if change.high < self.claimed:
            return "reached"
        if self.claimed and change.mean <= self.claimed:
            return "reached on average"
        if change.low <= self.claimed:
            return "not reached, but within the interval" if self.claimed else "no difference seen"
        if change.high < 0.0:
            return "smaller, but by less than claimed"
        return "no difference seen" if change.low <= 0.0 else "the opposite"


#: Which planner rejects new nodes within 30 mm of another: the claim depends on it.
_REJECTING = (
    ("adaptive alone rejects near nodes", ADAPTIVE_REJECTS),
    ("both reject them", BOTH_REJECT),
)


def findings(results: Results) -> tuple[Finding, ...]:
    """Every claim in every box with every kind of ends."""
    found = []
    costs = figure_9_arm("adaptive", "kinematic"), figure_9_arm("adaptive", "length")
    for box, ends in CONDITIONS:
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
