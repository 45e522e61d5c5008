"""Arrays kept in the user's cache, damaged or not."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.files.documents import content_hash
from model.rig import load_rig
from model.scene import load_scene
from planner.anytime import problem
from planner.costs import KinematicCost
from planner.kernels import jit as stored
from planner.settings import Weights

CONFIGS = Path(__file__).parents[3] / "configs"
KEY = ["rig", {"mass": 0.4}]


@pytest.fixture
def made():
    """Counts how often the array was computed."""

    def compute() -> np.ndarray:
        compute.times += 1
        return np.arange(6.0).reshape(2, 3)

    compute.times = 0
    return compute


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "cache_folder", lambda *_: tmp_path)
    return tmp_path


def take(made, key=KEY, shape=(2, 3)):
    return stored.stored("margins", key, shape, made)


def test_an_array_is_computed_once_for_a_key(folder, made) -> None:
    assert np.array_equal(take(made), take(made))
    assert made.times == 1
    take(made, key=["another rig"])
    assert made.times == 2
    assert len(list(folder.glob("margins-*.npy"))) == 2


def test_the_oldest_arrays_beyond_the_limit_are_deleted(folder, made, monkeypatch) -> None:
    monkeypatch.setattr(stored, "_MOST_FILES", 3)
    for number in range(6):
        take(made, key=[number])
        for file in folder.glob("*.npy"):  # the clock of files is too coarse to distinguish them
            os.utime(file, (0, file.stat().st_mtime - 1))
    assert len(list(folder.glob("margins-*.npy"))) == 3
    take(made, key=[5])
    assert made.times == 6
    take(made, key=[0])
    assert made.times == 7


@pytest.mark.parametrize("damage", ["cut off", "empty", "text", "pickled", "other shape"])
def test_a_damaged_file_is_ignored_and_replaced(folder, made, damage) -> None:
    take(made)
    (file,) = folder.iterdir()
    content = file.read_bytes()
    if damage == "pickled":
        np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    elif damage == "other shape":
        np.save(file, np.zeros((3, 2)))
    else:
        file.write_bytes({"cut off": content[:-9], "empty": b"", "text": b"not an array"}[damage])
    assert np.array_equal(take(made), np.arange(6.0).reshape(2, 3))
    assert made.times == 2
    assert file.read_bytes() == content
    assert list(folder.iterdir()) == [file]


@pytest.mark.parametrize("failing", ["tempfile.mkstemp", "os.fsync"])
def test_a_cache_that_cannot_be_written_is_ignored(folder, made, monkeypatch, failing) -> None:
    def refuse(*_args, **_options):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(failing, refuse)
    assert np.array_equal(take(made), take(made))
    assert made.times == 2
    assert not list(folder.iterdir())


def test_without_a_folder_every_run_computes(made, monkeypatch) -> None:
    monkeypatch.setattr(stored, "cache_folder", lambda *_: None)
    take(made)
    take(made)
    assert made.times == 2


@pytest.fixture
def rig():
    return load_rig(CONFIGS / "gachon_8_6.yaml")


def test_costs_of_a_copy_with_other_values_are_not_those_of_the_rig(rig, folder) -> None:
    """Both had one file: the rig's next plan stated the copy's costs, in every later process."""
    rotation = rig.home.rotation
    wanted = KinematicCost(rig, rotation).extremes
    for file in folder.iterdir():
        file.unlink()
    for other in (
        replace(rig, anchors=1.6 * rig.anchors),
        replace(rig, outlets=1.1 * rig.outlets),
        replace(rig, workspace_upper=rig.workspace_upper - 0.01),
        replace(rig, max_tension=2.0 * rig.max_tension),
    ):
        assert KinematicCost(other, rotation).extremes != wanted
    assert KinematicCost(rig, rotation).extremes == wanted


def test_arrays_of_a_problem_are_stored_by_the_values_they_are_computed_from(
    rig, monkeypatch
) -> None:
    scene, keys = load_scene(CONFIGS / "environment_1.yaml"), []
    kinematic = KinematicCost(rig, scene.start.rotation)

    def noted(name, key, shape, _compute):
        keys.append((name, content_hash([np.asarray(part).tolist() for part in key])))
        return np.zeros(shape)

    monkeypatch.setattr(problem, "stored", noted)
    monkeypatch.setattr(problem, "build_robot", lambda *_: None)  # it compiles for long
    heavier = replace(scene.load, payload_mass=scene.load.payload_mass + 0.1)
    for the_rig, the_scene in (
        (rig, scene),
        (rig, scene.changed(clearance=0.02)),
        (replace(rig, anchors=1.01 * rig.anchors), scene),
        (replace(rig, mass=2.0 * rig.mass), scene),
        (replace(rig, max_tension=0.9 * rig.max_tension), scene),
        (rig, replace(scene, load=heavier)),
    ):
        problem.problem_of(the_rig, the_scene, Weights(length=1.0), kinematic)
    assert len(keys) == 12  # two names, and one key for each robot and load
    assert len({*keys}) == 10
