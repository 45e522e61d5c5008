"""The example rigs and scenes, and scenes built from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from model.files.scene_file import SceneDocument
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene, scene_from_document

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="session")
def gachon() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


@pytest.fixture(scope="session")
def hall() -> Rig:
    return load_rig(CONFIGS / "hall_10_6.yaml")


@pytest.fixture(scope="session")
def open_frame() -> Rig:
    return load_rig(CONFIGS / "open_frame_8_6.yaml")


@pytest.fixture(scope="session")
def ready_scene() -> Callable[[str], Scene]:
    return lambda name: load_scene(CONFIGS / f"{name}.yaml")


@pytest.fixture(scope="session")
def scene_with() -> Callable[..., Scene]:
    """A scene from parts of a scene file; start and goal at the gachon rig's home if not given."""

    def make(*obstacles: dict[str, Any], **parts: Any) -> Scene:
        document: dict[str, Any] = {
            "schema_version": 1,
            "name": "test",
            "start": {"position_mm": [0.0, 0.0, 445.0]},
            "goal": {"position_mm": [0.0, 0.0, 445.0]},
            "obstacles": list(obstacles),
        }
        return scene_from_document(SceneDocument.model_validate(document | parts))

    return make
