"""The options of `cdpr plan`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


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
    float | None,
    typer.Option(
        min=0.001, help="optimal: how long it goes on improving; 50 ms, or 500 with --free-rotation"
    ),
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
    int | None,
    typer.Option(min=1, max=1_000_000, help="the paper's planners: give up after so many samples"),
]
