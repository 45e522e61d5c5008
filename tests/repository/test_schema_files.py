"""The committed JSON schemas say what the program accepts."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.schemas import DOCUMENTS, schema_text, write_schemas

SCHEMAS = Path(__file__).parents[2] / "docs" / "schema"
CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_committed_schema_is_current(name: str) -> None:
    """After a change to a file's model: `make schema`, and commit what it writes."""
    committed = (SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8")
    assert committed == schema_text(DOCUMENTS[name])


def test_the_command_writes_all_schemas_and_nothing_else(tmp_path: Path) -> None:
    write_schemas(tmp_path / "schema")
    written = {path.name for path in (tmp_path / "schema").iterdir()}
    assert written == {path.name for path in SCHEMAS.iterdir()}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_a_ready_file_names_its_schema_for_editors(path: Path) -> None:
    """The comment is relative to the file; one that leads nowhere would be silent in an editor."""
    key, _, target = path.read_text(encoding="utf-8").splitlines()[0].partition("$schema=")
    assert key == "# yaml-language-server: "
    assert (path.parent / target).resolve() in {schema.resolve() for schema in SCHEMAS.iterdir()}
