"""When a task counts as compiled: run before, with exactly these files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from model import jit as machine_code
from model.jit import KernelSet


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache, and two kernels."""
    monkeypatch.setattr(machine_code, "cache_folder", lambda _: tmp_path)
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    (kernels / "edge.py").write_text("a kernel")
    (kernels / "hull.py").write_text("another")
    return tmp_path


def task(kernels: Path, name: str) -> KernelSet:
    return KernelSet(name, (kernels,))


def test_a_task_is_compiled_once_it_has_run_and_the_others_are_not(cache: Path) -> None:
    assert not machine_code.is_compiled(task(cache / "kernels", "optimal"))
    machine_code.note_compiled(task(cache / "kernels", "optimal"))
    assert machine_code.is_compiled(task(cache / "kernels", "optimal"))
    assert not machine_code.is_compiled(task(cache / "kernels", "turning"))


@pytest.mark.parametrize("change", ["touched", "edited", "added", "elsewhere"])
def test_code_that_numba_would_not_find_does_not_count(cache: Path, change: str) -> None:
    machine_code.note_compiled(task(cache / "kernels", "optimal"))
    kernels = cache / "kernels"
    match change:
        case "touched":
            os.utime(kernels / "edge.py", ns=(0, 0))
        case "edited":
            stat = (kernels / "edge.py").stat()
            (kernels / "edge.py").write_text("a kernel, longer")
            os.utime(kernels / "edge.py", ns=(stat.st_atime_ns, stat.st_mtime_ns))
        case "added":
            (kernels / "ball.py").write_text("a third")
        case "elsewhere":
            kernels.rename(cache / "moved")
            kernels = cache / "moved"
    assert not machine_code.is_compiled(task(kernels, "optimal"))


def test_without_a_folder_nothing_counts_as_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_code, "cache_folder", lambda _: None)
    machine_code.note_compiled(task(Path("kernels"), "maps"))
    assert not machine_code.is_compiled(task(Path("kernels"), "maps"))


def test_a_stamp_that_cannot_be_written_is_ignored(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine_code, "cache_folder", lambda _: cache / "gone")
    machine_code.note_compiled(task(Path("kernels"), "maps"))
    assert not machine_code.is_compiled(task(Path("kernels"), "maps"))
