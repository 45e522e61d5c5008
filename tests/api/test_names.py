"""The public names of each package: they exist, editors see them, and nothing loads them early."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cdpr
from calibration.targets.boards import Charuco
from calibration.targets.grids import CircleGrid
from cdpr import operation
from tests.cli.plans import write_short_plan

ROOT = Path(__file__).parents[2]
PACKAGES = (
    *("cdpr", "calibration", "executor", "simulation", "planner", "drivers", "tracking", "model"),
)


def imported_for_types(package: str) -> dict[str, str]:
    """Names below `if TYPE_CHECKING:` of a package, with their modules: what editors see."""
    tree = ast.parse((ROOT / package / "__init__.py").read_text())
    blocks = [n for n in tree.body if isinstance(n, ast.If) and "not" not in ast.unparse(n.test)]
    imports = [n for block in blocks for n in block.body if isinstance(n, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def loaded_from(package: str) -> dict[str, str]:
    """Public names of a package, with the modules that its table loads them from."""
    tree = ast.parse((ROOT / package / "__init__.py").read_text())
    (table,) = (node for node in ast.walk(tree) if isinstance(node, ast.Dict))
    origins: dict[str, str] = ast.literal_eval(table)
    return {name: module for module, names in origins.items() for name in names.split()}


@pytest.mark.parametrize("package", PACKAGES)
def test_names_are_loaded_from_the_module_that_editors_open(package: str) -> None:
    assert loaded_from(package) == imported_for_types(package)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_what_editors_see_under_it(package: str) -> None:
    module: Any = importlib.import_module(package)
    seen = imported_for_types(package)
    assert sorted(seen) == sorted(module.__all__)
    for name, home in seen.items():
        assert getattr(module, name) is getattr(importlib.import_module(home), name), name
        assert name in dir(module)
        assert getattr(module, name).__doc__, name


def test_every_function_for_scripts_is_a_public_name() -> None:
    """Some are only in `cdpr.operation`, which had no list of them."""
    own = {name: value for name, value in vars(operation).items() if inspect.isfunction(value)}
    defined = {name for name, value in own.items() if value.__module__ == operation.__name__}
    assert {name for name in defined if name[0] != "_"} == {*operation.__all__}


def undescribed(name: str, value: Any) -> list[str]:
    """Arguments of a function, or a class's methods, absent in a docstring that lists some."""
    if inspect.isclass(value):
        own = [one for one in vars(value).values() if inspect.isfunction(one)]
        public = [one for one in own if one.__name__ == "__init__" or one.__name__[0] != "_"]
        return [gap for one in public for gap in undescribed(f"{name}.{one.__name__}", one)]
    text = inspect.getdoc(value) or ""
    if "\nArgs:\n" not in text or not inspect.isroutine(value):
        return []
    arguments = [one for one in inspect.signature(value).parameters if one != "self"]
    return [f"{name}: {one}" for one in arguments if f"\n    {one}:" not in text.replace("*", "")]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_public_docstring_describes_all_arguments_or_none(package: str) -> None:
    module: Any = importlib.import_module(package)
    names = ((name, getattr(module, name)) for name in module.__all__)
    assert [gap for one in names for gap in undescribed(*one)] == []


def test_a_misspelt_name_is_an_ordinary_attribute_error() -> None:
    import cdpr

    with pytest.raises(AttributeError, match="'cdpr' has no attribute 'plann'"):
        _ = cdpr.plann  # type: ignore[attr-defined]


