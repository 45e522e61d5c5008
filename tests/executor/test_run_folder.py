"""The run folder: created completely or not at all, and everything written is read back."""

from __future__ import annotations

import csv
import errno
import fcntl
import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from executor.recording import record_files, table_files
from executor.recording.clearance import ClearanceTable, no_clearance
from executor.recording.run_folder import NEEDED, RunEvent, RunFolder
from executor.recording.tables import (
    ROW,
    ROW_PER_CABLE,
    CycleTable,
    PoseTable,
    quaternions_of,
)
from executor.run_result import RunResult
from model.errors import BadInput
from model.files.output import require_new_file
from tests.executor import fake_run
from tracking.pose_log import POSE_COLUMNS


@pytest.fixture(scope="module")
def run() -> fake_run.FakeRun:
    return fake_run.make(rate_hz=2.0, every=20)


def same(one: Any, other: Any) -> None:
    """Equal tables: texts and whole numbers exactly, numbers to the digits of the file."""
    for field in fields(one):
        left, right = getattr(one, field.name), getattr(other, field.name)
        if isinstance(left, np.ndarray) and left.dtype == np.float64:
            np.testing.assert_allclose(right, left, rtol=1e-5, atol=6e-8, err_msg=field.name)
        elif isinstance(left, np.ndarray):
            np.testing.assert_array_equal(right, left, err_msg=field.name)
        else:
            assert left == right, field.name


def test_a_new_folder_has_room_for_events_and_images(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "a run")
    assert folder.events() == []
    assert (folder.path / "pictures").is_dir()


