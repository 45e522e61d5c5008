"""Plans: written with a hash over their content, and refused when it does not match."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from pydantic import ValidationError

from cdpr.documents import content_hash, problems_of, read_text, write_atomic
from cdpr.errors import BadInput, InvalidFile
from cdpr.plan_file import PlanDocument
from cdpr.poses import Pose
from cdpr.rig import Rig, rig_from_document
from cdpr.scene import Scene, scene_from_document


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A path whose file is whole: its hashes match its content.

    Attributes:
        document: The file it was made from.
        rig: The rig it was made for.
        scene: The scene it was made for.
        waypoints: ``world_from_platform`` at the corners, start and goal included.
        raw_path: The path before post-processing.
    """

    document: PlanDocument
    rig: Rig
    scene: Scene
    waypoints: tuple[Pose, ...]
    raw_path: tuple[Pose, ...]


def plan_from_document(document: PlanDocument) -> Plan:
    """The plan that a document describes."""
    return Plan(
        document=document,
        rig=rig_from_document(document.rig),
        scene=scene_from_document(document.scene),
        waypoints=tuple(w.pose() for w in document.waypoints),
        raw_path=tuple(w.pose() for w in document.raw_path),
    )


def sealed(fields: dict[str, Any]) -> PlanDocument:
    """A plan document with its hash, from all of its other fields."""
    unsealed = PlanDocument(hash="", **fields)
    digest = _digest(unsealed.model_dump(mode="json"))
    return unsealed.model_copy(update={"hash": digest})


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
    text = read_text(path)
    try:
        data = json.loads(text, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        raise BadInput(
            f"not valid JSON: {error.msg}",
            where=f"{path}:{error.lineno}:{error.colno}",
            next_step="make the plan anew with `cdpr plan`",
        ) from None
    except ValueError as error:
        raise BadInput(
            str(error), where=str(path), next_step="make the plan anew with `cdpr plan`"
        ) from None
    try:
        document = PlanDocument.model_validate(data)
    except ValidationError as error:
        problems = problems_of(error, PlanDocument, {})
        raise InvalidFile(
            str(path), problems, "make the plan anew with `cdpr plan`"
        ) from None
    _check_hashes(document, data, path)
    return plan_from_document(document)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"the plan holds {name}, which is no number")


def _digest(data: dict[str, Any]) -> str:
    return content_hash({key: value for key, value in data.items() if key != "hash"})


def _check_hashes(document: PlanDocument, data: dict[str, Any], path: Path) -> None:
    plan = plan_from_document(document)
    expected = {
        "hash": _digest(data),
        "rig_hash": plan.rig.plan_hash,
        "scene_hash": plan.scene.hash,
    }
    for key, value in expected.items():
        if data[key] != value:
            raise BadInput(
                f"the plan's {key} does not match its content",
                where=str(path),
                why="the file was edited or damaged after it was written",
                next_step="make the plan anew with `cdpr plan`; a plan cannot be edited by hand",
            )
