"""Every command that a message or a help text tells a user to run exists, with its options."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import typer

from cdpr.cli.app import EPILOG, build_app
from executor.doctor import PACKAGES
from model.files.reading import docs_page

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r"(?:^|`|sudo )cdpr ([a-z][^`;]*)")


def texts(tree: ast.AST) -> Iterator[str]:
    """String constants, f-strings with an X for every value."""
    inside = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(p.value) if isinstance(p, ast.Constant) else "X" for p in node.values)
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in inside
        ):
            yield node.value


def commands_in(text: str) -> Iterator[str]:
    """What follows `cdpr` between backticks, or at the beginning of a line."""
    for line in text.splitlines():
        yield from (found.group(1).strip() for found in COMMAND.finditer(line.strip()))


@cache
def all_commands() -> list[tuple[str, str]]:
    """Where, and what follows `cdpr` there."""
    found = set()
    sources = [p for package in PACKAGES for p in (ROOT / package).rglob("*.py")]
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    for path in sources:
        source = path.read_text()
        for text in texts(ast.parse(source)) if "cdpr" in source else ():
            found |= {(str(path.relative_to(ROOT)), c) for c in commands_in(text)}
    for path in pages:
        found |= {(str(path.relative_to(ROOT)), c) for c in commands_in(path.read_text())}
    return sorted(found)


APP: Any = typer.main.get_command(build_app())


def problem(command: str) -> str:
    """What of a command does not exist; nothing when all does."""
    words, verb = command.split(), APP
    while hasattr(verb, "commands"):  # a group of verbs
        if not words or not re.fullmatch(r"[a-z]+", words[0]):
            return "" if verb is not APP else f"no verb: {command}"
        name = words.pop(0)
        if name not in verb.commands:
            return f"no verb {name!r}"
        verb = verb.loaded(name)
    known = {option for p in verb.params for option in (*p.opts, *p.secondary_opts)} | {"--help"}
    wanted = {w.split("=")[0].rstrip(".,:)") for w in words if re.match(r"--?[a-z]", w)}
    return f"no option {sorted(wanted - known)}" if wanted - known else ""


OPTION = re.compile(r"(?<![\w-])(?<!var\()--[a-z]")
#: Modules of the library with options that have no Python form, and why.
ONLY_TYPED = {
    "calibration/extrinsics/camera_pairs.py": "--board",
    "calibration/images.py": "--live",
    "calibration/intrinsics/exchange.py": "calibrate export and import",
    "calibration/targets/printing.py": "calibrate print",
    "drivers/plausibility.py": "part of the command `cdpr home`",
    "executor/cameras/sources.py": "--camera and --no-camera together",
    "executor/doctor.py": "options of pip, and --drives",
    "executor/realtime/scheduling.py": "an option of docker",
    "model/files/documents.py": "--help",
    "model/files/output.py": "--force",
    "model/pages/viewer.py": "properties of a style sheet",
    "model/plan.py": "--rounds in a fact that the command line shows",
    "planner/parallel.py": "--dask",
    "planner/workspace/grid.py": "--slice",
    "simulation/drives/behaviour.py": "cdpr sim",
    "simulation/drives/eds_file.py": "cdpr sim",
    "simulation/factory.py": "cdpr sim",
}


def without_docstrings(source: str) -> ast.AST:
    """A module without the texts that only stand there."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            node.value = ast.Constant(None)
    return tree


def options_alone(source: str) -> list[str]:
    """Messages with an option outside a whole command, and without its Python form."""
    said = (re.sub("`cdpr [^`]*`", "", text) for text in texts(without_docstrings(source)))
    return [text for text in said if OPTION.search(text) and "in Python" not in text]


def test_a_message_of_the_library_that_names_an_option_names_its_python_form() -> None:
    """Arguments such as `budget=` are shown as options; where that cannot be, it names both."""
    library = [
        p for package in PACKAGES if package != "cdpr" for p in (ROOT / package).rglob("*.py")
    ]
    found = {
        str(path.relative_to(ROOT)): alone
        for path in (*library, *(ROOT / "cdpr").glob("*.py"))
        if (alone := options_alone(path.read_text()))
    }
    assert {name: alone for name, alone in found.items() if name not in ONLY_TYPED} == {}
    assert found.keys() == ONLY_TYPED.keys()


def test_an_option_alone_is_found() -> None:
    assert options_alone('def f():\n    """Of --a."""\n    return f"{x}, or pass --b-mm"') != []
    assert options_alone('"""Of --a."""\ns = "`cdpr plan --b`", "pass --c, in Python c="') == []


PAGE = re.compile(r"docs/[\w/-]+\.md")
RELATIVE = {
    "cdpr/cli/calibrate/rig.py": "a help text: `cdpr --help` states where docs/ is",
    "planner/parallel.py": "about a source checkout",
}


def test_a_page_that_a_message_names_is_found_from_any_folder() -> None:
    """With a wheel there is no folder docs; messages name pages by `docs_page`."""
    found = set()
    for path in (p for package in PACKAGES for p in (ROOT / package).rglob("*.py")):
        tree = ast.parse(path.read_text())
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        said = (node for node in ast.walk(tree) if id(node) not in docstrings)
        texts_said = (n.value for n in said if isinstance(n, ast.Constant))
        if any(isinstance(text, str) and PAGE.search(text) for text in texts_said):
            found.add(str(path.relative_to(ROOT)))
    assert found == set(RELATIVE)
    named = re.compile(r"docs_page\('([\w/-]+\.md)'\)")
    sources = [p.read_text() for package in PACKAGES for p in (ROOT / package).rglob("*.py")]
    pages = {page for text in sources for page in named.findall(text)}
    assert len(pages) >= 4
    assert all(Path(docs_page(page)).is_file() for page in pages)
    assert Path(EPILOG.rpartition(": ")[2]) == ROOT / "docs"


def test_commands_are_found() -> None:
    assert len(all_commands()) > 100
    assert problem("run plan.json --rig rig.yaml -o RUNDIR") == ""
    assert problem("runn plan.json") == "no verb 'runn'"
    assert problem("run plan.json --rigg rig.yaml") == "no option ['--rigg']"


def test_a_command_in_a_message_or_a_page_exists() -> None:
    wrong = [f"{where}: cdpr {command}: {problem(command)}" for where, command in all_commands()]
    assert [line for line in wrong if not line.endswith(": ")] == []