def answer_of(folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Runs a script in a folder, as `python script.py` does."""
    (folder / "script.py").write_text(code)
    command = [sys.executable, str(folder / "script.py")]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_less_common_verbs_are_found_in_a_fresh_process(tmp_path: Path) -> None:
    """`cdpr.operation` existed only after `cdpr.plan` or another name of its had been used."""
    answer = answer_of(tmp_path, "import cdpr\nprint(cdpr.operation.hold.__name__)\n")
    assert (answer.stdout, answer.stderr) == ("hold\n", "")


@pytest.mark.parametrize(
    ("file", "code"),
    [
        ("model.py", "import cdpr"),
        ("planner.py", "import cdpr\ncdpr.plan_from_waypoints"),
        ("planner/__init__.py", "import cdpr\ncdpr.plan"),
    ],
)
def test_a_file_that_hides_a_package_is_named(tmp_path: Path, file: str, code: str) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text("SPEED = 1.0\n")
    answer = answer_of(tmp_path, code)
    name = file.partition("/")[0].removesuffix(".py")
    assert answer.returncode == 1
    last = f"ImportError: {tmp_path / file} hides the package `{name}` of cdpr: rename it"
    assert answer.stderr.splitlines()[-1] == last


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (cdpr.run, ("``[]`` for none", '``{"front": 0}``', '``"synthetic"``', "None for all")),
        (cdpr.home, ("device file or address", "``NAME=SOURCE``", "``synthetic``")),
    ],
)
def test_the_help_states_which_cameras_are_taken(
    function: Callable[..., object], words: tuple[str, ...]
) -> None:
    shown = " ".join(inspect.getdoc(function).split())
    assert [word for word in words if word not in shown] == []


def test_every_public_name_is_documented() -> None:
    for package in PACKAGES:
        page = (ROOT / "docs" / "api" / f"{package}.md").read_text()
        names = importlib.import_module(package).__all__
        shown = [line.split(".")[-1] for line in page.splitlines() if line.startswith("::: ")]
        assert sorted(shown) == sorted(names), package


def with_truth_values() -> list[tuple[str, str]]:
    """Functions of `cdpr` and `executor`, and their arguments that are True or False."""
    return sorted(
        {
            (f"{package}.{name}", argument.name)
            for package in ("cdpr", "calibration", "executor")
            for name in importlib.import_module(package).__all__
            if inspect.isfunction(function := getattr(importlib.import_module(package), name))
            for argument in inspect.signature(function).parameters.values()
            if str(argument.annotation) in ("bool", "bool | None")
        }
    )


@pytest.mark.parametrize(("function", "argument"), with_truth_values())
def test_what_is_neither_true_nor_false_is_refused_before_anything_is_asked(
    function: str, argument: str, tmp_path: Path
) -> None:
    """A `None` for `clearance_stop` would switch off a protection."""
    package, name = function.split(".")
    rig = cdpr.load_rig(ROOT / "configs" / "gachon_8_6.yaml")
    scene = cdpr.load_scene(ROOT / "configs" / "environment_1.yaml")
    given: dict[str, tuple[Any, ...]] = {
        "calibrate_rig": (rig, tmp_path / "missing.csv"),
        "jog": (rig, None),
        "jog_cable": (rig, 1, 0.001),
        "plan": (rig, scene),
        "run": (cdpr.load_plan(write_short_plan(tmp_path / "plan.json")), rig),
    }
    call = getattr(importlib.import_module(package), name)
    options = (
        {} if "confirm" not in inspect.signature(call).parameters else {"confirm": pytest.fail}
    )
    for value in (0, 1.0, "no", "", [], np.int64(1), *([] if argument == "volume" else [None])):
        with pytest.raises(cdpr.BadInput, match=f"^{argument} must be True or False, it is"):
            call(*given.get(name, (rig,)), **options, **{argument: value})


def test_boards_take_only_truth_values_for_their_kind() -> None:
    with pytest.raises(cdpr.BadInput, match="legacy must be True or False"):
        Charuco(5, 7, 0.03, 0.02, "4X4_50", legacy="no")  # type: ignore[arg-type]
    with pytest.raises(cdpr.BadInput, match="asymmetric must be True or False"):
        CircleGrid(4, 5, 0.03, 0.01, asymmetric=1)  # type: ignore[arg-type]
