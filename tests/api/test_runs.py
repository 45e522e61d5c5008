"""Run results: verdict, columns, figures, and the same loaded from the folder."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

import cdpr
from cdpr.operation import set_speed
from executor.drives import DriveStatus
from executor.interlock.reference import ReferenceStatus
from executor.jogging import CableJog, jog_cable
from executor.recording.record_files import CameraRecord
from executor.recording.run_folder import RunEvent, RunFolder
from executor.remote.command_socket import find_runs
from executor.service import ReleaseResult, ResetResult, StatusResult
from model.files.documents import PoseDocument
from model.files.scene_file import StopDocument
from model.pages.page import FactsDisplay
from model.pose import matrix_from_rotation_vector, quaternion_from_matrix
from model.progress import Advance, Listener
from model.scene import empty_scene

CONFIGS = Path(__file__).parents[2] / "configs"


def ready() -> tuple[cdpr.Rig, cdpr.Scene]:
    return (
        cdpr.load_rig(CONFIGS / "gachon_8_6.yaml"),
        cdpr.load_scene(CONFIGS / "environment_1.yaml"),
    )


def short_goal(scene: cdpr.Scene) -> cdpr.Pose:
    return cdpr.Pose.level(np.add(scene.start.position, (-0.01, 0.0, 0.01)))


def short_plan(rig: cdpr.Rig, scene: cdpr.Scene) -> cdpr.Plan:
    return cdpr.plan(rig, scene, goal=short_goal(scene), rounds=12)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> cdpr.RunResult:
    rig, scene = ready()
    plan = short_plan(rig, scene)
    folder = tmp_path_factory.mktemp("runs") / "short"
    return cdpr.run(plan, rig, folder=str(folder), cameras=[], realtime=False)


def test_a_run_passes_and_says_so(run: cdpr.RunResult) -> None:
    assert run.passed
    assert run.verdict == "PASSED"
    assert run.exit_code == 0
    assert "PASSED" in repr(run)
    assert run.sentence in run._repr_html_()


def test_tables_are_columns_of_one_length_by_the_names_in_the_file(run: cdpr.RunResult) -> None:
    for table, name in ((run.cycles, "cycles"), (run.clearance, "clearance")):
        assert type(table) is dict  # what `pandas.DataFrame` takes
        with (run.folder / f"{name}.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert list(table) == list(rows[0])
        assert {array.shape for array in table.values()} == {(len(rows),)}
    assert run.cycles["time_s"].dtype == np.float64
    assert run.cycles["actual_1_counts"].dtype == np.int64
    assert run.poses["time_s"].shape == (0,)


def test_the_smallest_clearance_lies_in_its_interval(run: cdpr.RunResult) -> None:
    low, high = run.clearance_interval
    assert low < run.smallest_clearance < high
    assert run.smallest_clearance * 1e3 == pytest.approx(
        run.clearance["distance_mm"].min(), abs=1e-3
    )


def test_a_run_is_loaded_from_its_folder_and_reported_again(run: cdpr.RunResult) -> None:
    page = cdpr.report(run.folder)
    again = cdpr.load_run(str(run.folder))
    assert again.report == page
    assert again.summary == run.summary
    np.testing.assert_array_equal(again.cycles["time_s"], run.cycles["time_s"])
    with pytest.raises(cdpr.BadInput, match="no such run folder"):
        cdpr.load_run(run.folder / "missing")


def test_a_plan_continues_a_run_and_passes_poses(run: cdpr.RunResult) -> None:
    rig, scene = ready()
    end = short_goal(scene)
    goal, between = (cdpr.Pose.level(np.add(end.position, (dx, 0.0, 0.02))) for dx in (0.0, 0.02))
    plan = cdpr.plan(rig, scene, goal=goal, via=[between], from_run=run.folder, rounds=12)
    assert plan.waypoints[0].distance_to(end) < 1e-3
    assert plan.waypoints[plan.stops[0]].distance_to(between) < 1e-8
    assert plan.waypoints[-1].distance_to(goal) < 1e-8
    assert cdpr.check(plan, rig)
    with pytest.raises(cdpr.BadInput, match="contradict"):
        cdpr.plan(rig, scene, start=end, from_run=run.folder)
    with pytest.raises(cdpr.BadInput, match="nothing remains"):
        cdpr.plan(rig, scene, goal=end, from_run=run.folder)


def test_a_run_that_ends_on_a_corner_of_the_workspace_is_continued(tmp_path: Path) -> None:
    """Rounded counts put the platform up to a micrometre outside."""
    rig = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml")
    goal = cdpr.Pose.level(rig.workspace_upper)
    inside = cdpr.Pose.level(np.subtract(rig.workspace_upper, 0.005))
    scene = empty_scene(rig).changed(start=inside, goal=goal)
    plan = cdpr.plan(rig, scene, rounds=2)
    run = cdpr.run(plan, rig, folder=tmp_path / "run", cameras=[], realtime=False)
    assert run.passed
    back = cdpr.plan(rig, scene, goal=inside, from_run=run.folder, rounds=2)
    assert back.waypoints[0].distance_to(goal) < 5e-5
    assert cdpr.check(back, rig)


@pytest.mark.parametrize(("turn_deg", "tilt_deg"), [(45.0, 0.0), (30.0, 10.0)])
def test_a_run_with_a_constant_orientation_is_continued_with_it(
    tmp_path: Path, turn_deg: float, tilt_deg: float
) -> None:
    """The paper's robot in a platform frame that is rotated: tables round its quaternion."""
    turn, tilt = np.radians([turn_deg, tilt_deg])
    rotation = matrix_from_rotation_vector([0.0, 0.0, turn]) @ matrix_from_rotation_vector(
        [tilt, 0.0, 0.0]
    )
    document = yaml.safe_load((CONFIGS / "gachon_8_6.yaml").read_text())
    document["anchors_mm"] = (np.array(document["anchors_mm"]) @ rotation).tolist()
    platform = document["platform"]
    platform["home"] |= {"rotation_wxyz": quaternion_from_matrix(rotation).tolist()}
    platform["size_mm"] = [40, 40, 40]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(document))
    rig = cdpr.load_rig(tmp_path / "rig.yaml")
    goal = cdpr.Pose(np.add(rig.home.position, (0.005, 0.0, 0.0)), rotation)
    scene = empty_scene(rig).changed(goal=goal)
    run = cdpr.run(
        cdpr.plan(rig, scene, rounds=2), rig, folder=tmp_path / "run", cameras=[], realtime=False
    )
    assert run.passed
    back = cdpr.plan(rig, scene, goal=rig.home, from_run=run.folder, rounds=2)
    assert back.waypoints[-1].distance_to(rig.home) < 1e-8
    assert cdpr.check(back, rig)


