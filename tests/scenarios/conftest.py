"""Short prepared runs of both example rigs."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from executor.trajectory.setpoints import PreparedRun, prepare
from model.files.documents import millimetres
from model.plan import load_plan, save_plan
from model.pose import Pose
from model.rig import load_rig
from model.scene import load_scene
from planner.check import verify
from tests.cli.plans import (
    CONFIGS,
    HALL,
    RIG,
    rig_with_long_cycles,
    straight_plan,
    write_short_plan,
)


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
def slow_rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's rig for tests in real time, which a busy host must not spoil."""
    return rig_with_long_cycles(tmp_path_factory.mktemp("slow"))


@pytest.fixture(scope="session")
def slow_run(short_plan: Path, slow_rig: Path) -> PreparedRun:
    """The short plan on that rig."""
    return prepare(verify(load_plan(short_plan)), load_rig(slow_rig))


@pytest.fixture(scope="session")
def hall_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 150 mm of the hall robot's path, with its payload, pulleys and ten cables."""
    scene = load_scene(CONFIGS / "hall_pillar.yaml")
    corners = [(700.0, 0.0, 900.0), (620.0, 40.0, 1020.0)]
    scene = scene.changed(goal=Pose.level(millimetres(list(corners[1]))))
    path = tmp_path_factory.mktemp("hall") / "plan.json"
    save_plan(straight_plan(load_rig(HALL), scene, corners), path)
    return path
