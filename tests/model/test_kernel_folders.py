"""The cache of machine code: which folders are kept, and which are deleted."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from model import jit as compiled
from model.jit import UNUSED, delete_unused, use_folder

NOW = 1.8e9
OLD, RECENT = NOW - UNUSED - 1.0, NOW - UNUSED + 1.0


def made(parent: Path, name: str, used: float) -> Path:
    folder = parent / name
    folder.mkdir(parents=True)
    (folder / "kernel.nbc").write_bytes(b"code")
    os.utime(folder, (used, used))
    return folder


def test_only_versions_unused_for_long_are_deleted(tmp_path: Path) -> None:
    old, recent = made(tmp_path, "a" * 16, OLD), made(tmp_path, "b" * 16, RECENT)
    other = made(tmp_path, "somebody-elses", OLD)
    left_over = made(tmp_path, "removed-x1_y2", OLD)
    delete_unused(tmp_path, NOW)
    assert not old.exists()
    assert not left_over.exists()
    assert sorted(tmp_path.iterdir()) == sorted([recent, other])
    assert (recent / "kernel.nbc").read_bytes() == b"code"


def test_a_version_in_use_is_kept_at_any_age_and_deleted_once_released(tmp_path: Path) -> None:
    folder = made(tmp_path, "c" * 16, NOW)
    lock = os.open(folder / "in-use", os.O_RDWR | os.O_CREAT)
    fcntl.flock(lock, fcntl.LOCK_SH)
    os.utime(folder, (OLD, OLD))
    delete_unused(tmp_path, NOW)
    assert (folder / "kernel.nbc").exists()
    os.close(lock)
    delete_unused(tmp_path, NOW)
    assert list(tmp_path.iterdir()) == []


def test_using_a_version_locks_it_and_a_new_one_deletes_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    parent = tmp_path / "cdpr" / "kernels"
    old = made(parent, "d" * 16, 1e9)
    first = use_folder("e" * 16)
    assert first == parent / ("e" * 16)
    assert not old.exists()
    os.utime(first, (1e9, 1e9))  # as if used for days by this process, which holds it
    assert use_folder("f" * 16) == parent / ("f" * 16)
    assert first.exists()
    assert use_folder("e" * 16) == first
    assert first.stat().st_mtime > 1e9


def test_a_folder_that_the_user_named_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    old = made(tmp_path, "a" * 16, 1e9)
    assert use_folder("b" * 16) == tmp_path / ("b" * 16)
    assert old.exists()


@pytest.mark.parametrize("cache_home", ["cache", ""])
def test_a_cache_home_that_is_not_absolute_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache_home: str
) -> None:
    """As the XDG specification has it; else each working folder would get its own cache."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", cache_home)
    assert use_folder("e" * 16) == tmp_path / "home" / ".cache" / "cdpr" / "kernels" / ("e" * 16)
    assert list((tmp_path / "here").iterdir()) == []


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """A folder of kernels."""
    folder = tmp_path / "sources"
    folder.mkdir()
    (folder / "line.py").write_text("a kernel")
    return folder


def test_the_cache_is_the_given_folder_and_none_where_nothing_can_be_written(
    sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = compiled.cache_folder.__wrapped__
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    folder = find(sources)
    assert folder is not None
    assert folder.parent == tmp_path / "given"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert find(sources) == tmp_path / "cdpr" / "kernels" / folder.name
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert find(sources) is None


@pytest.mark.parametrize("changed", ["own", "called"])
def test_a_change_of_a_kernel_or_of_one_that_it_calls_starts_a_new_folder(
    changed: str, sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find, version = compiled.cache_folder.__wrapped__, compiled._version
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "given"))
    called = tmp_path / "called"
    called.mkdir()
    (called / "point.py").write_text("another")
    before = find(sources, called)
    version.cache_clear()
    assert find(sources, called) == before
    assert find(sources) != before
    (sources / "line.py" if changed == "own" else called / "point.py").write_text("a kernel, new")
    version.cache_clear()
    assert find(sources, called) != before


def test_kernels_without_a_cache_still_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "cache_folder", lambda sources: None)

    def twice(value: float) -> float:
        return 2.0 * value

    assert compiled.compiled(twice)(1.5) == 3.0
