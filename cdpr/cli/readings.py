"""Options of `cdpr plan` for what the paper's text leaves open."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

_PANEL = "The paper's text where it is open (docs/paper.md)"


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


FailureRateOption = Annotated[
    FailureRateName | None, typer.Option(help="e_r, k: failures in a row", rich_help_panel=_PANEL)
]
FocusOption = Annotated[FocusName | None, typer.Option(help="the node x_c", rich_help_panel=_PANEL)]
ConeDrawOption = Annotated[
    ConeDrawName | None,
    typer.Option(help="r and θ₁ uniform, or points uniform in volume", rich_help_panel=_PANEL),
]
SteerOption = Annotated[
    SteerName | None,
    typer.Option(help="steps of --mode paper: as Eq. 9, or as RRT*", rich_help_panel=_PANEL),
]
SpacingOption = Annotated[
    float | None,
    typer.Option(min=0.0, help="reject nodes nearer than this to another", rich_help_panel=_PANEL),
]
GoalSightOption = Annotated[
    bool,
    typer.Option("--goal-sight", help="every new node tries the goal", rich_help_panel=_PANEL),
]
