"""What is compared: which planners, in which boxes, from which starts to which goals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, replace
from itertools import product

from model.rig import Rig
from model.scene import Scene
from planner.campaign.trial import OWN, SHARES, WIDE, Arm, Batch, Case, Ends, Trial, run_batch
from planner.rrt.variants import CONE_DRAWS, FAILURE_RATES, FOCUSES, STEERS, TEXT, AlgorithmVariant
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
    StudyComparison("the text as written", TEXT, TEXT),
    StudyComparison("steps end at the sample", TO_SAMPLE, TO_SAMPLE),
    StudyComparison("… and adaptive rejects within 30 mm", SPACED, TO_SAMPLE),
    StudyComparison("… and both reject within 30 mm", SPACED, SPACED),
    StudyComparison("adaptive has the goal sight", SIGHT, TO_SAMPLE),
    StudyComparison("both have the goal sight", SIGHT, SIGHT),
)
NEAREST_TO_THE_CLAIM, BOTH_REJECT = COMPARISONS[2], COMPARISONS[3]


def batches(
    rig: Rig, scenes: Sequence[Scene], seeds: int, *, checked: bool = False
) -> tuple[Batch, ...]:
    """All searches of the campaign, in a fixed order.

    Args:
        rig: With its own workspace box.
        scenes: The environments.
        seeds: Searches in each arm of each case.
        checked: Whether the paths of Fig. 9 are put to the independent check.
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
    nearest = NEAREST_TO_THE_CLAIM
    readings = nearest.adaptive if sampler == "adaptive" else nearest.baseline
    return Arm(sampler, cost, readings)


def arms_of(comparison: StudyComparison) -> tuple[Arm, Arm]:
    """The adaptive planner and the baseline of a comparison, under the length."""
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


# Doing all searches of a campaign, in this process or wherever a pool does them.


Progress = Callable[[int], None]
"""Called with the number of searches newly done."""


def run_all(batches: Sequence[Batch], pool: Executor | None, progress: Progress) -> list[Trial]:
    """Does all batches; the trials are in the order of the batches, whatever process did them.

    Args:
        batches: What to do.
        pool: Does it, in other processes or on other machines; this process without one.
        progress: Called with the number of searches newly done.
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
