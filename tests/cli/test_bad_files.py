"""Unusable rig and scene files: every problem with its location, and nothing is written."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.plans import CONFIGS, RIG
from tests.cli.program import call, nothing_written, one_message

SCENE = CONFIGS / "environment_1.yaml"

#: What is changed in the rig file, and what the message must say.
RIG_MISTAKES = {
    "a missing key": ("  mass_kg: 0.4\n", "", ["platform.mass_kg", "missing"]),
    "a misspelt key": ("min_tension_n:", "min_tention_n:", ["min_tention_n", "min_tension_n"]),
    "a number out of range": ("mass_kg: 0.4", "mass_kg: -0.4", ["platform.mass_kg", "-0.4"]),
    "not a number": ("mass_kg: 0.4", "mass_kg: .nan", ["platform.mass_kg"]),
    "a word for a number": ("mass_kg: 0.4", "mass_kg: heavy", ["platform.mass_kg"]),
    "seven anchors": ("  - [65, -65, 65]\n", "", ["anchors_mm", "7", "8"]),
    "tensions in the wrong order": (
        "max_tension_n: 100",
        "max_tension_n: 4",
        ["max_tension_n", "min_tension_n"],
    ),
    "two winches of one node": ("node_id: 2,", "node_id: 1,", ["node_id", "1"]),
    "a key that appears twice": ("  mass_kg: 0.4\n", "  mass_kg: 0.4\n" * 2, ["mass_kg", "twice"]),
    "a bracket that is not closed": ("size_mm: [130, 130, 130]", "size_mm: [130, 130, 130", []),
    "another schema version": ("schema_version: 1", "schema_version: 9", ["9", "1"]),
}


@pytest.mark.parametrize("mistake", RIG_MISTAKES)
def test_a_mistake_in_a_rig_file_is_reported_with_its_line(tmp_path: Path, mistake: str) -> None:
    old, new, parts = RIG_MISTAKES[mistake]
    text = RIG.read_text()
    assert old in text
    rig = tmp_path / "rig.yaml"
    rig.write_text(text.replace(old, new, 1))
    with nothing_written(tmp_path):
        answer = call("plan", rig, SCENE, "-o", tmp_path / "plan.json")
    one_message(answer, 2, f"{rig}:", *parts)
    assert answer.out == ""
    line, column = answer.err.split(f"{rig}:")[1].split(":")[:2]
    assert int(line) >= 1
    assert int(column) >= 1


def test_all_problems_of_a_file_come_at_once_in_the_order_of_their_lines(tmp_path: Path) -> None:
    text = RIG.read_text()
    for old, new in (
        ("mass_kg: 0.4", "mass_kg: 0"),
        ("radius_mm: 0 ", "radius: 0 "),
        ("cycle_ms: 10", "cycle_ms: x"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    rig = tmp_path / "rig.yaml"
    rig.write_text(text)
    answer = call("plan", rig, SCENE, "-o", tmp_path / "plan.json")
    one_message(answer, 2, "platform.mass_kg", "cables.radius", "bus.cycle_ms")
    lines = [int(part.split(":")[0]) for part in answer.err.split(f"{rig}:")[1:]]
    assert lines == sorted(lines)
    assert len(lines) >= 3


SCENE_MISTAKES = {
    "a misspelt obstacle": ("size_mm:", "sise_mm:", ["obstacles[0].box.sise_mm", "size_mm"]),
    "an obstacle without extent": ("[80, 80, 450]", "[80, 0, 450]", ["obstacles[0].box.size_mm"]),
    "a negative clearance": ("obstacle_mm: 10", "obstacle_mm: -1", ["clearance.obstacle_mm", "-1"]),
    "no goal": ("goal: {position_mm: [-180, -180, 400]}", "", ["goal", "missing"]),
    "two numbers for a position": ("[180, 180, 300]", "[180, 180]", ["start.position_mm"]),
}


@pytest.mark.parametrize("mistake", SCENE_MISTAKES)
def test_a_mistake_in_a_scene_file_is_reported_with_its_line(tmp_path: Path, mistake: str) -> None:
    old, new, parts = SCENE_MISTAKES[mistake]
    text = SCENE.read_text()
    assert old in text
    scene = tmp_path / "scene.yaml"
    scene.write_text(text.replace(old, new, 1))
    with nothing_written(tmp_path):
        answer = call("plan", RIG, scene, "-o", tmp_path / "plan.json")
    one_message(answer, 2, f"{scene}:", *parts)


@pytest.mark.parametrize("verb", ["plan", "doctor", "sim", "track"])
@pytest.mark.parametrize("kind", ["missing", "folder", "empty", "binary", "a list"])
def test_a_file_that_is_no_rig_file_is_named(tmp_path: Path, verb: str, kind: str) -> None:
    rig = tmp_path / "rig.yaml"
    match kind:
        case "folder":
            rig.mkdir()
        case "empty":
            rig.write_text("")
        case "binary":
            rig.write_bytes(b"\x89PNG\r\n\xff\xfe")
        case "a list":
            rig.write_text("- 1\n- 2\n")
    rest = {
        "plan": [SCENE, "-o", tmp_path / "plan.json"],
        "doctor": [],
        "sim": [],
        "track": [tmp_path, "-o", tmp_path / "poses.csv"],
    }[verb]
    with nothing_written(tmp_path):
        answer = call(verb, rig, *rest)
    one_message(answer, 2, str(rig))
    assert answer.out == ""


def test_files_in_another_order_are_named_for_what_they_are(tmp_path: Path) -> None:
    """Not as a dozen wrong keys in a valid file."""
    plan = tmp_path / "plan.json"
    with nothing_written(tmp_path):
        one_message(call("plan", SCENE, RIG, "-o", plan), 2, "a scene file, not a rig file")
        one_message(call("plan", RIG, RIG, "-o", plan), 2, "a rig file, not a scene file")
        one_message(call("check", RIG), 2, "a file of another kind", "pass another file")


def test_a_missing_folder_and_a_read_only_one_are_distinguished(tmp_path: Path) -> None:
    missing = tmp_path / "not there"
    one_message(call("plan", RIG, SCENE, "-o", missing / "p.json"), 2, f"no folder {missing}")
    (tmp_path / "file").touch()
    inside = tmp_path / "file" / "p.json"
    one_message(call("plan", RIG, SCENE, "-o", inside), 2, "file is not a folder")


def test_a_name_too_long_for_a_file_to_write_is_not_called_unreadable() -> None:
    answer = call("plan", RIG, SCENE, "-o", "x" * 300)
    one_message(answer, 2, "the path cannot be used", "File name too long", "shorten its name")
