"""Examples, notebooks and the README's code run unchanged: no hardware, no Jupyter."""

from __future__ import annotations

import ast
import json
import re
import runpy
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

import cdpr
from tests.cli.plans import CONFIGS, rig_for_long_runs

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A separate folder with the example rigs and scenes; figures are drawn into memory."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    plt.close("all")


def ran(name: str, monkeypatch: pytest.MonkeyPatch, *arguments: str) -> None:
    """Runs an example as a shell does."""
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    with suppress(SystemExit):
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")


@pytest.mark.parametrize(
    ("name", "said", "left"),
    [
        ("plan_path.py", "proved clearance: 10.", ["plan.json", "plan.png"]),
        ("track_images.py", "place_06.jpg:", []),
        ("compare_objectives.py", "capacity ", []),
        ("parameter_study.py", "110 %   2.0 kg", []),
        ("own_planner.py", "around passes: <Plan", ["own-plan.json"]),
        ("calibrate_camera.py", "next: take more images", []),
    ],
)
def test_an_example_runs_and_leaves_what_it_says(
    name: str,
    said: str,
    left: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    ran(name, monkeypatch)
    assert said in capsys.readouterr().out
    assert [file for file in left if not any(Path().glob(file))] == []


def test_the_example_of_a_run_can_be_run_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for runs in (1, 2):
        ran("run_simulated.py", monkeypatch)
        assert "PASSED - " in capsys.readouterr().out
        assert len(list(Path("runs").glob("*/report.html"))) == runs
    assert Path("run.png").is_file()
    assert len(list(Path("runs").iterdir())) == 2


def test_the_example_for_a_bus_is_rehearsed_and_refuses_a_missing_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig_file = "configs/gachon_8_6.yaml"
    rig, scene = cdpr.load_rig(rig_file), cdpr.load_scene("configs/environment_1.yaml")
    goal = cdpr.Pose.level(scene.start.position * [1.0, 1.0, 1.03])
    cdpr.plan(rig, scene, goal=goal, rounds=12).save("plan.json")
    ran("run_on_can.py", monkeypatch, rig_file, "plan.json", "--simulated")
    assert "PASSED - " in capsys.readouterr().out
    main: Any = runpy.run_path(str(EXAMPLES / "run_on_can.py"))["main"]
    assert main([rig_file, "plan.json", "--interface", "no-such-interface"]) == 2
    assert "unknown CAN interface 'no-such-interface'" in capsys.readouterr().err


def test_every_example_and_notebook_is_listed_in_the_documentation() -> None:
    page = (ROOT / "docs" / "from-python.md").read_text()
    files = [*EXAMPLES.glob("*.py"), *NOTEBOOKS]
    assert len(files) >= 10
    assert [f.name for f in files if f"{f.relative_to(ROOT)}`" not in page] == []
    assert [f.name for f in files if f.suffix == ".py" and len(lines(f)) > 60] == []


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(notebook: Path, elsewhere: Path) -> None:
    (elsewhere / "examples").symlink_to(EXAMPLES)
    (elsewhere / "tests").symlink_to(ROOT / "tests")
    cells = json.loads(notebook.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell for cell in code if cell["outputs"] or cell["execution_count"]] == []
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(code):
        source, where = "".join(cell["source"]), f"{notebook.name}, cell {number}"
        shown = run_cell(source, where, names)
        # Jupyter shows new figures itself; one that the cell returns would appear twice.
        assert source.endswith(";") == isinstance(shown, Figure), where


def run_cell(source: str, where: str, names: dict[str, Any]) -> object:
    """The value of a cell's last expression, which a notebook shows unless it ends with `;`."""
    statements = ast.parse(source).body
    last = statements.pop() if isinstance(statements[-1], ast.Expr) else None
    exec(compile(ast.Module(statements, []), where, "exec"), names)
    return last and eval(compile(ast.Expression(last.value), where, "eval"), names)


def test_the_python_of_the_readme_runs(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (elsewhere / "configs").unlink()
    (elsewhere / "configs").mkdir()
    rig_for_long_runs(elsewhere).rename("configs/gachon_8_6.yaml")
    (elsewhere / "configs/environment_3.yaml").symlink_to(CONFIGS / "environment_3.yaml")
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(compile(block, "README.md", "exec"), {"__name__": "__main__"})
    assert "PASSED" in capsys.readouterr().out
    assert Path("runs/second/report.html").is_file()
