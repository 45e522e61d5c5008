"""`tools/hil` keeps the results of each part in a folder of its own, and names what it lacks."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """The program where tools are missing, with a cache of its own."""
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "hil"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    import run

    def lack_tools() -> None:
        raise run.VmFailed("tools are missing")

    monkeypatch.setattr(run, "_require_tools", lack_tools)
    yield run
    for name in ("run", "kernel", "vm"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("arguments", [[], ["-m", "hil and not slow"], ["--part", "table"]])
def test_a_run_deletes_the_results_of_its_own_part_only(
    tool: Any, arguments: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A subset of all tests runs for CI, maybe beside a part that writes for half an hour."""
    kept = {part: tool._cache() / "last" / part / "figures.txt" for part in tool.PARTS}
    for figures in kept.values():
        figures.parent.mkdir(parents=True, exist_ok=True)
        figures.touch()
    monkeypatch.setattr(sys, "argv", ["run.py", *arguments])
    assert tool.main() == tool.NO_BUS
    deleted = {part for part, figures in kept.items() if not figures.exists()}
    assert deleted == {"table" if "table" in arguments else "all"}


@pytest.mark.parametrize("code", [0, 100])
def test_a_distribution_without_debian_s_kernel_is_advised_to_load_the_module(
    tool: Any, code: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As on Ubuntu, whose apt ends with 100 for an unknown package."""
    apt = tmp_path / "apt-cache"
    apt.write_text(f"#!/bin/sh\nexit {code}\n")
    apt.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(tool.VmFailed, match="sudo modprobe vcan"):
        sys.modules["kernel"]._package_name()
