"""The plan file (JSON, version 1): a path with the scene and rig it was made for."""

from __future__ import annotations

from typing import Annotated, Literal, cast

from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from model.files.documents import (
    COUNT_LARGEST,
    WHOLE_LARGEST,
    Document,
    NonNegative,
    Number,
    PoseDocument,
    Positive,
    Seed,
    Vector,
)
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument, StopDocument


class ReadingsDocument(Document):
    """Reading of the paper's text where it is ambiguous (docs/paper.md)."""

    failure_rate: Literal["k/(k+1)", "k/(k+2)", "tree", "node"]
    focus: Literal["last-failed", "most-failed", "highest-rate"]
    cone_draw: Literal["radius", "volume"]
    steer: Literal["full-step", "to-sample"]
    spacing_mm: NonNegative
    goal_sight: bool


class WeightsDocument(Document):
    """Objective (docs/plan-file.md); clearance and capacity are maximised, the others minimised."""

    length: NonNegative
    kinematic: NonNegative
    clearance: NonNegative
    capacity: NonNegative


class OptimalPlannerDocument(Document):
    """Settings of the default planner; ``turning`` with `--free-rotation`."""

    name: Literal["optimal", "turning"]
    weights: WeightsDocument
    seed: Seed
    rounds: Annotated[list[Annotated[int, Field(ge=1, le=WHOLE_LARGEST)]], Field(min_length=1)]
    budget_ms: Positive | None
    longest_mm: Positive | None


class PlannerDocument(Document):
    """Settings of the paper's planner or its baseline."""

    name: Literal["adaptive", "goal-bias"]
    cost: Literal["kinematic", "length"]
    mode: Literal["paper", "rewire"]
    seed: Seed
    step_mm: Positive
    neighbour_radius_mm: Positive
    goal_radius_mm: Positive
    max_iterations: Annotated[int, Field(ge=1, le=WHOLE_LARGEST)]
    readings: ReadingsDocument | None = None


class WaypointsDocument(Document):
    """A path from the user's own planner; see `planner.planning.plan_from_waypoints`."""

    name: Literal["waypoints"]
    author: str = Field(default="", description="free text that names the planner")


class StatisticsDocument(Document):
    """Effort of the search."""

    nodes: Annotated[int, Field(ge=1, le=COUNT_LARGEST)]
    iterations: Annotated[int, Field(ge=0, le=COUNT_LARGEST)]
    edge_checks: Annotated[int, Field(ge=0, le=COUNT_LARGEST)]
    planning_time_s: NonNegative
    search_time_s: NonNegative | None = None


class NearestDocument(Document):
    """The smallest distance along the path, with its pair and platform position."""

    first: str
    second: str
    distance_mm: Number
    position_mm: Vector


class QualityDocument(Document):
    """Quality of the path as the planner computed it; `cdpr check` recomputes it."""

    length_mm: NonNegative
    raw_length_mm: NonNegative
    obstacle_clearance: NearestDocument | None
    self_clearance: NearestDocument
    mean_kinematic_cost: NonNegative
    min_tension_n: Number
    max_tension_n: Number


class TreeDocument(Document):
    """The search trees, for images: positions, and the parent of each node (-1: a root)."""

    positions_mm: list[Vector]
    parents: list[Annotated[int, Field(ge=-1, le=WHOLE_LARGEST)]]


class StopMarkDocument(Document):
    """The waypoint at a stop of the scene."""

    name: str
    waypoint: Annotated[int, Field(ge=0, le=WHOLE_LARGEST)]


def _require_kind(schema: JsonDict) -> None:
    """Files need `kind` as well; its default only keeps it out of hashes."""
    schema["required"] = ["kind", *cast("list[str]", schema["required"])]


class PlanDocument(Document):
    """A path from start to goal; `hash` covers everything else in the file."""

    model_config = ConfigDict(json_schema_extra=_require_kind)

    kind: Literal["cdpr-plan"] = "cdpr-plan"
    schema_version: Literal[1]
    hash: str
    rig_hash: str
    scene_hash: str
    rig: RigDocument
    scene: SceneDocument
    planner: Annotated[
        PlannerDocument | OptimalPlannerDocument | WaypointsDocument,
        Field(discriminator="name"),
    ]
    waypoints: Annotated[list[PoseDocument], Field(min_length=2)]
    stops: list[StopMarkDocument] = []
    done: list[StopDocument] = []
    raw_path: Annotated[list[PoseDocument], Field(min_length=2)]
    tree: TreeDocument
    statistics: StatisticsDocument
    quality: QualityDocument
