"""What an import loads: the heavy libraries wait until a command needs them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEAVY = ("scipy", "cv2", "fcl", "numba", "matplotlib", "ruckig", "can", "canopen", "daqp", "mcap")


def loaded_by(code: str) -> set[str]:
    """The heavy libraries that a fresh interpreter has loaded after some code."""
    tail = f"; import sys, json; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    result = subprocess.run(
        [sys.executable, "-c", code + tail],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    return set(json.loads(result.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    "module",
    [
        "cdpr.rig",
        "cdpr.scene",
        "cdpr.plan",
        "cdpr.kinematics",
        "cdpr.schema",
        "cdpr.cli.app",
    ],
)
def test_an_import_of_the_model_or_the_command_line_is_light(module: str) -> None:
    assert loaded_by(f"import {module}") == set()


def test_the_help_of_the_command_line_is_light() -> None:
    code = (
        "import sys, contextlib; sys.argv = ['cdpr', '--help']; from cdpr.cli.app import main\n"
        "with contextlib.suppress(SystemExit): main()\n"
        "pass"
    )
    assert loaded_by(code) == set()


def test_reading_the_ready_files_is_light() -> None:
    code = (
        "from pathlib import Path; from cdpr.rig import load_rig;"
        " from cdpr.scene import load_scene;"
        " load_rig(Path('configs/gachon_8_6.yaml')); load_scene(Path('configs/environment_3.yaml'))"
    )
    assert loaded_by(code) == set()
