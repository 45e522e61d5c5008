"""When a task counts as compiled: run before, with exactly these files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from model import jit as machine_code
from model.jit import KernelSet

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache, and two kernels; their content is read again at each question."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(machine_code, "_version", machine_code._version.__wrapped__)
    monkeypatch.setattr(machine_code, "cache_folder", machine_code.cache_folder.__wrapped__)
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


@pytest.mark.parametrize("change", ["edited", "added", "elsewhere"])
def test_code_that_numba_would_not_find_does_not_count(cache: Path, change: str) -> None:
    machine_code.note_compiled(task(cache / "kernels", "optimal"))
    kernels = cache / "kernels"
    match change:
        case "edited":
            stat = (kernels / "edge.py").stat()
            (kernels / "edge.py").write_text("A kernel")
            os.utime(kernels / "edge.py", ns=(stat.st_atime_ns, stat.st_mtime_ns))
        case "added":
            (kernels / "ball.py").write_text("a third")
        case "elsewhere":
            kernels.rename(cache / "moved")
            kernels = cache / "moved"
    assert not machine_code.is_compiled(task(kernels, "optimal"))


@pytest.mark.parametrize("by_date", [False, True])
def test_touched_files_are_compiled_again_only_where_numba_goes_by_the_date(
    cache: Path, monkeypatch: pytest.MonkeyPatch, by_date: bool
) -> None:
    """As after `git checkout` to and fro, `rsync`, or the build of a container's image."""
    monkeypatch.setattr(machine_code, "_FINDS_BY_DATE", by_date)
    machine_code.note_compiled(task(cache / "kernels", "optimal"))
    os.utime(cache / "kernels" / "edge.py", ns=(0, 0))
    assert machine_code.is_compiled(task(cache / "kernels", "optimal")) is not by_date


def test_how_numba_finds_machine_code_is_known(cache: Path) -> None:
    """The oracle is Numba's own mark of a file's state."""
    kernel = cache / "kernels" / "edge.py"
    kernel.write_text("def edge():\n    return 1\n")
    states: dict[str, object] = {}
    exec(compile(kernel.read_text(), str(kernel), "exec"), states)
    marks = []
    for date in (10**18, 2 * 10**18):
        os.utime(kernel, ns=(date, date))
        cached = numba.njit(cache=True)(states["edge"])._cache
        marks.append(cached._impl.locator.get_source_stamp())
    assert (marks[0] != marks[1]) == machine_code._FINDS_BY_DATE


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


@pytest.mark.parametrize("setting", ["NUMBA_CPU_NAME=generic", "NUMBA_CPU_FEATURES="])
def test_code_for_another_processor_does_not_count(tmp_path: Path, setting: str) -> None:
    """A home on a file server, or a container, moves between computers."""
    run = (
        "from pathlib import Path; from model.jit import *;"
        f" task = KernelSet('maps', (Path({str(tmp_path)!r}),));"
        " print(is_compiled(task)); note_compiled(task)"
    )
    here = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_CPU_")}
    here |= {"NUMBA_CACHE_DIR": str(tmp_path)}
    there = here | dict([setting.split("=")])
    found = [
        subprocess.check_output([sys.executable, "-c", run], cwd=ROOT, env=where, text=True).strip()
        for where in (here, there, here, there)
    ]
    assert found == ["False", "False", "True", "True"]


def test_code_for_another_python_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    find, version = machine_code.cache_folder.__wrapped__, machine_code._version.__wrapped__
    monkeypatch.setattr(machine_code, "_version", version)
    here = find(tmp_path)
    assert find(tmp_path) == here
    monkeypatch.setattr(sys.implementation, "cache_tag", "cpython-399")
    assert find(tmp_path) != here
