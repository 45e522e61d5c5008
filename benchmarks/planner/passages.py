"""The suite of narrow passages, `narrow.yaml`, as rigs and scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Array
from model.rig import Rig, load_rig, rig_from_document
from model.scene import Scene, scene_from_document

_SUITE = Path(__file__).with_name("narrow.yaml")
_RIG = Path(__file__).parents[2] / "configs" / "gachon_8_6.yaml"


@dataclass(frozen=True, eq=False)
class Passage:
    """One row of the suite.

    Attributes:
        name: Kind of passage.
        gap: Lateral play of the platform in it, [m].
        rig: With a workspace box that leaves no other path.
        scene: Obstacles, start and goal.
        path: A path through it, shape (k, 3), [m].
    """

    name: str
    gap: float
    rig: Rig
    scene: Scene
    path: Array


def passages() -> list[Passage]:
    """The whole suite."""
    rig = load_rig(_RIG).document.model_dump(mode="json")
    listed = yaml.safe_load(_SUITE.read_text(encoding="utf-8"))["passages"]
    return [_passage(rig, entry) for entry in listed]


def _passage(rig: dict[str, Any], entry: dict[str, Any]) -> Passage:
    path = entry["path_mm"]
    scene = {
        "schema_version": 1,
        "name": f"{entry['name']} {entry['gap_mm']:g} mm",
        "start": {"position_mm": path[0]},
        "goal": {"position_mm": path[-1]},
        "obstacles": entry["obstacles"],
    }
    return Passage(
        entry["name"],
        entry["gap_mm"] / 1e3,
        rig_from_document(RigDocument.model_validate(rig | {"workspace": entry["workspace"]})),
        scene_from_document(SceneDocument.model_validate(scene)),
        np.array(path) / 1e3,
    )
