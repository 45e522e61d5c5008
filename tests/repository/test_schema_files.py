"""The committed JSON schemas say what the program accepts."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest

from model.files.drive_profile_file import NEEDED
from tests.cli.program import call
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
    assert (path.parent / named_by(path)).resolve() in {
        each.resolve() for each in SCHEMAS.iterdir()
    }


def test_a_copied_and_a_new_file_name_the_installed_schema(tmp_path: Path) -> None:
    """A relative path would lead nowhere from wherever they are."""
    assert call("examples", "turn", "hall_10_6", "-o", tmp_path).code == 0
    assert call("new", tmp_path / "mine.yaml", answers="\n" * 50).code == 0
    named = {path.stem: urlsplit(named_by(path)) for path in tmp_path.iterdir()}
    assert {each.scheme for each in named.values()} == {"file"}
    assert {name: Path(url2pathname(each.path)) for name, each in named.items()} == {
        "turn": SCHEMAS / "scene.schema.json",
        "hall_10_6": SCHEMAS / "rig.schema.json",
        "mine": SCHEMAS / "rig.schema.json",
    }


def named_by(path: Path) -> str:
    """The schema that the first line of a file names."""
    key, _, target = path.read_text(encoding="utf-8").splitlines()[0].partition("$schema=")
    assert key == "# yaml-language-server: "
    return target


def test_the_schema_of_profiles_knows_the_names_of_objects_and_codes() -> None:
    """An editor that accepts what the program refuses misleads whoever writes a profile."""
    schema = DOCUMENTS["drive-profile"].model_json_schema()
    keys, parts = schema["properties"], schema["$defs"]
    known = keys["ranges"]["propertyNames"]["enum"]
    missing = keys["absent"]["items"]["enum"]
    assert set(known) - set(missing) == set(NEEDED)
    assert {"6066h:00", "6072h:00"} <= set(missing)
    for pattern, right, wrong in (
        (keys["warnings"]["items"]["pattern"], "33xxh", ("3180", "33XXh", "33xxh:00")),
        (parts["Expected"]["properties"]["object"]["pattern"], "60A8h:00", ("60a8h:00", "60A8h")),
        (parts["TorqueLimit"]["properties"]["object"]["pattern"], "6073h:00", ("6073:00",)),
    ):
        assert re.search(pattern, right)
        assert not any(re.search(pattern, text) for text in wrong)
