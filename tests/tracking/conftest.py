from __future__ import annotations

from pathlib import Path

import pytest

from model.rig import Camera, Rig, load_rig
from model.scene import Scene, load_scene
from simulation.camera.camera import SyntheticCamera

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


@pytest.fixture(scope="session")
def scene() -> Scene:
    return load_scene(CONFIGS / "environment_1.yaml")


@pytest.fixture(scope="session")
def camera(rig: Rig) -> Camera:
    return rig.cameras[0]


@pytest.fixture(scope="session")
def synthetic(rig: Rig, scene: Scene, camera: Camera) -> SyntheticCamera:
    return SyntheticCamera(rig, scene, camera, seed=7)
