"""Nothing moves without a held command, whatever happens at the consoles; the long one is a
benchmark: `python benchmarks/console_sequences.py`."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from tests.console.sequences import sequences


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No run of another program is seen here, and none is disturbed."""
    for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "cables"), [(1, False), (2, False), (1, True), (2, True)])
def test_nothing_moves_unless_a_page_in_control_holds(seed: int, cables: bool) -> None:
    figures = sequences(60, seed, cables=cables)
    assert figures.wrong == []
    assert figures.sequences >= 60
    assert figures.presses > 20
    assert figures.moving_cycles > 100, "it does move while it is held"
    assert figures.moving_cycles < figures.cycles
