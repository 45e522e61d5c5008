"""The library neither prints nor asks, exits or takes signals: the command line does.

Except for Ctrl-C from an event loop that a motion keeps from running.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("calibration", "executor", "simulation", "planner", "drivers", "tracking", "model")
CALLS = {"print", "input", "exit", "quit", "sys.exit", "os._exit", "signal.signal"}
#: In processes of our own a terminal's signals are for the process that started them.
OWN_PROCESS = {"os._exit", "signal.signal"}
ALLOWED = {
    "executor/realtime/child.py": OWN_PROCESS,
    "planner/parallel.py": OWN_PROCESS,
    "executor/supervision.py": {"signal.signal"},
}


def offences(source: str, name: str = "") -> list[str]:
    """Calls and imports of a module that only a command line may have, with their lines."""
    found = []
    for node in ast.walk(ast.parse(source)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in CALLS - ALLOWED.get(name, set()):
                found.append(f"{node.lineno}: {called}")
        imported = {name.split(".")[0] for name in names} & {"typer", "rich", "click"}
        found += [f"{node.lineno}: import {name}" for name in sorted(imported)]
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_the_library_is_silent(package: str) -> None:
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        name = str(path.relative_to(ROOT))
        lines = offences(path.read_text(), name)
        if lines:
            found[name] = lines
    assert found == {}


@pytest.mark.parametrize(
    "line",
    ["print(1)", "input()", "import rich.table", "from typer import Exit", "signal.signal(2, f)"],
)
def test_what_only_a_command_line_may_do_is_noticed(line: str) -> None:
    assert offences(f"def f():\n    {line}\n") != []