@pytest.mark.parametrize("kind", ["folder", "file", "dead link"])
def test_an_existing_path_is_never_written_into(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "run"
    if kind == "folder":
        path.mkdir()
    elif kind == "file":
        path.write_text("mine")
    else:
        path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(BadInput, match="exists already") as caught:
        RunFolder.create(path)
    assert caught.value.exit_code == 2
    assert "another folder" in caught.value.next_step
    assert not (tmp_path / "nowhere").exists()
    assert kind != "folder" or not list(path.iterdir())


def test_the_name_of_a_file_that_is_appended_to_outlives_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new file is on disk only once its folder is, too."""
    folder = RunFolder.create(tmp_path / "run")
    forced: list[Path] = []
    fsync = os.fsync

    def noted(handle: int) -> None:
        forced.append(Path(os.readlink(f"/proc/self/fd/{handle}")))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", noted)
    folder.append_cycles("time_s\n0.0\n", fsync=True)
    folder.append_cycles("0.1\n", fsync=True)
    cycles = folder.path / "cycles.csv"
    assert forced == [cycles, folder.path, cycles]
    assert cycles.read_text() == "time_s\n0.0\n0.1\n"


def test_folders_above_a_run_are_made(tmp_path: Path) -> None:
    RunFolder.create(tmp_path / "runs" / "today" / "first")
    assert (tmp_path / "runs" / "today" / "first").is_dir()


def test_a_file_that_cannot_hold_a_folder_is_bad_input(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(BadInput, match="cannot be created"):
        RunFolder.create(tmp_path / "file" / "run")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_nothing_half_made_is_left_when_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "touch", full)
    with pytest.raises(BadInput, match="cannot be created"):
        RunFolder.create(tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such run folder"):
        RunFolder.open(tmp_path / "nothing")


@pytest.mark.parametrize("name", ["x" * 300, "locked/run"])
def test_a_path_that_cannot_be_examined_is_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """As with a name that is too long, or a folder of another user."""
    stat, lstat = os.stat, os.lstat

    def refusing(real: Callable[..., os.stat_result]) -> Callable[..., os.stat_result]:
        def examine(path: Any, *args: Any, **options: Any) -> os.stat_result:
            if "locked/" in str(path):
                raise PermissionError(13, "Permission denied")
            return real(path, *args, **options)

        return examine

    monkeypatch.setattr(os, "stat", refusing(stat))
    monkeypatch.setattr(os, "lstat", refusing(lstat))
    path = tmp_path / name
    for opening in (RunFolder.open, RunFolder.open_cut_short):
        with pytest.raises(BadInput, match="no such run folder"):
            opening(path)
    for making in (RunFolder.require_free, RunFolder.create, require_new_file):
        with suppress(BadInput):
            making(path)


@pytest.mark.parametrize("name", NEEDED)
def test_opening_names_the_file_that_is_missing(tmp_path: Path, name: str) -> None:
    folder = RunFolder.create(tmp_path / "run")
    for other in NEEDED:
        (folder.path / other).touch()
    (folder.path / name).unlink()
    with pytest.raises(BadInput, match=name):
        RunFolder.open(folder.path)


def test_everything_that_is_written_comes_back(tmp_path: Path, run: fake_run.FakeRun) -> None:
    path = fake_run.write(run, tmp_path / "run").path
    folder = RunFolder.open(path)
    same(run.cycles, folder.cycles())
    same(run.clearance, folder.clearance())
    same(replace(run.poses, picture=folder.poses().picture), folder.poses())
    assert folder.plan().document == run.context.plan.document
    assert folder.rig().hash == run.context.rig.hash
    assert folder.summary() == json.loads(json.dumps(run.summary))
    assert tuple(folder.events()) == run.context.events


def test_cycles_of_a_rig_with_other_cables_are_refused(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.write_rig(run.context.rig.document)
    folder.write_table("cycles.csv", run.cycles)
    path = folder.path / "cycles.csv"
    path.write_text(path.read_text().replace("set_8_counts", "set_8_count", 1))
    message = "cycles.csv has 7 cables, rig.json has 8"
    with pytest.raises(BadInput, match=message):
        folder.cycles()
    with pytest.raises(BadInput, match=message):
        folder.cycles_cut_short(8)


def test_an_event_is_on_disk_as_soon_as_it_is_appended(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    first, second = RunEvent(0.5, "moving", "Los – 20 mm/s"), RunEvent(1.0, "stop", 'a "stop"\n')
    folder.append_event(first)
    assert RunFolder(folder.path).events() == [first]
    folder.append_event(second)
    assert RunFolder(folder.path).events() == [first, second]


def test_an_event_cut_by_a_crash_is_left_out(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.append_event(RunEvent(0.5, "moving", "moves"))
    with (folder.path / "events.jsonl").open("a") as stream:
        stream.write('{"time_s": 0.7, "co')
    assert [event.code for event in folder.events()] == ["moving"]


def test_a_broken_event_in_the_middle_is_reported_with_its_line(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    (folder.path / "events.jsonl").write_text('{"time_s": 0.7}\n')
    folder.append_event(RunEvent(0.5, "moving", "moves"))
    with pytest.raises(BadInput, match="not an event") as caught:
        folder.events()
    assert caught.value.where.endswith("events.jsonl:1")


def test_a_image_comes_back_as_jpeg(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    name = folder.write_image(7, np.full((48, 64), 99, dtype=np.uint8))
    assert name == "pictures/frame_000007.jpg"
    assert folder.image(name)[:2] == b"\xff\xd8"
    with pytest.raises(BadInput, match="picture"):
        folder.image("pictures/frame_000008.jpg")


def nfs_flock(flock: Callable[[int, int], None], file: IO[bytes] | int, operation: int) -> None:
    """`flock` as NFS emulates it by byte-range locks, which ask for the file's access mode.

    Source: flock(2), NFS details: an exclusive lock requires a file open for writing, a shared one
    a file open for reading; otherwise EBADF.
    """
    handle = file if isinstance(file, int) else file.fileno()
    access = fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_ACCMODE
    if access == (os.O_RDONLY if operation & fcntl.LOCK_EX else os.O_WRONLY):
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    flock(handle, operation)


@pytest.mark.parametrize("system", ["local", "nfs"])
def test_a_run_is_marked_as_active_on_every_file_system_with_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str
) -> None:
    if system == "nfs":
        monkeypatch.setattr(fcntl, "flock", partial(nfs_flock, fcntl.flock))
    folder = RunFolder.create(tmp_path / "run")
    folder.append_event(RunEvent(0.0, "armed", "all drives"))
    with folder.held():
        assert folder.is_active()
        assert RunFolder(folder.path).is_active()
    assert not folder.is_active()
    assert [event.code for event in folder.events()] == ["armed"]


def test_a_discarded_folder_is_gone(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.append_event(RunEvent(0.0, "refused", "no"))
    folder.discard()
    assert not list(tmp_path.iterdir())


CLEARANCE_FACTS = (
    "time_s,source,distance_mm,uncertainty_mm,at_most_mm,body,obstacle,planned_distance_mm"
)


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("cycles.csv", "", "empty"),
        ("cycles.csv", "cycle,time_s\n0,0.0\n", "'set_1_counts'|'state'|missing"),
        ("cycles.csv", "cycle,time_s\n0,0.0\n1\n", "line 3 has 1 values for 2 columns"),
        ("clearance.csv", "time_s\nsoon\n", "'time_s' has a value that is not a number"),
        ("clearance.csv", f"{CLEARANCE_FACTS},pillar_mm\n", "'pillar_mm' lacks its partner"),
        ("summary.json", "{", "not valid JSON"),
        ("summary.json", '{"schema_version": 2}', "this program reads version 1"),
        ("rig.json", "{}", "this key is missing"),
    ],
)
def test_a_damaged_file_is_reported_by_name(
    tmp_path: Path, name: str, text: str, what: str
) -> None:
    folder = RunFolder.create(tmp_path / "run")
    (folder.path / name).write_text(text)
    readers = {
        "cycles.csv": folder.cycles,
        "clearance.csv": folder.clearance,
        "summary.json": folder.summary,
        "rig.json": folder.rig,
    }
    with pytest.raises(BadInput, match=what) as caught:
        readers[name]()
    assert name in caught.value.where


@given(
    values=arrays(np.float64, (3, 2), elements=st.floats(-9.0, 9.0) | st.just(math.nan)),
    names=st.lists(
        st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1),
        min_size=2,
        max_size=2,
        unique=True,
    ),
)
def test_clearances_of_obstacles_of_any_name_round_trip(
    tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, names: list[str]
) -> None:
    path = tmp_path_factory.mktemp("table") / "clearance.csv"
    column = np.arange(3.0)
    table = ClearanceTable(
        column,
        ("tag",) * 3,
        column,
        column,
        column,
        ("cable 1",) * 3,
        (names[0],) * 3,
        column,
        tuple(names),
        values,
        -values,
    )
    table.write_csv(path)
    same(table, ClearanceTable.read_csv(path))


@pytest.mark.parametrize("names", [("x", "planned_x"), ("distance", "time_s"), ('a,"b"', "c d")])
def test_names_of_obstacles_that_look_like_columns_do_no_harm(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    one = np.array([1.0])
    table = ClearanceTable(
        one,
        ("tag",),
        one,
        one,
        one,
        ("b",),
        (names[0],),
        one,
        names,
        np.array([[2.0, 3.0]]),
        np.array([[4.0, 5.0]]),
    )
    table.write_csv(tmp_path / "clearance.csv")
    same(table, ClearanceTable.read_csv(tmp_path / "clearance.csv"))


@pytest.mark.parametrize("obstacles", [(), ("a", "b")])
def test_tables_without_rows_round_trip(tmp_path: Path, obstacles: tuple[str, ...]) -> None:
    no_clearance(obstacles).write_csv(tmp_path / "clearance.csv")
    PoseTable.empty().write_csv(tmp_path / "poses.csv")
    assert ClearanceTable.read_csv(tmp_path / "clearance.csv").obstacles == obstacles
    assert len(PoseTable.read_csv(tmp_path / "poses.csv")) == 0


def test_poses_have_the_columns_of_cdpr_track(tmp_path: Path, run: fake_run.FakeRun) -> None:
    """Programs that read one file must be able to read the other."""
    run.poses.write_csv(tmp_path / "poses.csv")
    names = (tmp_path / "poses.csv").read_text().splitlines()[0].split(",")
    assert [n for n in names if not n.startswith("planned_")] == list(POSE_COLUMNS)


def test_a_plain_csv_reader_finds_the_numbers_in_the_named_units(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    run.cycles.write_csv(tmp_path / "cycles.csv")
    with (tmp_path / "cycles.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    row, k = rows[40], 40
    assert float(row["planned_z_mm"]) == pytest.approx(run.cycles.planned[k, 2] * 1000, abs=1e-6)
    assert float(row["length_8_mm"]) == pytest.approx(run.cycles.lengths[k, 7] * 1000, abs=1e-6)
    assert int(row["set_3_counts"]) == run.cycles.set_counts[k, 2]
    assert float(row["tension_1_n"]) == pytest.approx(run.cycles.tensions[k, 0], abs=1e-4)
    assert len(rows) == len(run.cycles)


def test_a_table_of_unequal_lengths_cannot_be_made(run: fake_run.FakeRun) -> None:
    with pytest.raises(ValueError, match="lateness has 3 rows"):
        replace(run.cycles, lateness=np.zeros(3))
    with pytest.raises(ValueError, match="distances must have shape"):
        replace(run.clearance, distances=run.clearance.distances[:, :1])
    with pytest.raises(ValueError, match="frame has 1 rows"):
        replace(run.poses, frame=np.zeros(1, dtype=np.int64))


def test_rotations_become_quaternions_whether_they_change_or_not() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    half = math.sqrt(0.5)
    turning = quaternions_of(np.array([np.eye(3), quarter]))
    np.testing.assert_allclose(turning, [[1, 0, 0, 0], [half, 0, 0, half]], atol=1e-12)
    still = quaternions_of(np.array([quarter, quarter]))
    np.testing.assert_allclose(still, [[half, 0, 0, half]] * 2, atol=1e-12)
    assert quaternions_of(np.empty((0, 3, 3))).shape == (0, 4)


def test_cycles_without_rows_round_trip(tmp_path: Path, run: fake_run.FakeRun) -> None:
    """A fault before the first cycle still leaves a complete folder."""
    none = CycleTable(**{f.name: getattr(run.cycles, f.name)[:0] for f in fields(CycleTable)})
    none.write_csv(tmp_path / "cycles.csv")
    again = CycleTable.read_csv(tmp_path / "cycles.csv")
    assert (len(again), again.cable_count) == (0, 8)


@pytest.mark.parametrize("text", ["\n", "\n\n"])
def test_a_record_of_blank_lines_is_refused(
    tmp_path: Path, run: fake_run.FakeRun, text: str
) -> None:
    folder = fake_run.write(run, tmp_path / "run", pictures=False)
    (folder.path / "cycles.csv").write_text(text)
    with pytest.raises(BadInput, match=r"cycles\.csv"):
        folder.cycles_cut_short(8)


def test_a_record_without_cables_is_refused(tmp_path: Path, run: fake_run.FakeRun) -> None:
    folder = fake_run.write(run, tmp_path / "run", pictures=False)
    CycleTable.empty(cables=0).write_csv(folder.path / "cycles.csv")
    with pytest.raises(BadInput, match=r"cycles\.csv has 0 cables, rig\.json has 8"):
        folder.cycles()


def test_only_the_limit_of_tables_ends_reading_a_record(
    tmp_path: Path, run: fake_run.FakeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fake_run.write(run, tmp_path / "run", pictures=False)
    size = (folder.path / "cycles.csv").stat().st_size
    for limit, is_read in ((size, True), (size - 1, False)):
        monkeypatch.setattr(table_files, "TABLE_LIMIT", limit)
        monkeypatch.setattr(record_files, "TABLE_LIMIT", limit)
        for read in (folder.cycles, lambda: folder.cycles_cut_short(8)):
            if is_read:
                assert len(read()) == len(run.cycles)
            else:
                with pytest.raises(BadInput, match="at most"):
                    read()


def test_the_size_of_a_record_is_known_before_the_run(run: fake_run.FakeRun) -> None:
    """Of its rows after two hours."""
    late = replace(run.cycles, cycle=run.cycles.cycle + 720_000)
    row = len(late.csv_rows()) / len(late)
    assert 0.8 < row / (ROW + 8 * ROW_PER_CABLE) < 1.0


def table_kinds(result: RunResult) -> dict[str, str]:
    """Kind of each column's type, by table and column."""
    tables = {"cycles": result.cycles, "poses": result.poses, "clearance": result.clearance}
    return {f"{t} {n}": v.dtype.kind for t, table in tables.items() for n, v in table.items()}


def test_the_type_of_a_column_depends_on_its_name_only(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    """Not on tags that are one number, obstacles named by a number, or missing rows."""
    full = RunResult(fake_run.write(run, tmp_path / "full", pictures=False).path, {})
    count = len(run.clearance)
    numbered = replace(
        run,
        poses=replace(run.poses, tags=("301",) * len(run.poses), status=("1",) * len(run.poses)),
        clearance=replace(run.clearance, body=("1",) * count, obstacle=("2",) * count),
        cycles=replace(
            run.cycles, stop=("3",) * len(run.cycles), travelled=run.cycles.travelled * 0
        ),
    )
    bare = RunFolder.create(tmp_path / "numbered")
    bare.write_table("cycles.csv", numbered.cycles)
    bare.write_table("poses.csv", numbered.poses)
    bare.write_table("clearance.csv", numbered.clearance)
    empty = RunFolder.create(tmp_path / "empty")
    empty.write_table("cycles.csv", CycleTable.empty(run.cycles.cable_count))
    empty.write_table("poses.csv", PoseTable.empty())
    empty.write_table("clearance.csv", no_clearance(run.clearance.obstacles))
    kinds = table_kinds(full)
    assert table_kinds(RunResult(bare.path, {})) == kinds
    assert table_kinds(RunResult(empty.path, {})) == kinds
    assert {name for name, kind in kinds.items() if kind == "U"} == {
        *("cycles state", "cycles stop", "poses status", "poses tags", "poses picture"),
        *("clearance source", "clearance body", "clearance obstacle"),
    }
    whole = [name for name, kind in kinds.items() if kind == "i"]
    assert set(whole) == {
        *(f"cycles {name}" for name in ("cycle", "path_index", "leg", "missing")),
        *("cycles rejected_frames", "cycles error_frames", "poses frame"),
        *(f"cycles {kind}_{k}_counts" for kind in ("set", "actual") for k in range(1, 9)),
    }


def test_no_reader_of_a_result_changes_it_for_the_others(
    tmp_path: Path, run: fake_run.FakeRun
) -> None:
    result = RunResult(fake_run.write(run, tmp_path / "run", pictures=False).path, {})
    for table in (result.cycles, result.poses, result.clearance):
        for name, values in table.items():
            with pytest.raises(ValueError, match="read-only"):
                values[:1] = values[1:2]
            assert not values.flags.writeable, name


def test_a_column_that_was_edited_is_named(tmp_path: Path, run: fake_run.FakeRun) -> None:
    folder = fake_run.write(run, tmp_path / "run", pictures=False)
    path = folder.path / "cycles.csv"
    path.write_text(path.read_text().replace("moving,0,", "moving,a,", 1))
    with pytest.raises(BadInput, match="path_index"):
        _ = RunResult(folder.path, {}).cycles


@pytest.mark.parametrize(
    ("why", "full"),
    [
        ("ValueError: the points must span a volume", False),
        ("No space left on device", True),
        ("interrupted", False),
    ],
)
def test_missing_files_have_a_next_step_that_helps(tmp_path: Path, why: str, full: bool) -> None:
    text = RunResult(tmp_path, {}, missing={"report.html": why}).missing_text()
    assert why in text
    assert f"run `cdpr report {tmp_path}`" in text
    assert ("disk space" in text) is full
