"""The settings that the options of `cdpr plan` make for the planner chosen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cdpr.cli.plan_options import CostName, ModeName, PlannerName
from cdpr.errors import BadInput

if TYPE_CHECKING:
    from cdpr.cli.readings import ConeDrawName, FailureRateName, FocusName, SteerName
    from planner.optimal.settings import OptimalSettings
    from planner.paper.readings import Readings
    from planner.settings import PlannerSettings
    from planner.turning.settings import TurningSettings
    from planner.way import Settings
    from planner.weights import Weights

_OPTIMAL = ("weight", "budget_ms", "rounds", "longest_mm", "free_rotation")
_PAPER = ("mode", "max_iterations", "steer", "spacing_mm", "goal_sight")
_HEEDED = {
    PlannerName.optimal: _OPTIMAL,
    PlannerName.adaptive: (*_PAPER, "failure_rate", "focus", "cone_draw"),
    PlannerName.goal_bias: _PAPER,
}


@dataclass(frozen=True, slots=True)
class SettingsOptions:
    """What was asked for; None, or nothing, where an option was left out."""

    planner: PlannerName
    seed: int
    cost: CostName | None = None
    weight: Sequence[str] = ()
    budget_ms: float | None = None
    rounds: Sequence[int] = ()
    longest_mm: float | None = None
    free_rotation: bool = False
    mode: ModeName | None = None
    max_iterations: int | None = None
    failure_rate: FailureRateName | None = None
    focus: FocusName | None = None
    cone_draw: ConeDrawName | None = None
    steer: SteerName | None = None
    spacing_mm: float | None = None
    goal_sight: bool = False


def settings_of(options: SettingsOptions) -> Settings:
    """The settings of the planner chosen.

    Raises:
        BadInput: An option was given that the planner would not heed, options contradict each
            other, or a value cannot be used.
    """
    _refuse_unheeded(options)
    if options.planner is PlannerName.optimal:
        return _optimal_settings(options)
    return _paper_settings(options)


def _refuse_unheeded(options: SettingsOptions) -> None:
    heeded = _HEEDED[options.planner]
    asked = {name for heard in _HEEDED.values() for name in heard}
    left = [name for name in sorted(asked - set(heeded)) if _is_given(getattr(options, name))]
    if left:
        named = ", ".join("--" + name.replace("_", "-") for name in left)
        raise BadInput(
            f"--planner {options.planner.value} knows no {named}",
            next_step="leave it out, or choose another planner; cdpr plan --help tells whose it is",
        )
    if options.steer is not None and options.mode is not ModeName.paper:
        raise BadInput(
            "--steer is about the steps of --mode paper; RRT* goes no farther than to the sample",
            next_step="give --mode paper too, or leave --steer out",
        )


def _is_given(value: object) -> bool:
    return value is not None and value is not False and value != () and value != []


def _optimal_settings(options: SettingsOptions) -> OptimalSettings | TurningSettings:
    from planner.optimal.settings import OptimalSettings
    from planner.turning.settings import TurningSettings
    from planner.weights import OBJECTIVES

    if options.weight and options.cost is not None:
        raise BadInput("--cost and --weight both say what to optimise", next_step="give one")
    if options.budget_ms is not None and options.rounds:
        raise BadInput("--budget-ms and --rounds both say how long to go on", next_step="give one")
    budget = options.budget_ms
    given: dict[str, Any] = {} if budget is None else {"budget": budget / 1000.0}
    cost = options.cost or CostName.length
    return (TurningSettings if options.free_rotation else OptimalSettings)(
        weights=_weights(options.weight) if options.weight else OBJECTIVES[cost.value],
        longest=math.inf if options.longest_mm is None else options.longest_mm / 1000.0,
        seed=options.seed,
        rounds=options.rounds[0] if options.rounds else None,
        **given,
    )


def _weights(given: Sequence[str]) -> Weights:
    from planner.weights import Weights

    names = [name.value for name in CostName]
    read: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        if name in read:
            raise BadInput(f"--weight {text}: {name!r} stands twice", next_step="give it once")
        if name not in names:
            raise BadInput(
                f"--weight {text}: {name!r} is no objective", next_step=f"use {', '.join(names)}"
            )
        try:
            read[name] = float(number)
        except ValueError:
            raise BadInput(
                f"--weight {text}: {number!r} is no number", next_step="write --weight length=1"
            ) from None
    return Weights(**read)


def _paper_settings(options: SettingsOptions) -> PlannerSettings:
    from planner.settings import PlannerSettings

    cost = options.cost
    if cost in (CostName.clearance, CostName.capacity):
        raise BadInput(
            f"--planner {options.planner.value} knows no cost {cost.value!r}",
            next_step="use --planner optimal, or --cost kinematic or length",
        )
    most = options.max_iterations
    given: dict[str, Any] = {} if most is None else {"max_iterations": most}
    return PlannerSettings(
        sampler="adaptive" if options.planner is PlannerName.adaptive else "goal-bias",
        cost="length" if cost is CostName.length else "kinematic",
        mode=(options.mode or ModeName.rewire).value,
        seed=options.seed,
        readings=_readings(options),
        **given,
    )


def _readings(options: SettingsOptions) -> Readings:
    """Those of the text, but for what was asked for otherwise."""
    from planner.paper.readings import Readings

    given: dict[str, Any] = {
        name: choice.value
        for name in ("failure_rate", "focus", "cone_draw", "steer")
        if (choice := getattr(options, name)) is not None
    }
    spacing = (options.spacing_mm or 0.0) / 1000.0
    return Readings(**given, spacing=spacing, goal_sight=options.goal_sight)
