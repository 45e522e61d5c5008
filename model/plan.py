"""Plans: written with a hash of their content, and refused when it does not match."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from model.errors import BadInput, InvalidFile, path_of
from model.files.documents import check_version, document_hash, write_atomic
from model.files.plan_file import (
    OptimalPlannerDocument,
    PlanDocument,
    PlannerDocument,
    QualityDocument,
)
from model.files.reading import read_json
from model.files.validation import problems_of
from model.pages.page import html_table
from model.pose import Pose, largest_rotations
from model.rig import NOT_IN_PLAN_HASH, Rig, rig_from_document
from model.scene import Scene, require_unaltered, scene_from_document
from model.statics.wrench_sets import rms_anchor_radius

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLAN_AGAIN = "plan again with `cdpr plan`"
STOP_TOLERANCE = 1e-6
"""How far a marked waypoint may be from its stop, [m] and [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path whose file is intact: its hashes match its content.

    Attributes:
        document: The file it was made from.
        rig: The rig it was made for.
        scene: The scene it was made for.
        waypoints: ``world_from_platform`` at the corners, start, stops and goal included.
        stops: Indices of the waypoints at the scene's stops.
        raw_path: The path before post-processing.
    """

    document: PlanDocument
    rig: Rig
    scene: Scene
    waypoints: tuple[Pose, ...]
    stops: tuple[int, ...]
    raw_path: tuple[Pose, ...]

    def remade(self) -> Plan:
        """The plan that its document describes."""
        return plan_from_document(self.document)

    @property
    def length(self) -> float:
        """Length of the path of the platform's origin, [m]."""
        return self.document.quality.length_mm / 1000.0

    @property
    def quality(self) -> QualityDocument:
        """Length, clearances, tensions and cost from the planner; units in the names."""
        return self.document.quality

    def save(self, path: str | Path) -> Path:
        """Writes the plan file atomically; returns its path.

        Raises:
            BadInput: The folder cannot be written to, or this plan is an altered copy
                (`model.scene.require_unaltered`).
        """
        require_unaltered(self)
        path = path_of(path)
        save_plan(self.document, path)
        return path

    def plot(self) -> Figure:
        """A figure of the path among its obstacles, with the robot at the start."""
        from model.figures import plan_figure  # loads matplotlib

        return plan_figure(self)

    def __repr__(self) -> str:
        """Rig, scene and size."""
        return (
            f"<Plan for {self.rig.name} in {self.scene.name}: {len(self.waypoints)} waypoints,"
            f" {self.length * 1e3:.1f} mm>"
        )

    def _repr_html_(self) -> str:
        """For notebooks."""
        return html_table("Plan", plan_facts(self.document))


def plan_from_document(document: PlanDocument) -> Plan:
    """The plan that a document describes."""
    return Plan(
        document=document,
        rig=rig_from_document(document.rig),
        scene=scene_from_document(document.scene),
        waypoints=tuple(w.pose() for w in document.waypoints),
        stops=tuple(mark.waypoint for mark in document.stops),
        raw_path=tuple(w.pose() for w in document.raw_path),
    )


def sealed(fields: dict[str, Any]) -> PlanDocument:
    """A plan document with its hash, from all of its other fields.

    Raises:
        BadInput: A value is not one of a plan file.
    """
    try:
        unsealed = PlanDocument(**{"schema_version": 1, **fields, "hash": ""})
    except ValidationError as error:
        problems = problems_of(error, PlanDocument, {})
        what = "; ".join(f"{problem.key}: {problem.what}" for problem in problems)
        raise BadInput(f"a plan file cannot hold this plan: {what}") from None
    return unsealed.model_copy(update={"hash": _digest(unsealed)})


def save_plan(document: PlanDocument, path: Path) -> None:
    """Writes a plan file atomically.

    Raises:
        BadInput: The folder cannot be written to.
    """
    write_atomic(path, json.dumps(document.model_dump(mode="json"), indent=1) + "\n")


def load_plan(path: str | Path) -> Plan:
    """Reads a plan file.

    Raises:
        BadInput: It cannot be read, is not JSON, holds NaN, or its hash does not match.
        InvalidFile: With every key that does not fit.
    """
    path = path_of(path)
    data = _json_object(path)
    if data.get("kind") != "cdpr-plan":
        why = "its key `kind` must be `cdpr-plan`"
        raise BadInput("this is not a plan file", where=str(path), why=why, next_step=PLAN_AGAIN)
    check_version(data, PlanDocument, path, {}, PLAN_AGAIN)
    try:
        document = PlanDocument.model_validate(data)
    except ValidationError as error:
        raise InvalidFile(str(path), problems_of(error, PlanDocument, {}), PLAN_AGAIN) from None
    _check_hash("hash", document.hash, _digest(document), path)
    plan = plan_from_document(document)
    _check_hash("rig_hash", document.rig_hash, plan.rig.plan_hash, path)
    _check_hash("scene_hash", document.scene_hash, plan.scene.hash, path)
    _check_stops(plan, path)
    return plan


def _check_stops(plan: Plan, path: Path) -> None:
    """Checks that the marked waypoints are the scene's stops, in order."""
    marks, stops = plan.document.stops, plan.scene.stops
    indices = [mark.waypoint for mark in marks]
    if [mark.name for mark in marks] != [stop.name for stop in stops]:
        what = f"marks the stops {[m.name for m in marks]}; its scene has {[s.name for s in stops]}"
    elif indices != sorted(indices) or not all(p < len(plan.waypoints) for p in indices):
        what = f"marks the waypoints {indices} of {len(plan.waypoints)} as stops, out of order"
    else:
        away = [plan.waypoints[p].distance_to(s.pose) for p, s in zip(indices, stops, strict=True)]
        rotated = [plan.waypoints[p].angle_to(s.pose) for p, s in zip(indices, stops, strict=True)]
        if max([*away, *rotated], default=0.0) <= STOP_TOLERANCE:
            return
        what = f"misses a stop by {max(away) * 1000.0:.4g} mm"
    why = "the file was not made by `cdpr plan`"
    raise BadInput(f"the plan {what}", where=str(path), why=why, next_step=PLAN_AGAIN)


def _json_object(path: Path) -> dict[str, Any]:
    data = read_json(path, PLAN_AGAIN)
    if not isinstance(data, dict):
        raise BadInput("this is not a plan file", where=str(path), next_step=PLAN_AGAIN)
    return data


def _digest(document: PlanDocument) -> str:
    return document_hash(document, {"hash"})


def _check_hash(key: str, stated: str, actual: str, path: Path) -> None:
    if stated != actual:
        raise BadInput(
            f"the plan's {key} does not match its content",
            where=str(path),
            why="the file was edited, damaged, or written by a version with other defaults",
            next_step=f"{PLAN_AGAIN}; a plan cannot be edited by hand",
        )


def require_same_rig(plan: Plan, rig: Rig, plan_path: Path | str) -> None:
    """Rejects a plan that was made for another rig, and names what differs.

    Raises:
        BadInput: The rig's plan hash is not the plan's, or one of them is an altered copy.
    """
    require_unaltered(plan, rig)
    if plan.rig.plan_hash == rig.plan_hash:
        return
    ours = rig.document.model_dump(mode="json")
    theirs = plan.rig.document.model_dump(mode="json")
    differing = [k for k in ours if k not in NOT_IN_PLAN_HASH and ours[k] != theirs[k]]
    raise BadInput(
        f"the plan was made for the rig {plan.rig.name!r}, not for {rig.name!r} as it is now",
        where=str(plan_path),
        why=f"these parts of the rig file differ: {', '.join(differing)}",
        next_step="plan again for this rig with `cdpr plan`; or, if the plan was made with"
        " --calibration, pass the same --calibration here, in Python rig.with_calibration()",
    )


# Summaries of a plan.


def plan_as_dict(document: PlanDocument) -> dict[str, Any]:
    """Machine-readable summary: the plan file without waypoints, rig and scene."""
    return {
        "hash": document.hash,
        "rig": document.rig.name,
        "scene": document.scene.name,
        "planner": document.planner.model_dump(mode="json"),
        "waypoints": len(document.waypoints),
        "stops": [mark.model_dump(mode="json") for mark in document.stops],
        "quality": document.quality.model_dump(mode="json"),
        "statistics": document.statistics.model_dump(mode="json"),
    }


def plan_facts(document: PlanDocument) -> list[tuple[str, str]]:
    """Human-readable summary: name and value."""
    quality = document.quality
    facts = [
        ("rig, scene", f"{document.rig.name}, {document.scene.name}"),
        *scene_from_document(document.scene).stop_facts(),
        (
            "length",
            f"{quality.length_mm:.1f} mm ({len(document.waypoints)} waypoints;"
            f" {raw_length_text(document)})",
        ),
    ]
    facts += _rotation(document)
    near = quality.obstacle_clearance
    if near is not None:
        facts.append(("clearance", f"{near.distance_mm:.2f} mm, {near.first} to {near.second}"))
    own = quality.self_clearance
    facts += [
        ("self clearance", f"{own.distance_mm:.2f} mm, {own.first} to {own.second}"),
        ("tension", f"{quality.min_tension_n:.1f} to {quality.max_tension_n:.1f} N"),
        ("kinematic cost", f"{quality.mean_kinematic_cost:.3f} on average"),
        ("search", _search_sentence(document)),
    ]
    return facts


def raw_length_text(document: PlanDocument) -> str:
    """Length of the path that was improved, and which one it is."""
    is_paper = isinstance(document.planner, PlannerDocument)
    which = "before post-processing" if is_paper else "first path found"
    return f"{document.quality.raw_length_mm:.1f} mm {which}"


def _rotation(document: PlanDocument) -> list[tuple[str, str]]:
    """One line for a plan that rotates the platform; none for others."""
    poses = [waypoint.pose() for waypoint in document.waypoints]
    if all(pose.angle_to(poses[0]) == 0.0 for pose in poses):
        return []
    found = [largest_rotations(a.quaternion, b.quaternion) for a, b in pairwise(poses)]
    tilt, turn = (math.degrees(max(values)) for values in zip(*found, strict=True))
    radius = rms_anchor_radius(np.array(document.rig.anchors_mm))
    length = sum(
        math.hypot(a.distance_to(b) * 1e3, radius * a.angle_to(b)) for a, b in pairwise(poses)
    )
    text = f"tilted up to {tilt:.2f}°, rotated up to {turn:.2f}°; {length:.1f} mm with rotation"
    return [("rotation", text)]


def _search_sentence(document: PlanDocument) -> str:
    statistics, planner = document.statistics, document.planner
    checks = f"{statistics.edge_checks} edge check{'s' * (statistics.edge_checks != 1)}"
    rest = f"{checks}, {statistics.planning_time_s:.2f} s"
    if isinstance(planner, OptimalPlannerDocument):
        search = f", {(statistics.search_time_s or 0.0) * 1e3:.0f} ms of search"
        again = " ".join(f"--rounds {of_leg}" for of_leg in planner.rounds)
        rounds = sum(planner.rounds)
        return f"{rounds} round{'s' * (rounds != 1)} (to repeat: {again}), {rest}{search}"
    return f"{statistics.nodes} nodes, {statistics.iterations} samples, {rest}"
