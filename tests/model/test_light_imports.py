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


#: Code that must not load any of them.
LIGHT = (
    "import cdpr",
    "import calibration",
    "import executor",
    "import simulation",
    "import planner",
    "import drivers",
    "import tracking",
    "import model.rig",
    "import model.scene",
    "import model.plan",
    "import model.kinematics",
    "import cdpr.cli.app",
    "import cdpr.cli.operate.requests",  # `cdpr stop` above all
    "import cdpr.cli.start",
    "from pathlib import Path",
    "model.rig.load_rig(Path('configs/gachon_8_6.yaml'))",
    "model.scene.load_scene(Path('configs/environment_3.yaml'))",
)


def loaded_after(*steps: str) -> dict[str, set[str]]:
    """The heavy libraries that a fresh interpreter has loaded after each step."""
    code = (
        "import json, sys\n"
        "loaded = {}\n"
        f"for step in {steps!r}:\n"
        "    exec(step)\n"
        f"    loaded[step] = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "print(json.dumps(loaded))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    loaded = json.loads(result.stdout.splitlines()[-1])
    return {step: set(libraries) for step, libraries in loaded.items()}


def loaded_by(code: str) -> set[str]:
    """The heavy libraries that a fresh interpreter has loaded after some code."""
    return loaded_after(code)[code]


def test_importing_the_packages_and_reading_the_example_files_is_light() -> None:
    """In one interpreter, where what any step loads stays loaded."""
    assert loaded_after(*LIGHT) == {step: set() for step in LIGHT}


def test_the_public_api_loads_nothing_before_it_is_used() -> None:
    code = "import cdpr, sys; assert not {'numpy', 'pydantic', 'model.rig'} & set(sys.modules)"
    assert loaded_by(code) == set()


def test_the_help_of_the_command_line_is_light() -> None:
    code = (
        "import sys, contextlib; sys.argv = ['cdpr', '--help']; from cdpr.cli.app import main\n"
        "with contextlib.suppress(SystemExit): main()"
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
