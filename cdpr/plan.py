"""Plans: written with a hash over their content, and refused when it does not match."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from pydantic import ValidationError

from cdpr.documents import check_version, document_hash, problems_of, read_text, write_atomic
from cdpr.errors import BadInput, InvalidFile
from cdpr.plan_file import PlanDocument
from cdpr.poses import Pose
from cdpr.rig import Rig, rig_from_document
from cdpr.scene import Scene, scene_from_document

ANEW = "make the plan anew with `cdpr plan`"
STOP_TOLERANCE = 1e-6
"""How far a marked waypoint may be from its stop, [m] and [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path whose file is whole: its hashes match its content.

    Attributes:
        document: The file it was made from.
        rig: The rig it was made for.
        scene: The scene it was made for.
        waypoints: ``world_from_platform`` at the corners, start, stops and goal included.
        stops: Which of the waypoints are at the scene's stops.
        raw_path: The path before post-processing.
    """

    document: PlanDocument
    rig: Rig
    scene: Scene
    waypoints: tuple[Pose, ...]
    stops: tuple[int, ...]
    raw_path: tuple[Pose, ...]


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
    """A plan document with its hash, from all of its other fields."""
    unsealed = PlanDocument(hash="", **fields)
    return unsealed.model_copy(update={"hash": _digest(unsealed)})


def save_plan(document: PlanDocument, path: Path) -> None:
    """Writes a plan file whole or not at all.

    Raises:
        BadInput: The folder cannot be written to.
    """
    write_atomic(path, json.dumps(document.model_dump(mode="json"), indent=1) + "\n")


def load_plan(path: Path) -> Plan:
    """Reads a plan file.

    Raises:
        BadInput: It cannot be read, is no JSON, holds NaN, or its hash does not match.
        InvalidFile: With every key that does not fit.
    """
    data = _json_object(path)
    if data.get("kind") != "cdpr-plan":
        raise BadInput("this is not a plan file", where=str(path), next_step=ANEW)
    check_version(data, PlanDocument, path, {}, ANEW)
    try:
        document = PlanDocument.model_validate(data)
    except ValidationError as error:
        raise InvalidFile(str(path), problems_of(error, PlanDocument, {}), ANEW) from None
    _check_hash("hash", document.hash, _digest(document), path)
    plan = plan_from_document(document)
    _check_hash("rig_hash", document.rig_hash, plan.rig.plan_hash, path)
    _check_hash("scene_hash", document.scene_hash, plan.scene.hash, path)
    _check_stops(plan, path)
    return plan


def _check_stops(plan: Plan, path: Path) -> None:
    """The marked waypoints are the scene's stops, in its order."""
    marks, stops = plan.document.stops, plan.scene.stops
    places = [mark.waypoint for mark in marks]
    if [mark.name for mark in marks] != [stop.name for stop in stops]:
        what = f"marks the stops {[m.name for m in marks]}, its scene has {[s.name for s in stops]}"
    elif places != sorted(set(places)) or not all(0 < p < len(plan.waypoints) for p in places):
        what = f"marks the waypoints {places} of {len(plan.waypoints)} as stops, which is no order"
    else:
        away = [plan.waypoints[p].distance_to(s.pose) for p, s in zip(places, stops, strict=True)]
        turned = [plan.waypoints[p].angle_to(s.pose) for p, s in zip(places, stops, strict=True)]
        if max([*away, *turned], default=0.0) <= STOP_TOLERANCE:
            return
        what = f"passes a stop {max(away) * 1000.0:.4g} mm off"
    why = "the file was not made by `cdpr plan`"
    raise BadInput(f"the plan {what}", where=str(path), why=why, next_step=ANEW)


def _json_object(path: Path) -> dict[str, Any]:
    text, where = read_text(path), str(path)
    try:
        data = json.loads(text, parse_constant=_no_constant, object_pairs_hook=_unique_keys)
    except json.JSONDecodeError as error:
        where = f"{path}:{error.lineno}:{error.colno}"
        why = "the file was cut off or edited" if text.strip() else "the file is empty"
        raise BadInput(
            f"not valid JSON: {error.msg}", where=where, why=why, next_step=ANEW
        ) from None
    except ValueError as error:
        raise BadInput(str(error), where=where, next_step=ANEW) from None
    except RecursionError:
        raise BadInput("nested too deeply for a plan", where=where, next_step=ANEW) from None
    if not isinstance(data, dict):
        raise BadInput("this is not a plan file", where=where, next_step=ANEW)
    return data


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"the plan holds {name}, which is no number")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) != len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} stands twice")
    return data


def _digest(document: PlanDocument) -> str:
    return document_hash(document, {"hash"})


def _check_hash(key: str, stated: str, actual: str, path: Path) -> None:
    if stated != actual:
        raise BadInput(
            f"the plan's {key} does not match its content",
            where=str(path),
            why="the file was edited or damaged, or written by a program with other defaults",
            next_step=f"{ANEW}; a plan cannot be edited by hand",
        )
