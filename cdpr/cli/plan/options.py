"""The options of `cdpr plan` that choose a planner and its settings."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Annotated, Any

import typer

from planner.options import PlanningOptions

_PANEL = "Open readings of the paper's text (docs/paper.md)"


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


class FailureRateName(StrEnum):
    """The rate e_r at which samples are drawn backward."""

    streak = "k/(k+1)"
    streak_and_two = "k/(k+2)"
    tree = "tree"
    node = "node"


class FocusName(StrEnum):
    """The node x_c that the forward cone opens to."""

    last_failed = "last-failed"
    most_failed = "most-failed"
    highest_rate = "highest-rate"


class ConeDrawName(StrEnum):
    """How points of the forward cone are drawn."""

    radius = "radius"
    volume = "volume"


class SteerName(StrEnum):
    """How far a new node is from the one it grows from."""

    full_step = "full-step"
    to_sample = "to-sample"


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """Which planner searches, and how; every field is an option of `cdpr plan`."""

    planner: Annotated[
        PlannerName,
        typer.Option(help="optimal (recommended), the paper's, or half of all samples at the goal"),
    ] = PlannerName.optimal
    cost: Annotated[
        CostName | None,
        typer.Option(help="objective (default: length; the paper's planners: kinematic)"),
    ] = None
    weight: Annotated[
        list[str] | None,
        typer.Option(
            "--weight", help="NAME=NUMBER, repeatable for a weighted sum: length, kinematic, …"
        ),
    ] = None
    longest_mm: Annotated[
        float | None, typer.Option(min=0.001, help="optimal: upper limit of the path length")
    ] = None
    budget_ms: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="optimal: time for improvement (default: 50 ms; 500 with --free-rotation)",
        ),
    ] = None
    rounds: Annotated[
        list[int] | None,
        typer.Option(min=1, help="optimal: fixed number of improvement rounds (reproducible)"),
    ] = None
    free_rotation: Annotated[
        bool,
        typer.Option(
            "--free-rotation", help="optimal: also rotate the platform, within the scene's limits"
        ),
    ] = False
    mode: Annotated[
        ModeName | None,
        typer.Option(help="the paper's planners: RRT* (rewire), or stop at the first path (paper)"),
    ] = None
    max_iterations: Annotated[
        int | None,
        typer.Option(min=1, max=1_000_000, help="the paper's planners: largest number of samples"),
    ] = None
    failure_rate: Annotated[
        FailureRateName | None,
        typer.Option(help="e_r, k: failures in a row", rich_help_panel=_PANEL),
    ] = None
    focus: Annotated[
        FocusName | None, typer.Option(help="the node x_c", rich_help_panel=_PANEL)
    ] = None
    cone_draw: Annotated[
        ConeDrawName | None,
        typer.Option(help="r and θ₁ uniform, or points uniform in volume", rich_help_panel=_PANEL),
    ] = None
    steer: Annotated[
        SteerName | None,
        typer.Option(help="steps of --mode paper: as Eq. 9, or as RRT*", rich_help_panel=_PANEL),
    ] = None
    spacing_mm: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="reject nodes closer than this to another", rich_help_panel=_PANEL
        ),
    ] = None
    goal_sight: Annotated[
        bool,
        typer.Option("--goal-sight", help="every new node tries the goal", rich_help_panel=_PANEL),
    ] = False

    def with_seed(self, seed: int) -> PlanningOptions:
        """As the planner's library takes them."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        plain: dict[str, Any] = {
            name: value.value if isinstance(value, StrEnum) else value
            for name, value in given.items()
            if value is not None
        }
        return PlanningOptions(seed=seed, **plain)


DEFAULT_SEARCH = SearchOptions()
