"""Arrays kept in the user's cache, damaged or not."""

from __future__ import annotations

import os

import numpy as np
import pytest

from planner.kernels import jit as stored

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


@pytest.mark.parametrize("failing", ["NamedTemporaryFile", "replace"])
def test_a_cache_that_cannot_be_written_is_ignored(folder, made, monkeypatch, failing) -> None:
    def refuse(*_args, **_options):
        raise OSError(30, "Read-only file system")

    owner = stored.tempfile if failing == "NamedTemporaryFile" else stored.os
    monkeypatch.setattr(owner, failing, refuse)
    assert np.array_equal(take(made), take(made))
    assert made.times == 2
    assert not list(folder.iterdir())


def test_without_a_folder_every_run_computes(made, monkeypatch) -> None:
    monkeypatch.setattr(stored, "cache_folder", lambda *_: None)
    take(made)
    take(made)
    assert made.times == 2
