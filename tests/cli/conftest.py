"""A plan and a run shared by all tests of the command line."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from model import jit as machine_code
from tests.cli.plans import RIG, write_short_plan
from tests.cli.program import Answer, call


@pytest.fixture(autouse=True)
def plain_terminal(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """No colour forced from outside, own folders for announcements and error files, and nothing
    shown about machine code that is not compiled yet."""
    for name in ("FORCE_COLOR", "PY_COLORS", "GITHUB_ACTIONS", "TTY_COMPATIBLE", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    temporary = tmp_path_factory.mktemp("tmp")
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(machine_code, "is_compiled", lambda task: True)
    return temporary


@pytest.fixture(scope="session")
def short_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan of the paper's rig that takes about 3 s."""
    return write_short_plan(tmp_path_factory.mktemp("plan") / "plan.json")


@pytest.fixture(scope="session")
def finished_run(short_plan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of that plan without a camera."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    answer: Answer = call("run", short_plan, "--rig", RIG, "-o", folder, "--fast", "--no-camera")
    assert answer.code == 0, answer
    return folder
