"""What an import loads: heavy libraries load only when a command needs them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEAVY = ("scipy", "cv2", "fcl", "numba", "matplotlib", "can", "canopen", "daqp", "mcap")


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
        "model.rig",
        "model.scene",
        "model.plan",
        "model.kinematics",
        "cdpr.cli.app",
        "cdpr",
        "calibration",
        "executor",
        "simulation",
        "planner",
        "drivers",
        "tracking",
    ],
)
def test_an_import_of_the_model_or_the_command_line_is_light(module: str) -> None:
    assert loaded_by(f"import {module}") == set()


def test_the_public_api_loads_nothing_before_it_is_used() -> None:
    code = "import cdpr, sys; assert not {'numpy', 'pydantic', 'model.rig'} & set(sys.modules)"
    assert loaded_by(code) == set()


def test_the_help_of_the_command_line_is_light() -> None:
    code = (
        "import sys, contextlib; sys.argv = ['cdpr', '--help']; from cdpr.cli.app import main\n"
        "with contextlib.suppress(SystemExit): main()\n"
        "pass"
    )
    assert loaded_by(code) == set()


@pytest.mark.parametrize("words", ["cdpr ", "cdpr pl", "cdpr calibrate ca"])
def test_completion_of_a_verb_imports_no_verb(words: str) -> None:
    result = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", "from cdpr.cli import main; main()"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "_CDPR_COMPLETE": "complete_bash",
            "_TYPER_COMPLETE_ARGS": words,
            "COMP_WORDS": words,
            "COMP_CWORD": str(len(words.split(" ")) - 1),
        },
    )
    loaded = {line.rsplit("|", 1)[-1].strip() for line in result.stderr.splitlines()}
    assert "cdpr.cli.app" in loaded
    assert {name for name in loaded if name.startswith("cdpr.cli.")} <= {
        "cdpr.cli.app",
        "cdpr.cli.arguments",
    }
    assert loaded.isdisjoint({"numpy", *HEAVY})


def test_reading_the_example_files_is_light() -> None:
    code = (
        "from pathlib import Path; from model.rig import load_rig;"
        " from model.scene import load_scene;"
        " load_rig(Path('configs/gachon_8_6.yaml')); load_scene(Path('configs/environment_3.yaml'))"
    )
    assert loaded_by(code) == set()


@pytest.mark.parametrize("module", ["operate.requests", "start"])
def test_verbs_that_must_be_fast_are_light(module: str) -> None:
    """`cdpr stop` above all."""
    assert loaded_by(f"import cdpr.cli.{module}") == set()


@pytest.mark.parametrize("module", ["cdpr.cli.check", "executor.trajectory.setpoints"])
def test_what_neither_searches_nor_measures_nor_sends_loads_no_library_for_it(module: str) -> None:
    assert not loaded_by(f"import {module}") & {"numba", "scipy", "cv2", "can"}


def test_the_real_time_process_of_a_real_bus_loads_no_compiler_and_no_camera() -> None:
    """It loads everything before the drives are set up, while the operator waits."""
    code = "import executor.realtime.child, executor.control.path_runs, executor.drives"
    assert not loaded_by(code) & {"numba", "cv2", "matplotlib", "mcap"}


def test_the_supervisor_of_a_run_loads_no_tracker() -> None:
    """Only the processes of cameras track."""
    code = "import executor.runner, executor.homing, executor.winch_runs"
    assert not loaded_by(code) & {"numba", "scipy", "matplotlib"}
