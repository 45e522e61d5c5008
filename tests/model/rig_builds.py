"""Rigs and scenes for the tests of this folder, from the example files and changes to them."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import strategies as st

from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig, rig_from_document
from model.scene import Scene, scene_from_document

CONFIGS = Path(__file__).parents[2] / "configs"

# IPAnema 1 as in CASPR (IPAnema1_cables.xml, cable set "original"), [m].
IPANEMA_OUTLETS = [
    [-2.0, 1.5, 2.0],
    [2.0, 1.5, 2.0],
    [2.0, -1.5, 2.0],
    [-2.0, -1.5, 2.0],
    [-2.0, 1.5, 0.0],
    [2.0, 1.5, 0.0],
    [2.0, -1.5, 0.0],
    [-2.0, -1.5, 0.0],
]
IPANEMA_ANCHORS = [
    [-0.06, 0.06, 0.0],
    [0.06, 0.06, 0.0],
    [0.06, -0.06, 0.0],
    [-0.06, -0.06, 0.0],
] * 2


def plain(name: str) -> dict[str, Any]:
    """The keys and values of an example file."""
    data: dict[str, Any] = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8"))
    return data


_PAPER, _HALL, _SCENE = plain("gachon_8_6"), plain("hall_10_6"), plain("environment_3")


def paper_data() -> dict[str, Any]:
    return copy.deepcopy(_PAPER)


def hall_data() -> dict[str, Any]:
    return copy.deepcopy(_HALL)


def scene_data() -> dict[str, Any]:
    return copy.deepcopy(_SCENE)


def rig_of(data: dict[str, Any]) -> Rig:
    return rig_from_document(RigDocument.model_validate(data))


def scene_of(data: dict[str, Any]) -> Scene:
    return scene_from_document(SceneDocument.model_validate(data))


def paper_rig() -> Rig:
    return rig_of(paper_data())


def hall_rig() -> Rig:
    return rig_of(hall_data())


def paper_rig_with_pulleys(radius_mm: float, feed: list[float] | None = None) -> Rig:
    """The paper's rig with its outlets as the points where the cables enter pulleys."""
    data = paper_data()
    up, down = feed or [0, 0, 1], feed or [0, 0, -1]
    data["pulleys"] = {"radius_mm": radius_mm, "feed_directions": [up] * 4 + [down] * 4}
    return rig_of(data)


def ipanema() -> Rig:
    data = paper_data()
    data["outlets_mm"] = [[1000.0 * x for x in point] for point in IPANEMA_OUTLETS]
    data["anchors_mm"] = [[1000.0 * x for x in point] for point in IPANEMA_ANCHORS]
    return rig_of(data)


def poses_of(rig: Rig, largest_angle_deg: float = 25.0) -> st.SearchStrategy[Pose]:
    """Poses in the middle four fifths of a rig's workspace, rotated about any axis."""
    share = st.floats(0.1, 0.9)
    part = st.floats(-1.0, 1.0)
    angle = np.radians(largest_angle_deg)

    def pose(shares: tuple[float, ...], turn: tuple[float, ...]) -> Pose:
        span = rig.workspace_upper - rig.workspace_lower
        vector = np.array(turn)
        vector *= angle / max(1.0, float(np.linalg.norm(vector)))
        position = rig.workspace_lower + np.array(shares) * span
        return Pose(position, matrix_from_rotation_vector(vector))

    return st.builds(pose, st.tuples(share, share, share), st.tuples(part, part, part))
