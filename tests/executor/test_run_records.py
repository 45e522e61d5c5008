"""A damaged record of a run causes one message that names the defect."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from executor.recording.record_files import RunCourse
from executor.recording.run_folder import RunEvent, RunFolder
from executor.report.run_data import read_run
from model.errors import BadInput, InvalidFile
from tests.executor import fake_run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("records") / "run"
    return fake_run.write(fake_run.make(every=20), folder, pictures=False).path


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> RunFolder:
    shutil.copytree(whole, tmp_path / "run")
    return RunFolder.open(tmp_path / "run")


def changed(folder: RunFolder, key: str, value: Any) -> None:
    path = folder.path / "summary.json"
    data = json.loads(path.read_text())
    holder, parts = data, key.split(".")
    for part in parts[:-1]:
        holder = holder[part]
    holder[parts[-1]] = value
    path.write_text(json.dumps(data))


def test_what_a_run_writes_is_read_as_it_is(folder: RunFolder) -> None:
    written = json.loads((folder.path / "summary.json").read_text())
    assert folder.summary() == written
    assert [event.code for event in folder.events()] == ["armed", "moving", "finished"]
    assert read_run(folder).summary == written


def test_a_key_of_a_later_version_is_left_alone(folder: RunFolder) -> None:
    changed(folder, "weather", {"sunny": True})
    assert folder.summary()["weather"] == {"sunny": True}


def test_a_key_of_a_later_version_in_an_event_is_ignored(folder: RunFolder) -> None:
    event = {"time_s": 1.0, "code": "moving", "text": "It moves.", "cable": 3}
    changed(folder, "events", [event])
    assert folder.summary()["events"] == [event]
    path = folder.path / "events.jsonl"
    path.write_text(path.read_text() + json.dumps(event) + "\n")
    assert folder.events()[-1] == RunEvent(1.0, "moving", "It moves.")


@pytest.mark.parametrize("name", ["summary.json", "run.json", "rig.json", "plan.json"])
@pytest.mark.parametrize("version", [2, True])
def test_a_file_of_another_version_is_named_with_what_to_do(
    folder: RunFolder, name: str, version: int
) -> None:
    """An older copy of the file would not help with a later one."""
    path = folder.path / name
    path.write_text(json.dumps(json.loads(path.read_text()) | {"schema_version": version}))
    readers = {
        "summary.json": folder.summary,
        "run.json": folder.course,
        "rig.json": folder.rig,
        "plan.json": folder.plan,
    }
    with pytest.raises(InvalidFile, match=f"schema version {version}") as caught:
        readers[name]()
    later = "use the version of cdpr that wrote the file, or "
    assert caught.value.next_step.startswith(later) is (version == 2)
    assert "copy" not in caught.value.next_step


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("stops", 3),
        ("stops", [{}]),
        ("cameras", [1]),
        ("versions", None),
        ("verdict", "GOOD"),
        ("started", "yesterday"),
        ("duration_s", "long"),
        ("duration_s", 1e300),
        ("following_error_mm", None),
        ("following_error_mm.max", None),
        ("tag_error_mm", []),
        ("clearance_mm.measured_uncertainty", None),
        ("tension_n.min", None),
        ("lateness_ms", "late"),
        ("events", [{"code": "x"}]),
        ("cycles", -1),
    ],
)
def test_a_value_that_no_run_writes_is_named(folder: RunFolder, key: str, value: Any) -> None:
    changed(folder, key, value)
    with pytest.raises(InvalidFile) as caught:
        folder.summary()
    assert key.split(".")[0] in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (key, value)
        for key in (
            "started",
            "interface",
            "simulated",
            "fast",
            "versions",
            "final_state",
            "cause",
            "cycles",
        )
        for value in ([], {"cdpr": 1}, None, 1.5, -1, "yesterday", "2026-01-01T00:00:00")
        if not (isinstance(value, str) and key in ("interface", "final_state", "cause"))
    ],
)
def test_a_course_that_no_run_writes_is_named(tmp_path: Path, key: str, value: Any) -> None:
    path = tmp_path / "run.json"
    RunCourse(datetime(2026, 1, 1, tzinfo=UTC), "virtual", True, False).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(InvalidFile, match=key):
        RunCourse.load(path)


def test_a_course_without_versions_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    RunCourse(datetime(2026, 1, 1, tzinfo=UTC), "virtual", True, False).save(path)
    kept = json.loads(path.read_text())
    del kept["versions"]
    path.write_text(json.dumps(kept))
    with pytest.raises(InvalidFile, match="versions"):
        RunCourse.load(path)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, '{"schema_version": 2}', "\0"])
def test_a_summary_that_is_invalid_is_refused(folder: RunFolder, text: str) -> None:
    (folder.path / "summary.json").write_text(text)
    with pytest.raises(BadInput):
        folder.summary()


@pytest.mark.parametrize(
    "line",
    [
        "{}",
        "3",
        '{"time_s": "a", "code": "b", "text": "c"}',
        '{"time_s": 1e400, "code": "b", "text": "c"}',
        '{"time_s": 0, "code": 3, "text": "c"}',
        "[" * 100_000,
    ],
)
def test_an_event_that_is_invalid_is_reported_with_its_line(folder: RunFolder, line: str) -> None:
    path = folder.path / "events.jsonl"
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(BadInput, match="not an event") as caught:
        folder.events()
    assert caught.value.where.endswith("events.jsonl:4")


def test_a_last_line_that_a_crash_cut_is_left_out(folder: RunFolder) -> None:
    path = folder.path / "events.jsonl"
    path.write_text(path.read_text() + '{"time_s": 1')
    assert len(folder.events()) == 3


def test_files_of_two_runs_are_distinguished(folder: RunFolder) -> None:
    stop = {"name": "shelf", "kind": "pass", "reached_s": 1.0, "left_s": None}
    changed(folder, "stops", [stop])
    with pytest.raises(BadInput, match="shelf"):
        read_run(folder)
