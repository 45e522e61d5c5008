"""Short prepared runs of both ready rigs."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from cdpr.document_types import millimetres
from cdpr.plan import load_plan, save_plan
from cdpr.poses import Pose
from cdpr.rig import load_rig
from cdpr.scene import load_scene
from executor.prepare import PreparedRun, prepare
from planner.check import verify
from tests.cli.plans import CONFIGS, HALL, RIG, straight_plan, write_short_plan


@pytest.fixture(autouse=True)
def own_announcements(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`cdpr stop` of a test reaches the runs of that test alone; its faults latch nothing else."""
    temporary = tmp_path_factory.mktemp("tmp")
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(temporary))
    monkeypatch.setenv("XDG_STATE_HOME", str(temporary / "state"))
    monkeypatch.setattr(tempfile, "tempdir", None)


@pytest.fixture(scope="session")
def short_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A straight path of 58 mm of the paper's rig."""
    return write_short_plan(tmp_path_factory.mktemp("plan") / "plan.json")


@pytest.fixture(scope="session")
def prepared(short_plan: Path) -> PreparedRun:
    """The same, checked and with its set-points."""
    return prepare(verify(load_plan(short_plan)), load_rig(RIG))


@pytest.fixture(scope="session")
def hall_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 150 mm of the hall robot's way, with its payload, pulleys and ten cables."""
    scene = load_scene(CONFIGS / "hall_pillar.yaml")
    corners = [(700.0, 0.0, 900.0), (620.0, 40.0, 1020.0)]
    scene = scene.changed(goal=Pose.level(millimetres(list(corners[1]))))
    path = tmp_path_factory.mktemp("hall") / "plan.json"
    save_plan(straight_plan(load_rig(HALL), scene, corners), path)
    return path
