"""A run folder whose files were moved, lost or archived without its images."""

from __future__ import annotations

import csv
import hashlib
import json
import pickle
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

import cdpr
from calibration.run_data import poses_of_run
from executor.evaluation import evaluate_folder, rewrite_report, write_end
from executor.recording.clearance import ClearanceTable
from executor.recording.record_files import CameraRecord
from executor.recording.run_folder import RunFolder
from executor.report.figures import clearance_figure
from executor.report.run_data import read_run
from executor.run_result import RunResult
from model.errors import BadInput, Fault
from tests.cli.program import call, one_message
from tests.executor import fake_run

KEPT = ("plan.json", "rig.json", "run.json", "events.jsonl", "cycles.csv", "poses.csv")


def finished(path: Path, *, camera: bool) -> RunFolder:
    """A finished run with every file, made by the writers of a run."""
    run = fake_run.make(rate_hz=2.0, every=20, camera=camera)
    folder = fake_run.write(run, path, pictures=camera)
    rewrite_report(RunFolder.open_cut_short(path))
    return folder


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return finished(tmp_path_factory.mktemp("filmed") / "run", camera=True)


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return finished(tmp_path_factory.mktemp("blind") / "run", camera=False)


def without(folder: RunFolder, path: Path, *names: str) -> RunFolder:
    """A copy in which files or folders are missing."""
    shutil.copytree(folder.path, path)
    for name in names:
        target = path / name
        shutil.rmtree(target) if target.is_dir() else target.unlink()
    return RunFolder(path)


def assert_checksums_hold(folder: Path) -> None:
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    stated = {name: digest for digest, name in (line.split("  ") for line in lines)}
    assert {*KEPT, "clearance.csv", "fused.csv", "run.mcap", "summary.json"} <= stated.keys()
    for name, digest in stated.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest, name


def images_in_mcap(path: Path) -> int:
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(topics=["/pictures"]))


# Images.


@pytest.mark.parametrize("others", [(), ("report.html",), ("report.html", "fused.csv", "run.mcap")])
@pytest.mark.parametrize("lost", [1, 3, None])
def test_an_archive_without_images_has_a_report_with_one_remark(
    filmed: RunFolder, tmp_path: Path, others: tuple[str, ...], lost: int | None
) -> None:
    names = [name for name in filmed.poses().picture if name]
    gone = names[:lost]
    folder = without(filmed, tmp_path / "run", *others, *(gone if lost else ["pictures"]))
    answer = call("report", folder.path)
    assert answer.code == 0, answer
    words = f"images missing from pictures/: {len(gone)} of {len(names)}"
    assert answer.err.count("remark") == 1
    assert words in answer.err
    page = folder.report.read_text(encoding="utf-8")
    assert words[1:] in page
    assert page.count("data:image/jpeg") == min(6, len(names) - len(gone))
    assert 'src="data:image/jpeg;base64,"' not in page
    left = len(names) if "run.mcap" not in others else len(names) - len(gone)
    assert images_in_mcap(folder.mcap) == left
    assert_checksums_hold(folder.path)
    assert json.loads(call("report", folder.path, "--json").out) == filmed.summary()


def test_a_run_with_all_its_images_is_reported_without_a_remark(filmed: RunFolder) -> None:
    answer = call("report", filmed.path)
    assert (answer.code, answer.err) == (0, "")
    assert "missing from" not in filmed.report.read_text(encoding="utf-8")


# What could not be written, and why.


def test_a_file_that_cannot_be_read_is_named_where_others_are_made_from_it(
    filmed: RunFolder, tmp_path: Path
) -> None:
    folder = without(filmed, tmp_path / "run", "run.mcap")
    path = folder.path / "poses.csv"
    name = next(name for name in filmed.poses().picture if name)
    path.write_text(path.read_text().replace(name, "rig.json", 1))  # outside of the images
    (folder.path / "SHA256SUMS").unlink()
    with pytest.raises(Fault) as caught:
        rewrite_report(RunFolder.open_cut_short(folder.path))
    assert "run.mcap" in caught.value.what
    assert str(folder.path / "rig.json") in caught.value.why
    assert "writable" not in caught.value.next_step


