"""`cdpr examples` lists and copies what comes with the program."""

from __future__ import annotations

from pathlib import Path

import pytest

from model.files.examples import find_examples
from tests.cli.plans import CONFIGS
from tests.cli.program import call, nothing_written, one_message

SESSION = CONFIGS.parent / "examples" / "rig_session"


def test_every_ready_file_and_session_is_listed_with_what_it_is() -> None:
    answer = call("examples")
    assert answer.code == 0
    listed = {line.split()[1]: line.split() for line in answer.out.splitlines()[:-1]}
    assert set(listed) == {*(path.stem for path in CONFIGS.glob("*.yaml")), SESSION.name}
    assert listed["gachon_8_6"][0] == "rig"
    assert listed["environment_1"][0] == "scene"
    assert listed["rig_session"][0] == "session"
    assert all(len(words) > 4 for words in listed.values())


def test_files_of_the_user_s_own_do_not_break_the_list(tmp_path: Path) -> None:
    """A newcomer saves a rig where the documented commands find rigs, or has one open in Emacs."""
    (tmp_path / "rig.yaml").write_text((CONFIGS / "gachon_8_6.yaml").read_text())
    (tmp_path / "marked.yaml").write_text("# yaml-language-server: $schema=a/scene.schema.json")
    (tmp_path / "empty.yaml").touch()
    (tmp_path / "latin.yaml").write_bytes("# Gelände\n".encode("latin-1"))
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "unmarked.yaml").write_text("schema_version: 1\nname: mine\n")
    (tmp_path / ".#rig.yaml").symlink_to("anna@lab.1234")
    (tmp_path / "session").mkdir()
    (tmp_path / "session/README.md").touch()
    found = [(each.kind, each.name) for each in find_examples(tmp_path, tmp_path)]
    assert found == [("rig", "rig"), ("scene", "marked"), ("session", "session")]


def test_copies_are_the_files_but_for_the_address_of_the_schema(tmp_path: Path) -> None:
    folder = tmp_path / "my" / "robot"
    assert call("examples", "gachon_8_6", "environment_1.yaml", "-o", folder).code == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        "environment_1.yaml",
        "gachon_8_6.yaml",
    ]
    for path in folder.iterdir():
        assert path.read_text().splitlines()[1:] == original(path.name)[1:]


def test_all_of_them_are_copied_as_a_clone_has_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call("examples", "--all").code == 0
    copied = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert {f"configs/{path.name}" for path in CONFIGS.glob("*.yaml")} < copied
    assert "examples/rig_session/places.csv" in copied
    assert "examples/rig_session/pictures/place_01.jpg" in copied


def test_a_copy_replaces_nothing_unless_asked(tmp_path: Path) -> None:
    mine = tmp_path / "gachon_8_6.yaml"
    mine.write_text("mine")
    with nothing_written(tmp_path):
        answer = call("examples", "environment_1", "gachon_8_6", "-o", tmp_path)
    one_message(answer, 2, "exists already", "1 of the 2 copies", "--force")
    assert call("examples", "gachon_8_6", "-o", tmp_path, "--force").code == 0
    assert mine.read_text().splitlines()[1:] == original(mine.name)[1:]


def original(name: str) -> list[str]:
    return (CONFIGS / name).read_text().splitlines()


@pytest.mark.parametrize("names", [("--all",), ("gachon_8_6",), ("rig_session",)])
def test_a_folder_that_cannot_be_created_is_named_as_such(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    (tmp_path / "file").touch()
    with nothing_written(tmp_path):
        answer = call("examples", *names, "-o", tmp_path / "file")
    one_message(answer, 2, "the folder cannot be created", "write permission")
    assert "read" not in answer.err.replace("already", "")


def test_a_name_that_is_unknown_lists_those_there_are(tmp_path: Path) -> None:
    answer = call("examples", "gachon", "-o", tmp_path)
    one_message(answer, 2, "unknown example 'gachon'", "gachon_8_6, ")
    one_message(call("examples", "--all", "turn"), 2, "--all copies every example")
    one_message(call("examples", "-o", tmp_path), 2, "-o needs something to copy")
