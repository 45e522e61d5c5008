"""The options of `cdpr plan`, and the settings that they make for the planner chosen."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.errors import BadInput

if TYPE_CHECKING:
    from planner.optimal.settings import OptimalSettings
    from planner.paper.readings import Readings
    from planner.settings import PlannerSettings
    from planner.turning.settings import TurningSettings
    from planner.weights import Weights


class PlannerName(StrEnum):
    """Which planner searches."""

    optimal = "optimal"
    adaptive = "adaptive"
    goal_bias = "goal-bias"


class CostName(StrEnum):
    """What makes a path good."""

    length = "length"
    kinematic = "kinematic"
    clearance = "clearance"
    capacity = "capacity"


class ModeName(StrEnum):
    """How far the paper's search goes."""

    rewire = "rewire"
    paper = "paper"


PlannerOption = Annotated[
    PlannerName,
    typer.Option(help="the one we recommend; the paper's; or half of all samples at the goal"),
]
CostOption = Annotated[
    CostName | None,
    typer.Option(help="what to optimise (optimal: length; the paper's planners: kinematic)"),
]
WeightOption = Annotated[
    list[str] | None,
    typer.Option("--weight", help="NAME=NUMBER, again for a sum: length, kinematic, …"),
]
BudgetOption = Annotated[
    float | None, typer.Option(min=0.001, help="how long optimal goes on improving [default: 50]")
]
RoundsOption = Annotated[
    list[int] | None,
    typer.Option(min=1, help="optimal: so many rounds instead, the same path again"),
]
LongestOption = Annotated[
    float | None, typer.Option(min=0.001, help="optimal: the best path that is no longer")
]
FreeRotationOption = Annotated[
    bool,
    typer.Option("--free-rotation", help="optimal: turn as well, within the scene's limits"),
]
ViaOption = Annotated[
    list[str] | None,
    typer.Option(help="way-pose before the scene's stops; again for more", metavar="X,Y,Z"),
]
FromRunOption = Annotated[
    Path | None,
    typer.Option(help="begin where this run ended, with the stops left", metavar="RUNDIR"),
]
ModeOption = Annotated[
    ModeName | None,
    typer.Option(help="the paper's planners: RRT* (rewire), or stop at the first path (paper)"),
]
IterationsOption = Annotated[
    int | None, typer.Option(min=1, help="the paper's planners: give up after so many samples")
]


def optimal_settings(
    free_rotation: bool,
    seed: int,
    cost: CostName | None,
    weights: list[str],
    budget_ms: float | None,
    rounds: list[int],
    longest_mm: float | None,
) -> OptimalSettings | TurningSettings:
    """The settings of the planner we recommend.

    Raises:
        BadInput: Options contradict each other, or a weight cannot be read.
    """
    from planner.optimal.settings import OptimalSettings
    from planner.turning.settings import TurningSettings
    from planner.weights import OBJECTIVES

    if weights and cost is not None:
        raise BadInput("--cost and --weight both say what to optimise", next_step="give one")
    if budget_ms is not None and rounds:
        raise BadInput("--budget-ms and --rounds both say how long to go on", next_step="give one")
    options: dict[str, Any] = {} if budget_ms is None else {"budget": budget_ms / 1000.0}
    return (TurningSettings if free_rotation else OptimalSettings)(
        weights=_weights(weights) if weights else OBJECTIVES[(cost or CostName.length).value],
        longest=math.inf if longest_mm is None else longest_mm / 1000.0,
        seed=seed,
        rounds=rounds[0] if rounds else None,
        **options,
    )


def _weights(given: list[str]) -> Weights:
    from planner.weights import Weights

    names = [name.value for name in CostName]
    read: dict[str, float] = {}
    for text in given:
        name, _, number = text.partition("=")
        if name not in names or name in read:
            what = "stands twice" if name in read else "is no objective"
            raise BadInput(f"--weight {text}: {name!r} {what}", next_step=f"use {', '.join(names)}")
        try:
            read[name] = float(number)
        except ValueError:
            raise BadInput(
                f"--weight {text}: {number!r} is no number", next_step="write --weight length=1"
            ) from None
    return Weights(**read)


def paper_settings(
    planner: PlannerName,
    seed: int,
    cost: CostName | None,
    mode: ModeName | None,
    max_iterations: int | None,
    readings: Readings,
) -> PlannerSettings:
    """The settings of the paper's planner or of its baseline.

    Raises:
        BadInput: The objective is one that they do not know.
    """
    from planner.settings import PlannerSettings

    if cost in (CostName.clearance, CostName.capacity):
        raise BadInput(
            f"--planner {planner.value} knows no cost {cost.value!r}",
            next_step="use --planner optimal, or --cost kinematic or length",
        )
    options: dict[str, Any] = {} if max_iterations is None else {"max_iterations": max_iterations}
    return PlannerSettings(
        sampler="adaptive" if planner is PlannerName.adaptive else "goal-bias",
        cost="length" if cost is CostName.length else "kinematic",
        mode=(mode or ModeName.rewire).value,
        seed=seed,
        readings=readings,
        **options,
    )


def refuse(planner: PlannerName, options: dict[str, bool]) -> None:
    """Refuses options that were given but that the planner would not heed.

    Raises:
        BadInput: Names them.
    """
    given = [name for name, is_given in options.items() if is_given]
    if given:
        raise BadInput(
            f"--planner {planner.value} knows no {', '.join(given)}",
            next_step="leave it out, or choose another planner; cdpr plan --help tells whose it is",
        )
