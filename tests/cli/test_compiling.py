"""Machine code is made once, before the processes that need it."""

from __future__ import annotations

import pytest

from cdpr.cli.output import Terminal
from executor import kernels
from model import jit as machine_code
from tracking.edges import refine as edges


@pytest.mark.parametrize("is_there", [False, True])
def test_the_edge_finder_is_compiled_before_processes_begin_unless_it_is_there(
    is_there: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(machine_code, "is_compiled", lambda task: is_there)
    monkeypatch.setattr(machine_code, "note_compiled", lambda task: None)
    monkeypatch.setattr(edges, "load_kernels", lambda: loaded.append("edges"))
    kernels.ready_to_measure(Terminal(quiet=True), only_missing=True)
    assert loaded == ([] if is_there else ["edges"])
    assert ("compiling the tag edge detector" in capsys.readouterr().err) == (not is_there)


def test_a_simulated_platform_waits_for_its_code_before_a_drive_is_switched_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(machine_code, "is_compiled", lambda task: False)
    monkeypatch.setattr(machine_code, "note_compiled", lambda task: loaded.append(task.name))
    kernels.ready_to_simulate(Terminal(quiet=True))
    assert loaded == ["platform"]
    assert "compiling the simulated platform" in capsys.readouterr().err