@pytest.mark.parametrize("stops", [(0, 1), (1, 1), (0, 0), (1, 2), (2, 2)])
def test_stops_that_share_a_waypoint_are_saved_run_and_reported(
    tmp_path: Path, stops: tuple[int, int]
) -> None:
    rig, scene = ready()
    waypoints = [
        cdpr.Pose.level(np.add(scene.start.position, (0.0, 0.0, 0.005 * i))) for i in range(3)
    ]
    named = [
        StopDocument(
            name=f"stop {i}", dwell_s=0.1 * i, **PoseDocument.of(waypoints[k]).model_dump()
        )
        for i, k in enumerate(stops)
    ]
    scene = scene.changed(goal=waypoints[-1], stops=named)
    plan = cdpr.plan_from_waypoints(rig, scene, waypoints, stops=stops)
    again = cdpr.load_plan(plan.save(tmp_path / "plan.json"))
    assert again.stops == stops
    run = cdpr.run(again, rig, folder=tmp_path / "run", cameras=[], realtime=False)
    assert run.passed
    assert run.report.exists()
    assert [stop["reached_s"] is not None for stop in run.summary["stops"]] == [True, True]


def messages(path: Path) -> dict[str, int]:
    """Number of messages by topic."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    return {summary.channels[number].topic: count for number, count in counts.items()}


def test_a_report_makes_what_is_missing_from_the_rest(run: cdpr.RunResult, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder)
    fused, counts = (folder / "fused.csv").read_bytes(), messages(folder / "run.mcap")
    for name in ("fused.csv", "run.mcap"):
        (folder / name).unlink()
    cdpr.report(folder)
    assert (folder / "fused.csv").read_bytes() == fused
    assert messages(folder / "run.mcap") == counts
    (folder / "summary.json").unlink()
    with pytest.raises(cdpr.BadInput, match="cdpr report"):
        cdpr.load_run(folder)
    cdpr.report(folder)
    assert cdpr.load_run(folder).summary == run.summary


def test_a_camera_that_failed_fails_the_run_when_it_is_reported_again(tmp_path: Path) -> None:
    rig, scene = ready()
    plan = short_plan(rig, scene)
    run = cdpr.run(plan, rig, folder=tmp_path / "run", realtime=False)
    assert run.passed
    course = RunFolder(run.folder).course()
    assert [camera.name for camera in course.cameras] == ["front"]
    failed = replace(course.cameras[0], failed="no answer since 0.30 s")
    RunFolder(run.folder).write_course(replace(course, cameras=(failed,)))
    for name in ("summary.json", "SHA256SUMS"):  # as if it had been so from the beginning
        (run.folder / name).unlink()
    cdpr.report(run.folder)
    again = cdpr.load_run(run.folder)
    assert again.verdict == "FAILED"
    assert any("no answer since 0.30 s" in reason for reason in again.summary["reasons"])
    assert [camera["name"] for camera in again.summary["cameras"]] == ["front"]


def test_a_report_ignores_keys_of_a_later_version(run: cdpr.RunResult, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(run.folder, folder)
    camera = CameraRecord("front", "synthetic", 3, 2, 1, 4.5, "")
    RunFolder(folder).write_course(replace(RunFolder(folder).course(), cameras=(camera,)))
    data = json.loads((folder / "run.json").read_text())
    data["later"] = data["cameras"][0]["later"] = 1
    (folder / "run.json").write_text(json.dumps(data))
    (folder / "SHA256SUMS").unlink()
    assert RunFolder(folder).course().cameras == (camera,)
    assert cdpr.report(folder) == folder / "report.html"


def test_a_run_without_obstacles_needs_no_stated_errors(tmp_path: Path) -> None:
    document = yaml.safe_load((CONFIGS / "gachon_8_6.yaml").read_text())
    for camera in document["cameras"]:
        del camera["error_mm"]
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(document))
    rig = cdpr.load_rig(tmp_path / "rig.yaml")
    free = yaml.safe_load((CONFIGS / "environment_1.yaml").read_text()) | {"obstacles": []}
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(free))
    scene = cdpr.load_scene(tmp_path / "scene.yaml")
    plan = short_plan(rig, scene)
    run = cdpr.run(plan, rig, folder=tmp_path / "run", realtime=False)
    assert run.passed, run.summary["reasons"]
    assert np.isfinite(run.poses["x_mm"]).any()


@pytest.mark.parametrize("percent", [0, 101, 50.0, True])
def test_a_speed_that_cannot_be_is_refused_before_it_is_sent(percent: object) -> None:
    with pytest.raises(cdpr.BadInput, match="whole number of percent"):
        set_speed(percent)  # type: ignore[arg-type]


def test_a_speed_is_an_integer_of_any_type() -> None:
    with pytest.raises(cdpr.Fault, match="no active run"):
        set_speed(np.int64(50))


def test_a_figure_shows_error_tensions_and_clearance(run: cdpr.RunResult) -> None:
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    error, tension, near = run.plot().axes
    assert (len(error.lines), len(tension.lines), len(near.lines)) == (1, 8, 1)
    plt.close("all")


def test_without_a_run_under_way_a_stop_reaches_nothing() -> None:
    with pytest.raises(cdpr.Fault):
        cdpr.stop()


def test_a_stop_ends_a_run_in_a_worker_thread(tmp_path: Path) -> None:
    """Where Ctrl-C, which Python raises in the main thread alone, does not reach it."""
    rig, scene = ready()
    goal = short_goal(scene)
    plan = cdpr.plan_from_waypoints(rig, scene.changed(goal=goal), [scene.start, goal])
    moving, stopped = threading.Event(), threading.Event()

    def wait_for_stop(event: RunEvent) -> None:
        if event.code == "moving":
            moving.set()
            assert stopped.wait(60.0)

    with ThreadPoolExecutor(1) as pool:
        folder, options = tmp_path / "run", {"cameras": [], "on_event": wait_for_stop}
        future = pool.submit(cdpr.run, plan, rig, folder=folder, realtime=False, **options)
        try:
            assert moving.wait(60.0)
            assert cdpr.stop() == [os.getpid()]
        finally:
            stopped.set()
        run = future.result()
    assert (run.verdict, run.exit_code) == ("STOPPED", 130)


#: Parts of files of a record that are replaced by others.
CHANGES = (
    ("cycles.csv", b"0.01", b"0.02"),
    ("summary.json", b"PASSED", b"FAILED"),
    ("summary.json", b'"lost_replies": 0', b'"lost_replies": 1'),
    ("clearance.csv", b"1", b"2"),
    ("events.jsonl", b"moving", b"MOVING"),
    ("run.json", b"virtual", b"VIRTUAL"),
    ("run.mcap", b"foxglove", b"foxgl0ve"),
)


@pytest.mark.parametrize(("name", "old", "new"), CHANGES)
def test_a_record_that_was_changed_is_not_loaded_or_reported(
    run: cdpr.RunResult, tmp_path: Path, name: str, old: bytes, new: bytes
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(run.folder, folder)
    assert cdpr.load_run(folder).summary == run.summary
    data = (folder / name).read_bytes()
    assert old in data
    (folder / name).write_bytes(data.replace(old, new, 1))
    for use in (cdpr.load_run, cdpr.report):
        with pytest.raises(cdpr.BadInput, match=f"changed after the run: {re.escape(name)}"):
            use(folder)
    (folder / name).write_bytes(data)
    assert cdpr.load_run(folder).summary == run.summary


def test_the_checksums_of_a_record_are_those_of_sha256sum(run: cdpr.RunResult) -> None:
    lines = (run.folder / "SHA256SUMS").read_text().splitlines()
    sums = dict(reversed(line.split("  ")) for line in lines)
    assert {"plan.json", "rig.json", "cycles.csv", "summary.json", "run.mcap"} <= sums.keys()
    for name, stated in sums.items():
        assert hashlib.sha256((run.folder / name).read_bytes()).hexdigest() == stated


@pytest.mark.parametrize("line", ["", "0" * 64, f"{'0' * 64}  ", f"{'g' * 64}  notes"])
def test_damaged_checksums_are_named(run: cdpr.RunResult, tmp_path: Path, line: str) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(run.folder, folder)
    (folder / "SHA256SUMS").write_text(f"{line}\n")
    with pytest.raises(cdpr.BadInput, match="SHA256SUMS:1: not a checksum"):
        cdpr.load_run(folder)


def test_a_record_of_an_earlier_version_must_agree_with_itself(
    run: cdpr.RunResult, tmp_path: Path
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(run.folder, folder)
    (folder / "SHA256SUMS").unlink()
    assert cdpr.load_run(folder).passed
    summary = folder / "summary.json"
    summary.write_text(summary.read_text().replace("PASSED", "FAILED", 1))
    with pytest.raises(cdpr.BadInput, match="the verdict is FAILED, but passed is True"):
        cdpr.load_run(folder)


def test_runs_of_one_process_need_a_simulated_channel_each(tmp_path: Path) -> None:
    """Both on one channel had been refused as disturbed by another program."""
    rig, scene = ready()
    plan = short_plan(rig, scene)
    beside: list[str] = []

    def run_beside(_event: RunEvent) -> None:
        if beside:
            return
        with pytest.raises(
            cdpr.Refused, match="in progress on this bus in this process"
        ) as refused:
            cdpr.run(plan, rig, folder=tmp_path / "same", cameras=[], realtime=False)
        assert "rig.with_bus('virtual', name)" in refused.value.next_step
        beside.append("refused")
        other = rig.with_bus("virtual", "another")
        run = cdpr.run(plan, other, folder=tmp_path / "beside", cameras=[], realtime=False)
        beside.append(run.verdict)
        with find_runs() as runs:
            beside.append(str(len(runs)))

    first = cdpr.run(
        plan, rig, folder=tmp_path / "first", cameras=[], realtime=False, on_event=run_beside
    )
    assert (first.verdict, *beside) == ("PASSED", "refused", "PASSED", "1")
    assert not (tmp_path / "same").exists()


REFERENCE = ReferenceStatus(True, None, "2026-01-01", "stated", "reference.json")
LOST = replace(REFERENCE, counts=False, why_not="<cut>")
STATUS = StatusResult("crane", "can0", None, (), None, False, LOST)
SILENT = cdpr.HardwareMissing("drive 5 does not answer")


@pytest.mark.parametrize(
    ("result", "stated"),
    [
        (STATUS, ["crane", "can0", "not valid: <cut>", "cdpr home RIG"]),
        (replace(STATUS, latched="cable 3 is slack"), ["cable 3 is slack", "cdpr reset RIG"]),
        (replace(STATUS, missing=SILENT, silent=(5,)), ["drive 5 does not answer"]),
        (
            replace(
                STATUS, drives=(DriveStatus(1, "fault", 0, 0.0, has_torque=False, set_up=True),)
            ),
            ["fault", "crane"],
        ),
        (ResetResult(True, "late", ("switched on",) * 8, (3,), LOST), ["late", "drive 3", "<cut>"]),
        (ResetResult(False, None, ("fault", "fault"), (), REFERENCE), ["none was", "valid, made"]),
        (ReleaseResult(("switch on disabled",) * 8, LOST), ["switch on disabled", "<cut>"]),
        (CableJog(3, -0.005, np.array([9.0, 21.0])), ["3, wound in by 5.000 mm", "9.0 to 21.0 N"]),
        (CableJog(2, 0.004, np.array([9.0, 21.0])), ["2, paid out by 4.000 mm"]),
    ],
)
def test_results_about_drives_show_their_facts(result: FactsDisplay, stated: list[str]) -> None:
    shown, table = repr(result), result._repr_html_()
    assert shown.startswith(f"<{type(result).__name__} ")
    assert len(shown) < 400
    assert table.count("<tr>") == len(result.facts()) >= 2
    for text in stated:
        assert text in shown
        assert escape(text) in table


def test_homing_shows_its_facts() -> None:
    home = cdpr.home(ready()[0], at_home=True, realtime=False)
    assert repr(home).startswith("<HomeResult platform: ")
    assert home._repr_html_().count("<tr>") == len(home.facts())
    assert home.folder is None


class Broken(Listener):
    """Its progress raises, either in the motion from a share on, or as it closes."""

    def __init__(self, error: BaseException, *, closing: bool = False, since: float = 0.0) -> None:
        self.error, self.closing, self.since = error, closing, since

    @contextmanager
    def progress(self, text: str, total: float | None) -> Iterator[Advance]:
        def advance(value: float, note: str = "", text: str = "") -> None:
            if not self.closing and value >= self.since * (total or 1.0):
                raise self.error

        yield advance
        if self.closing:
            raise self.error


@pytest.mark.parametrize(
    "move",
    [partial(cdpr.home, at_home=True), lambda rig, **more: jog_cable(rig, 1, -1e-5, **more)],
    ids=["home", "jog_cable"],
)
@pytest.mark.parametrize("closing", [False, True])
def test_a_listener_that_fails_stops_winches_and_is_named(
    move: Callable[..., object], closing: bool
) -> None:
    """It was called a failed recording, and the advice was to free disk space."""
    rig = ready()[0]
    with pytest.raises(cdpr.Fault, match=r"listener\.progress raised Runtime") as caught:
        move(rig, realtime=False, listener=Broken(RuntimeError("no terminal"), closing=closing))
    assert ("had finished" in caught.value.why) == closing
    for error in (SystemExit(5), KeyboardInterrupt()):
        with pytest.raises(type(error)) as left:
            move(rig, realtime=False, listener=Broken(error, closing=closing))
        assert left.value is error


@pytest.mark.parametrize("since", [0.5, 1.0])
def test_a_listener_that_fails_before_the_platform_is_measured_is_named_too(since: float) -> None:
    """The stop it asks for ended the measurement, and passed for one by the operator."""
    home = partial(cdpr.home, ready()[0], camera="synthetic", pictures=5, realtime=False)
    with pytest.raises(cdpr.Fault, match=r"listener\.progress raised RuntimeError: no") as caught:
        home(listener=Broken(error := RuntimeError("no terminal"), since=since))
    assert caught.value.__cause__ is error
    with pytest.raises(SystemExit):
        home(listener=Broken(SystemExit(5), since=since))


def test_the_record_of_winches_is_found_and_is_not_taken_for_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its folder was not in the result, and was said to be an interrupted run."""
    monkeypatch.chdir(tmp_path)
    rig = ready()[0]
    for move in (partial(jog_cable, rig, 1, -1e-5), partial(cdpr.home, rig, at_home=True)):
        folder = tmp_path / move.func.__name__
        result = move(folder=folder.name, realtime=False)
        assert result.folder == folder
        assert ("record", str(folder)) in result.facts()
        header, *rows = (folder / "winches.csv").read_text().splitlines()
        assert header.startswith("cycle,time_s,state,set_counts_1,")
        assert rows
        with pytest.raises(cdpr.BadInput, match="exists already"):
            move(folder=folder, realtime=False)
        for read in (cdpr.load_run, cdpr.report):
            with pytest.raises(
                cdpr.BadInput, match="a motion of winches without a path"
            ) as refused:
                read(folder)
            assert "read its winches.csv" in refused.value.next_step
