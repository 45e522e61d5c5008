"""Machine code is made once, before the processes that need it."""

from __future__ import annotations

import pytest

from cdpr import machine_code
from cdpr.cli import compiling
from tracking import edges


@pytest.mark.parametrize("is_there", [False, True])
def test_the_edge_finder_is_compiled_before_processes_begin_unless_it_is_there(
    is_there: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded: list[str] = []
    monkeypatch.setattr(machine_code, "is_compiled", lambda task: is_there)
    monkeypatch.setattr(machine_code, "note_compiled", lambda task: None)
    monkeypatch.setattr(edges, "load_kernels", lambda: loaded.append("edges"))
    compiling.ready_for_processes(shown=False)
    assert loaded == ([] if is_there else ["edges"])
    assert ("compiling the tags' edge finder" in capsys.readouterr().err) == (not is_there)
