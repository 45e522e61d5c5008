"""Settings of a planner from what a caller asks for by name; contradictions are refused."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from model.errors import BadInput
from planner.planning import Settings
from planner.rrt.variants import AlgorithmVariant, ConeDraw, FailureRate, Focus, Steer
from planner.settings import (
    OBJECTIVES,
    Mode,
    OptimalSettings,
    PlannerSettings,
    TurningSettings,
    Weights,
)

PlannerName = Literal["optimal", "adaptive", "goal-bias"]
"""The one we recommend; the paper's; or half of all samples at the goal."""
Objective = Literal["length", "kinematic", "clearance", "capacity"]
"""What makes a path good."""

_OPTIMAL = ("weight", "budget_ms", "rounds", "longest_mm", "free_rotation")
_PAPER = ("mode", "max_iterations", "steer", "spacing_mm", "goal_sight")
_HEEDED = {
    "optimal": _OPTIMAL,
    "adaptive": (*_PAPER, "failure_rate", "focus", "cone_draw"),
    "goal-bias": _PAPER,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningOptions:
    """What is asked for; None, or nothing, where an option was left out.

    Attributes:
        planner: Which one searches.
        seed: Of the random numbers.
        cost: What to optimise; ``length``, or ``kinematic`` for the paper's planners.
        weight: Weights of a sum of objectives, by name, or as texts ``NAME=NUMBER``.
        budget_ms: Optimal: how long it goes on improving.
        rounds: Optimal: rounds instead, for each leg or one number for all: the same path again.
        longest_mm: Optimal: the best path that is no longer.
        free_rotation: Optimal: the platform may turn, within the scene's limits.
        mode: The paper's planners: RRT* (rewire), or stop at the first path (paper).
        max_iterations: The paper's planners: give up after this number of samples.
        failure_rate: See `AlgorithmVariant`, as for all below.
        focus: The node x_c.
        cone_draw: How points of the forward cone are drawn.
        steer: How far a new node is from the one it grows from.
        spacing_mm: New nodes nearer to another are rejected.
        goal_sight: Every new node tries the goal.
    """

    planner: PlannerName = "optimal"
    seed: int = 0
    cost: Objective | None = None
    weight: Mapping[str, float] | Sequence[str] = ()
    budget_ms: float | None = None
    rounds: Sequence[int] = ()
    longest_mm: float | None = None
    free_rotation: bool = False
    mode: Mode | None = None
    max_iterations: int | None = None
    failure_rate: FailureRate | None = None
    focus: Focus | None = None
    cone_draw: ConeDraw | None = None
    steer: Steer | None = None
    spacing_mm: float | None = None
    goal_sight: bool = False


def settings_from_options(options: PlanningOptions) -> Settings:
    """The settings of the planner chosen.

    Raises:
        BadInput: An option was given that the planner would not heed, options contradict each
            other, or a value cannot be used.
    """
    if options.planner not in _HEEDED:
        raise BadInput(
            f"unknown planner {options.planner!r}", next_step=f"use one of: {', '.join(_HEEDED)}"
        )
    _refuse_unheeded(options)
    if options.planner == "optimal":
        return _optimal_settings(options)
    return _paper_settings(options)


def _refuse_unheeded(options: PlanningOptions) -> None:
    heeded = _HEEDED[options.planner]
    asked = {name for heard in _HEEDED.values() for name in heard}
    left = [name for name in sorted(asked - set(heeded)) if _is_given(getattr(options, name))]
    if left:
        named = ", ".join("--" + name.replace("_", "-") for name in left)
        raise BadInput(
            f"--planner {options.planner} does not take {named}",
            next_step="leave it out, or choose another planner; see `cdpr plan --help`",
        )
    if options.steer is not None and options.mode != "paper":
        raise BadInput(
            "--steer applies only to --mode paper; RRT* steps never pass the sample",
            next_step="pass --mode paper as well, or leave out --steer",
        )


def _is_given(value: object) -> bool:
    return value is not None and value is not False and value not in ((), [], {})


def _optimal_settings(options: PlanningOptions) -> OptimalSettings | TurningSettings:
    if options.weight and options.cost is not None:
        raise BadInput(
            "--cost and --weight contradict each other", next_step="leave out one of them"
        )
    if options.budget_ms is not None and options.rounds:
        raise BadInput(
            "--budget-ms and --rounds contradict each other", next_step="leave out one of them"
        )
    budget = options.budget_ms
    given: dict[str, Any] = {} if budget is None else {"budget": budget / 1000.0}
    cost = options.cost or "length"
    _require_objective(cost)
    return (TurningSettings if options.free_rotation else OptimalSettings)(
        weights=_weights(options.weight) if options.weight else OBJECTIVES[cost],
        longest=math.inf if options.longest_mm is None else options.longest_mm / 1000.0,
        seed=options.seed,
        rounds=options.rounds[0] if options.rounds else None,
        **given,
    )


def _require_objective(name: str) -> None:
    if name not in OBJECTIVES:
        raise BadInput(
            f"{name!r} is not an objective", next_step=f"use one of: {', '.join(OBJECTIVES)}"
        )


def _weights(given: Mapping[str, float] | Sequence[str]) -> Weights:
    if isinstance(given, Mapping):
        for name in given:
            _require_objective(name)
        return Weights(**given)
    names = get_args(Objective)
    read: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        if name in read:
            raise BadInput(f"--weight {text}: {name!r} appears twice", next_step="give it once")
        if name not in names:
            raise BadInput(
                f"--weight {text}: {name!r} is not an objective",
                next_step=f"use {', '.join(names)}",
            )
        try:
            read[name] = float(number)
        except ValueError:
            raise BadInput(
                f"--weight {text}: {number!r} is not a number", next_step="write --weight length=1"
            ) from None
    return Weights(**read)


def _paper_settings(options: PlanningOptions) -> PlannerSettings:
    cost = options.cost
    if cost in ("clearance", "capacity"):
        raise BadInput(
            f"--planner {options.planner} has no cost {cost!r}",
            next_step="use --planner optimal, or --cost kinematic or length",
        )
    most = options.max_iterations
    given: dict[str, Any] = {} if most is None else {"max_iterations": most}
    return PlannerSettings(
        sampler="adaptive" if options.planner == "adaptive" else "goal-bias",
        cost="length" if cost == "length" else "kinematic",
        mode=options.mode or "rewire",
        seed=options.seed,
        readings=_readings(options),
        **given,
    )


def _readings(options: PlanningOptions) -> AlgorithmVariant:
    """Those of the text, but for what was asked for otherwise."""
    given: dict[str, Any] = {
        name: choice
        for name in ("failure_rate", "focus", "cone_draw", "steer")
        if (choice := getattr(options, name)) is not None
    }
    spacing = (options.spacing_mm or 0.0) / 1000.0
    return AlgorithmVariant(**given, spacing=spacing, goal_sight=options.goal_sight)
