"""The public names of each package: they exist, editors see them, and nothing loads them early."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

import pytest

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


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_what_editors_see_under_it(package: str) -> None:
    module: Any = importlib.import_module(package)
    seen = imported_for_types(package)
    assert sorted(seen) == sorted(module.__all__)
    for name, home in seen.items():
        assert getattr(module, name) is getattr(importlib.import_module(home), name), name
        assert name in dir(module)
        assert getattr(module, name).__doc__, name


def test_a_misspelt_name_is_an_ordinary_attribute_error() -> None:
    import cdpr

    with pytest.raises(AttributeError, match="'cdpr' has no attribute 'plann'"):
        _ = cdpr.plann  # type: ignore[attr-defined]


def test_every_public_name_is_documented() -> None:
    for package in PACKAGES:
        page = (ROOT / "docs" / "api" / f"{package}.md").read_text()
        names = importlib.import_module(package).__all__
        shown = [line.split(".")[-1] for line in page.splitlines() if line.startswith("::: ")]
        assert sorted(shown) == sorted(names), package
