"""The shape of the product: `tools/house/shape.py` measures it, the limits are here.

An exception that is no longer needed fails its test too, so the lists of exceptions only shrink.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
MOST_FILES, MOST_LINES, MOST_IN_FUNCTION = 20, 450, 80
FULL_FOLDERS: set[str] = set()
LONG_MODULES: set[str] = set()
LONG_FUNCTIONS: set[str] = set()
CIRCLES: list[list[str]] = []
#: Modules that import inside functions, by the reason; all others import at their top.
INNER_IMPORTS: dict[str, set[str]] = {
    "a heavy library is loaded by the few calls that need it": {
        "cdpr/__init__.py",
        "cdpr/console/watch.py",
        "executor/cameras/process.py",
        "executor/recording/run_folder.py",
        "executor/report/figures.py",
        "executor/report/tiles.py",
        "executor/run_result.py",
        "model/shapes.py",
        "model/plan.py",
        "model/rig.py",
        "model/statics/tension_distribution.py",
        "planner/campaign/page.py",
        "planner/workspace/figures.py",
    },
    "of several protocols, back ends or planners one is loaded": {
        "drivers/can_bus.py",
        "drivers/factory.py",
        "drivers/stopping_distance.py",
        "executor/cameras/open.py",
        "executor/drives.py",
        "executor/homing.py",
        "planner/planning.py",
        "simulation/factory.py",
    },
    "an extra may not be installed": {
        "drivers/odrive/messages.py",
        "planner/parallel.py",
        "tracking/detection/detector.py",
    },
    "compiled kernels are loaded when their machine code is wanted": {
        "executor/kernels.py",
        "planner/workspace/maps.py",
    },
    "an installation is examined of which a part may be missing": {"executor/doctor.py"},
    "the real-time process and the start of a run must not wait for it": {
        "executor/report/__init__.py",
        "executor/runner.py",
    },
}


@pytest.fixture(scope="module")
def shape() -> Iterator[Any]:
    sys.path.insert(0, str(ROOT / "tools" / "house"))
    import shape

    yield shape
    sys.path.remove(str(ROOT / "tools" / "house"))
    sys.modules.pop("shape")


@pytest.fixture(scope="module")
def house(shape: Any) -> Any:
    return shape.House(ROOT)


def test_no_folder_is_overfull(house: Any) -> None:
    assert {f for f, n in house.folders().items() if n > MOST_FILES} == FULL_FOLDERS


def test_no_module_is_too_long(house: Any) -> None:
    assert {m.path for m in house.modules if m.lines > MOST_LINES} == LONG_MODULES


def test_no_function_is_too_long(house: Any) -> None:
    long = {name for lines, name in house.functions() if lines > MOST_IN_FUNCTION}
    assert long == LONG_FUNCTIONS


def test_no_modules_import_each_other_in_a_circle(house: Any) -> None:
    assert house.circles() == CIRCLES


def test_no_import_runs_back_up(house: Any) -> None:
    assert house.back_arrows() == []


def test_an_import_inside_a_function_has_a_reason(house: Any) -> None:
    explained = sorted(path for paths in INNER_IMPORTS.values() for path in paths)
    assert sorted(m.path for m in house.modules if m.inner_imports()) == explained


def test_only_the_command_line_prints_and_asks(house: Any) -> None:
    printing = [m.path for m in house.modules if m.prints()]
    assert [path for path in printing if not path.startswith("cdpr/cli/")] == []


def test_every_package_names_what_is_public(house: Any) -> None:
    """Calibration has a result of its own for each of its verbs, the executor a function."""
    for package in (name for name in house.by_name if "." not in name and name != "cdpr"):
        most = {"calibration": 19, "executor": 13}.get(package, 12)
        assert 5 <= len(house.by_name[package].exported()) <= most, package
    assert 25 <= len(house.by_name["cdpr"].exported()) <= 40


def test_documentation_lines_fit_a_screen(house: Any) -> None:
    assert house.long_lines() == []


def test_no_two_classes_have_one_name(house: Any) -> None:
    assert house.namesakes() == {}


def test_what_breaks_a_limit_is_found(shape: Any, tmp_path: Path) -> None:
    body = "\n".join(["    x = 1"] * 81)
    for path, text in {
        "model/a.py": "import model.b\n",
        "model/b.py": "def f():\n    from model import a\n",
        "planner/c.py": f"import executor.d\nprint(1)\ndef long():\n{body}\n",
        "executor/d.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import cdpr.e\n",
        "cdpr/e.py": "class E: ...\n",
        "tracking/e.py": "class E: ...\n",
        "docs/page.md": "\n".join(["| " + "x" * 130, "y " * 70, "[l](" + "z" * 130 + ")", ""]),
    }.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text)
    house = shape.House(tmp_path)
    assert house.circles() == [["model.a", "model.b"]]
    assert house.back_arrows() == ["planner.c -> executor.d"]
    assert house.functions()[0] == (82, "planner/c.py:long")
    assert house.namesakes() == {"E": ["cdpr.e", "tracking.e"]}
    assert [m.path for m in house.modules if m.prints()] == ["planner/c.py"]
    assert house.long_lines() == ["docs/page.md:2"]
    assert house.folders()["model"] == 2