def test_a_full_disk_is_named_with_what_to_do(
    blind: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    folder = without(blind, tmp_path / "run", "fused.csv")
    monkeypatch.setattr("model.files.documents.tempfile.mkstemp", full)
    with pytest.raises(Fault) as caught:
        rewrite_report(RunFolder.open_cut_short(folder.path))
    assert caught.value.why == "fused.csv: No space left on device"
    assert caught.value.next_step == "make the folder writable, or free some space"


def test_a_report_that_a_full_disk_prevents_has_the_cause_of_its_missing_tables(
    blind: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its own reason would be that they are missing."""
    folder = without(blind, tmp_path / "run")
    result, course, events = evaluate_folder(folder), folder.course(), folder.events()
    for name in ("cycles.csv", "summary.json", "report.html"):
        (folder.path / name).unlink()

    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("model.files.documents.tempfile.mkstemp", full)
    missing = write_end(folder, course, result, events, lambda: False)
    assert {"cycles.csv", "summary.json", "report.html"} <= set(missing)
    assert set(missing.values()) == {"No space left on device"}


def test_a_record_too_large_to_read_is_named_with_its_size_and_where_to_read_it(
    blind: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It grew by a hold beyond what was foreseen; the same command cannot make its report here."""
    folder = without(blind, tmp_path / "run", "report.html")
    result, course, events = evaluate_folder(folder), folder.course(), folder.events()
    limit = (folder.path / "cycles.csv").stat().st_size - 1
    for module in ("executor.recording.table_files", "executor.run_result"):
        monkeypatch.setattr(f"{module}.TABLE_LIMIT", limit)
    missing = write_end(folder, course, result, events)
    size = f"{folder.path / 'cycles.csv'}: the file has {(limit + 1) / 1e6:.1f} MB; at most"
    assert missing.keys() == {"report.html"}
    assert size in missing["report.html"]
    text = RunResult(folder.path, result.summary, missing).missing_text()
    assert size in text
    assert f"run `cdpr report {folder.path}`" in text
    assert "on a computer with more memory" in text
    answer = call("report", folder.path)
    one_message(answer, 2, "at most", "MB are read")
    monkeypatch.undo()
    assert (
        "more memory"
        not in RunResult(folder.path, {}, missing).missing_text().partition("next:")[2]
    )


# Missing tables.


READERS: tuple[Callable[[Path], object], ...] = (cdpr.load_run, cdpr.report, RunFolder.open)


@pytest.mark.parametrize("name", KEPT)
def test_a_listed_file_that_nothing_replaces_is_named_wherever_a_run_is_read(
    filmed: RunFolder, tmp_path: Path, name: str
) -> None:
    for number, others in enumerate([(), ("summary.json",), ("report.html", "fused.csv")]):
        folder = without(filmed, tmp_path / str(number), name, *others)
        before = {path.name for path in folder.path.iterdir()}
        for read in READERS:
            with pytest.raises(BadInput, match=rf"{re.escape(name)} \(missing\)") as caught:
                read(folder.path)
            assert "restore the file from a copy" in caught.value.next_step
        assert {path.name for path in folder.path.iterdir()} == before


@pytest.mark.parametrize("name", ["cycles.csv", "poses.csv"])
def test_advice_for_a_missing_table_without_checksums_is_not_the_same_command(
    filmed: RunFolder, tmp_path: Path, name: str
) -> None:
    folder = without(filmed, tmp_path / "run", name, "SHA256SUMS")
    answer = call("report", folder.path)
    one_message(answer, 2, f"{name} missing", "restore the file from a copy")
    assert "cdpr report" not in answer.err


@pytest.mark.parametrize(
    "lost",
    [("clearance.csv",), ("summary.json",), ("clearance.csv", "summary.json", "run.mcap")],
)
def test_what_is_made_from_the_record_is_made_again_with_the_same_verdict(
    blind: RunFolder, tmp_path: Path, lost: tuple[str, ...]
) -> None:
    folder = without(blind, tmp_path / "run", *lost)
    with pytest.raises(BadInput, match="incomplete run folder") as caught:
        cdpr.load_run(folder.path)
    assert f"cdpr report {folder.path}" in caught.value.next_step
    assert call("report", folder.path).code == 0
    assert_checksums_hold(folder.path)
    assert cdpr.load_run(folder.path).verdict == blind.summary()["verdict"] == "PASSED"
    if "summary.json" not in lost:
        assert folder.summary() == blind.summary()
    assert call("report", folder.path).code == 0


@pytest.mark.parametrize("used", [("front",), ("front", "side")])
def test_files_named_like_poses_of_a_camera_do_no_harm(
    tmp_path: Path, used: tuple[str, ...]
) -> None:
    """Such as the log of `cdpr track` of the images of the run, or a backup of its poses."""
    run = fake_run.make(rate_hz=2.0, every=20)
    cameras = tuple(CameraRecord(name, "0", 9, 9, 0, 2.0, "") for name in used)
    context = fake_run.changed(run.context, cameras=cameras)
    folder = fake_run.write(replace(run, context=context), tmp_path / "run")
    alone = dict.fromkeys(used, folder.poses()) if len(used) > 1 else {}
    for name, table in alone.items():
        folder.write_table(f"poses-{name}.csv", table)
    (folder.path / "poses-tracked.csv").write_text("picture,x_mm\na.jpg,1\n")
    shutil.copy(folder.path / "poses.csv", folder.path / "poses-backup.csv")
    rewrite_report(RunFolder.open_cut_short(folder.path))
    assert read_run(folder).alone.keys() == alone.keys()
    assert len(poses_of_run(folder.path, "front")) > 1
    sums = (folder.path / "SHA256SUMS").read_text()
    assert re.findall(r"poses-(\w+)", sums) == [*alone]
    (folder.path / "poses-backup.csv").unlink()
    assert cdpr.load_run(folder.path).passed


def test_poses_of_a_camera_that_are_missing_are_named(tmp_path: Path) -> None:
    run = fake_run.make(rate_hz=2.0, every=20)
    cameras = tuple(CameraRecord(name, "0", 9, 9, 0, 2.0, "") for name in ("front", "side"))
    context = fake_run.changed(run.context, cameras=cameras)
    folder = fake_run.write(replace(run, context=context), tmp_path / "run")
    folder.write_table("poses-side.csv", folder.poses())
    with pytest.raises(BadInput, match="camera 'front' took no images"):
        poses_of_run(folder.path, "front")


def test_poses_without_a_final_newline_are_read_and_stay(filmed: RunFolder, tmp_path: Path) -> None:
    """As a spreadsheet may save them; nothing replaces them."""
    folder = without(filmed, tmp_path / "run", "SHA256SUMS", "run.mcap")
    poses, summary = folder.path / "poses.csv", folder.path / "summary.json"
    for path in (poses, summary, folder.path / "clearance.csv"):
        path.write_bytes(path.read_bytes().rstrip(b"\n"))
    before = poses.read_bytes(), summary.read_bytes()
    rewrite_report(RunFolder.open_cut_short(folder.path))
    assert (poses.read_bytes(), summary.read_bytes()) == before
    assert images_in_mcap(folder.mcap) == images_in_mcap(filmed.mcap)
    poses.write_bytes(before[0][: before[0].rfind(b"\n") + 20])
    for name in ("SHA256SUMS", "run.mcap"):
        (folder.path / name).unlink()
    with pytest.raises(BadInput, match=r"line \d+ has 4 values"):
        rewrite_report(RunFolder.open_cut_short(folder.path))


def test_a_last_cycle_without_a_newline_counts_if_it_is_whole(
    blind: RunFolder, tmp_path: Path
) -> None:
    folder = without(blind, tmp_path / "run", "SHA256SUMS", "run.mcap", "summary.json")
    path = folder.path / "cycles.csv"
    whole = path.read_bytes()
    path.write_bytes(whole.rstrip(b"\n"))
    assert evaluate_folder(folder).summary["verdict"] == "PASSED"
    tensions = evaluate_folder(folder).summary["tension_n"]
    row = whole.rstrip(b"\n").rfind(b"\n") + 1
    for end in (row + 20, whole.rfind(b",") + 2, len(whole) - 2):
        path.write_bytes(whole[:end])
        summary = evaluate_folder(folder).summary
        assert "the last 1 are not on record" in str(summary)
        assert summary["tension_n"] == tensions


def test_checksums_of_further_files_are_ignored(filmed: RunFolder, tmp_path: Path) -> None:
    """As `sha256sum * pictures/* > SHA256SUMS` lists them for an archive."""
    folder = without(filmed, tmp_path / "run")
    sums = folder.path / "SHA256SUMS"
    others = "".join(f"{'0' * 64}  {name}\n" for name in ("report.html", "pictures/a.jpg", "a b"))
    sums.write_text(sums.read_text() + others)
    assert cdpr.load_run(folder.path).passed
    sums.write_text(sums.read_text().replace("  ", "  ./"))  # as `sha256sum ./*` lists them
    assert cdpr.load_run(folder.path).passed
    events = folder.path / "events.jsonl"
    kept = events.read_bytes()
    events.write_bytes(kept + b"\n")
    with pytest.raises(BadInput, match=r"changed after the run: events\.jsonl"):
        cdpr.load_run(folder.path)
    events.write_bytes(kept)
    sums.write_text(sums.read_text() + "report.html\n")
    with pytest.raises(BadInput, match="not a checksum"):
        cdpr.load_run(folder.path)


def test_a_result_is_that_of_its_run_after_a_change_of_folder(
    blind: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables are read on first access: those of a `run` in the new folder had been read."""
    (tmp_path / "elsewhere").mkdir()
    shutil.copytree(blind.path, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    loaded = cdpr.load_run("run")
    assert repr(loaded).startswith("<RunResult PASSED in run: ")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert len(loaded.cycles["time_s"]) > 1
    Path("run").mkdir()
    Path("run/clearance.csv").write_text("of another run")
    assert len(loaded.clearance["time_s"]) > 0
    (tmp_path / "removed").mkdir()
    for one in (loaded, pickle.loads(pickle.dumps(loaded))):
        monkeypatch.chdir(tmp_path / "elsewhere")
        assert one.folder == one.shown_folder == tmp_path / "run"
        assert one.report in (None, tmp_path / "run" / "report.html")
    monkeypatch.chdir(tmp_path / "removed")
    (tmp_path / "removed").rmdir()
    assert loaded.shown_folder == tmp_path / "run"
    monkeypatch.chdir(tmp_path)


def test_a_summary_without_a_measured_clearance_has_none(blind: RunFolder) -> None:
    edited = {**blind.summary()["clearance_mm"], "measured_min": None}
    result = RunResult(blind.path, {**blind.summary(), "clearance_mm": edited})
    assert np.isnan([result.smallest_clearance, *result.clearance_interval]).all()
    assert "not measured" in result._repr_html_()
    run = replace(read_run(blind), summary=result.summary)
    assert "No clearance was measured." in clearance_figure(run)


def test_a_clearance_made_again_is_that_of_the_encoders(blind: RunFolder, tmp_path: Path) -> None:
    once = without(blind, tmp_path / "once", "clearance.csv")
    rewrite_report(RunFolder.open_cut_short(once.path))
    table, cycles = once.clearance(), once.cycles()
    assert {*table.source} == {"encoder"}
    assert table.obstacles == blind.clearance().obstacles
    assert np.isin(np.round(table.time, 6), np.round(cycles.time, 6)).all()


@pytest.mark.parametrize("others", [(), ("SHA256SUMS",), ("summary.json",)])
def test_a_clearance_that_cameras_measured_is_not_replaced_by_that_of_the_encoders(
    filmed: RunFolder, tmp_path: Path, others: tuple[str, ...]
) -> None:
    """As long as the folder shows that the run had it."""
    folder = without(filmed, tmp_path / "run", "clearance.csv", *others)
    before = {path.name for path in folder.path.iterdir()}
    answer = call("report", folder.path)
    one_message(answer, 2, "clearance.csv", "cameras measured", "restore the file from a copy")
    assert {path.name for path in folder.path.iterdir()} == before


@pytest.mark.parametrize("others", [(), ("fused.csv",)])
def test_a_run_without_its_course_is_refused(
    filmed: RunFolder, tmp_path: Path, others: tuple[str, ...]
) -> None:
    folder = without(filmed, tmp_path / "run", "run.json", "SHA256SUMS", *others)
    one_message(call("report", folder.path), 2, "run.json missing")
    with pytest.raises(BadInput, match=r"run\.json missing"):
        cdpr.load_run(folder.path)


# Columns of obstacles.

NAMES = st.builds(
    "".join,
    st.lists(
        st.sampled_from(
            ["planned_", "distance", "at_most", "uncertainty", "wall", "_mm", " (obstacle 2)"]
        ),
        min_size=1,
        max_size=4,
    ),
)


@given(names=st.lists(NAMES, min_size=1, max_size=5, unique=True))
def test_no_two_columns_have_one_name_whatever_obstacles_are_called(
    tmp_path_factory: pytest.TempPathFactory, names: list[str]
) -> None:
    path = tmp_path_factory.getbasetemp() / "clearance.csv"
    one, near = np.array([1.0]), np.arange(2.0, 2.0 + len(names))[None]
    table = ClearanceTable(
        one, ("tag",), one, one, one, ("b",), (names[0],), one, tuple(names), near, -near
    )
    table.write_csv(path)
    with path.open(newline="") as stream:
        header = next(csv.reader(stream))
        (row,) = csv.DictReader(stream, fieldnames=header)
    assert len({*header}) == len(header)
    assert [row[name] for name in header[2:5]] == ["1000.000000"] * 3
    read = ClearanceTable.read_csv(path)
    assert read.obstacles == table.obstacles
    np.testing.assert_array_equal(read.distances, near)
    np.testing.assert_array_equal(read.planned_distances, -near)


@given(names=st.lists(st.sampled_from("abcdefgh"), min_size=1, unique=True))
def test_usual_obstacles_give_their_names_to_their_columns(
    tmp_path_factory: pytest.TempPathFactory, names: list[str]
) -> None:
    path = tmp_path_factory.getbasetemp() / "usual.csv"
    none, nowhere = np.empty(0), np.empty((0, len(names)))
    ClearanceTable(
        none, (), none, none, none, (), (), none, tuple(names), nowhere, nowhere
    ).write_csv(path)
    header = path.read_text().strip().split(",")
    assert header[8:] == [part for name in names for part in (f"{name}_mm", f"planned_{name}_mm")]
