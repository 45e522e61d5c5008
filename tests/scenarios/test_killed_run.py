"""A run whose program was killed: its cycles are on disk, and its report states what is known."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can_bus import BusSettings
from executor import evaluation
from executor.cameras.multi_camera import CameraRecords
from executor.cameras.process import sample_without_pose
from executor.evaluation import evaluate_folder
from executor.interlock.fault_latch import FaultLatch
from executor.recording.record_files import RunCourse
from executor.recording.resume import run_end
from executor.recording.run_folder import NEEDED, RunEvent, RunFolder
from executor.recording.table_files import Table
from executor.remote.client import ask_all
from executor.remote.command_socket import find_runs
from executor.trajectory.setpoints import PreparedRun
from model.errors import BadInput, Refused
from tests.cli.plans import RIG
from tests.cli.program import call, one_message
from tests.executor import fake_run
from tests.scenarios.test_real_time import moving_over_udp, real_time_process, wait_until_gone

RUN = fake_run.make(rate_hz=1.0, every=100, camera=False)
KEPT = ("plan.json", "rig.json", "run.json", "cycles.csv", "events.jsonl")
ENDED = (*(name for name in NEEDED if name not in KEPT),)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """The folder when the program is killed during motion."""
    folder = fake_run.write(RUN, tmp_path_factory.mktemp("killed") / "run", pictures=False)
    folder.append_event(RunEvent(99.0, "pass", "an der Säule vorbei – ¾"))
    started = RUN.context.course.started
    folder.write_course(RunCourse(started, "socketcan", False, False))
    for name in (*ENDED, "run.mcap"):
        (folder.path / name).unlink()
    return folder


def cut(killed: RunFolder, path: Path, **kept: int) -> RunFolder:
    """A copy with some files truncated."""
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(killed.path, path)
    for name, size in kept.items():
        os.truncate(path / name.replace("_", "."), size)
    return RunFolder(path)


def test_cut_at_every_byte_the_whole_lines_are_read(killed: RunFolder, tmp_path: Path) -> None:
    data = (killed.path / "cycles.csv").read_bytes()
    few = data[: data.index(b"\n", data.index(b"\n", data.index(b"\n") + 1) + 1) + 1]
    whole = killed.cycles()
    folder = cut(killed, tmp_path / "cut")
    for size in range(len(few) + 1):
        (folder.path / "cycles.csv").write_bytes(few[:size])
        cycles = folder.cycles_cut_short(8)
        lines = few[:size].count(b"\n")
        assert len(cycles) == max(0, lines - 1)
        assert cycles.cable_count == 8
        assert cycles.time.tolist() == whole.time[: len(cycles)].tolist()


def test_events_cut_at_every_byte_are_read_up_to_the_cut(killed: RunFolder, tmp_path: Path) -> None:
    folder = cut(killed, tmp_path / "cut")
    data, events = (killed.path / "events.jsonl").read_bytes(), killed.events()
    for size in range(len(data) + 1):
        (folder.path / "events.jsonl").write_bytes(data[:size])
        assert folder.events() == events[: data[:size].count(b"\n")]


@given(st.data())
@settings(max_examples=25)
def test_wherever_the_files_were_cut_there_is_a_verdict(
    killed: RunFolder, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    sizes = {
        name.replace(".", "_"): data.draw(
            st.integers(0, (killed.path / name).stat().st_size), label=name
        )
        for name in ("cycles.csv", "events.jsonl")
    }
    folder = cut(killed, tmp_path_factory.getbasetemp() / "cut", **sizes)
    summary = evaluate_folder(folder).summary
    assert (summary["verdict"], summary["final_state"]) == ("FAILED", "not_ended")
    assert summary["sentence"] == "The run did not finish."
    assert (summary["interface"], summary["simulated"]) == ("socketcan", False)


@pytest.mark.parametrize("lines", [0, 2, 20])
def test_the_report_of_a_killed_run_shows_what_there_is(
    killed: RunFolder, tmp_path: Path, lines: int
) -> None:
    data = (killed.path / "cycles.csv").read_bytes()
    size = len(b"".join(data.splitlines(keepends=True)[:lines])) + 17
    folder = cut(killed, tmp_path / "run", cycles_csv=size)
    answer = call("report", folder.path)
    assert answer.code == 0, answer
    assert "did not finish" in folder.report.read_text()
    assert len(RunFolder.open(folder.path).cycles()) == max(0, lines - 1)
    # Once completed it is an ordinary run folder; but no plan may start from its end.
    assert call("report", folder.path).code == 0
    with pytest.raises(Refused, match="did not finish"):
        run_end(RunFolder.open(folder.path))


def test_cycles_that_are_not_on_record_are_reported_of_a_run_whose_end_is(
    killed: RunFolder, tmp_path: Path
) -> None:
    """The disk was full: its end is in the reserved space, its last cycles are missing."""
    folder = cut(killed, tmp_path / "run")
    there = len(folder.cycles())
    course = replace(folder.course(), final_state="finished", cause="", cycles=there + 7)
    folder.write_end_of_course(course)
    assert folder.course() == course
    summary = evaluate_folder(folder).summary
    assert (summary["verdict"], summary["final_state"]) == ("FAILED", "finished")
    assert f"Of {there + 7} cycles the last 7 are not on record." in summary["reasons"]
    folder.write_end_of_course(replace(course, cycles=there))
    assert evaluate_folder(folder).summary["verdict"] == "PASSED"


STOP = RunEvent(98.0, "stop", "stop requested; slowing down along the path")
HELD = RunEvent(99.0, "held", "at rest; the drives hold under torque")


@pytest.fixture
def at_rest(killed: RunFolder, tmp_path: Path) -> RunFolder:
    """Its cycles reach up to its end, its ``run.json`` does not."""
    folder = cut(killed, tmp_path / "run")
    cycles = folder.cycles()
    folder.write_table("cycles.csv", replace(cycles, state=(*cycles.state[:-1], "securing")))
    folder.write_events([RunEvent(0.0, "enabled", "all hold"), RunEvent(0.1, "moving", "moving")])
    return folder


@pytest.mark.parametrize(
    ("events", "verdict", "state"),
    [
        ([HELD], "PASSED", "finished"),
        ([RunEvent(50.0, "reply_lost", "drive 4: one"), HELD], "PASSED", "finished"),
        ([STOP, HELD], "STOPPED", "stopped"),
        ([], "FAILED", "not_ended"),
        ([STOP], "FAILED", "not_ended"),
        ([RunEvent(50.0, "drive_warning", "drive 4: hot"), HELD], "PASSED", "finished"),
        ([RunEvent(50.0, "camera_sees_nothing", "front: none"), HELD], "FAILED", "not_ended"),
        ([HELD, RunEvent(99.1, "recorder", "the latch cannot be written")], "FAILED", "not_ended"),
    ],
)
def test_a_kill_after_the_verdict_changes_it_in_no_report(
    at_rest: RunFolder, events: list[RunEvent], verdict: str, state: str
) -> None:
    """Between the printed verdict and the end of ``run.json``."""
    for event in events:
        at_rest.append_event(event)
    answer = call("report", at_rest.path, "--json")
    assert answer.code == 0, answer
    summary = json.loads(answer.out)
    assert (summary["verdict"], summary["final_state"]) == (verdict, state), summary["reasons"]
    if verdict == "STOPPED":
        assert STOP.text in " ".join(summary["reasons"])


def test_held_counts_only_with_the_cycles_up_to_it(killed: RunFolder, tmp_path: Path) -> None:
    folder = cut(killed, tmp_path / "run")
    folder.write_events([HELD])
    assert evaluate_folder(folder).summary["final_state"] == "not_ended"


def test_a_run_does_not_pass_without_what_its_cameras_measured(at_rest: RunFolder) -> None:
    at_rest.append_event(HELD)
    at_rest.write_image(0, np.zeros((4, 4), dtype=np.uint8))
    summary = evaluate_folder(at_rest).summary
    assert (summary["verdict"], summary["final_state"]) == ("FAILED", "finished")
    assert "What the cameras measured is not on record." in summary["reasons"]


def test_a_program_that_is_killed_once_the_verdict_is_out_leaves_that_verdict(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("executor.runner.write_end", lambda *_: {})
    run = tmp_path / "run"
    answer = call("run", short_plan, "--rig", RIG, "--fast", "--no-camera", "-o", run)
    assert "\nPASSED " in answer.out, answer
    again = call("report", run, "--json")
    assert again.code == 0, again
    summary = json.loads(again.out)
    assert (summary["verdict"], summary["final_state"]) == ("PASSED", "finished")


def test_a_killed_run_has_the_start_of_its_motion_and_the_versions_that_ran_it(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is created before the cameras open and the drives are armed: minutes earlier."""
    run, killed, append = tmp_path / "run", tmp_path / "killed", RunFolder.append_cycles
    created, moved = (datetime(2026, 1, 1, 12, minute, tzinfo=UTC) for minute in (0, 3))
    times = iter([created, moved])
    monkeypatch.setattr("executor.runner.datetime", SimpleNamespace(now=lambda _: next(times)))
    monkeypatch.setattr("executor.runner.versions", lambda: {"cdpr": "0.0.9"})

    def killed_then(self: RunFolder, lines: str, *, fsync: bool) -> None:
        append(self, lines, fsync=fsync)
        if not killed.exists():
            shutil.copytree(run, killed)

    monkeypatch.setattr(RunFolder, "append_cycles", killed_then)
    answer = call("run", short_plan, "--rig", RIG, "--fast", "--no-camera", "-o", run)
    assert answer.code == 0, answer
    monkeypatch.undo()
    course = evaluate_folder(RunFolder(killed)).context.course
    assert (course.started, course.versions) == (moved, {"cdpr": "0.0.9"})
    assert RunFolder(run).summary()["versions"] == {"cdpr": "0.0.9"}


def test_a_kill_during_the_evaluation_loses_neither_the_end_nor_the_camera_poses(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The evaluation of a long run takes minutes."""
    run, killed, clearance = tmp_path / "run", tmp_path / "killed", evaluation._clearance
    samples = (sample_without_pose(0, 0.5, "no tag"), sample_without_pose(1, 0.6, "no tag"))
    seen = CameraRecords(samples, {"front": samples, "side": samples[:1]})
    monkeypatch.setattr("executor.runner.CameraRecords", lambda: seen)

    def killed_then(*arguments: Any) -> Any:
        shutil.copytree(run, killed)
        return clearance(*arguments)

    monkeypatch.setattr(evaluation, "_clearance", killed_then)
    answer = call("run", short_plan, "--rig", RIG, "--fast", "--no-camera", "-o", run)
    assert answer.code == 1, answer  # no pose was measured
    before, after = RunFolder(killed), RunFolder(run)
    assert before.course() == after.course()
    assert before.course().final_state == "finished"
    assert (killed / "cycles.csv").read_bytes() == (run / "cycles.csv").read_bytes()
    for name in ("poses.csv", "poses-front.csv", "poses-side.csv"):
        assert (killed / name).read_bytes() == (run / name).read_bytes()
    assert before.poses().status == ("no tag", "no tag")


def test_the_end_of_a_run_has_room_on_a_full_disk(
    killed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = cut(killed, tmp_path / "run")
    size = (folder.path / "run.json").stat().st_size

    def full(path: Path, _text: str) -> None:
        raise BadInput("the file cannot be written", where=str(path))

    monkeypatch.setattr("executor.recording.record_files.write_atomic", full)
    course = replace(folder.course(), final_state="latched", cause="Säule ✗ " * 1000, cycles=5)
    folder.write_end_of_course(course)
    assert (folder.path / "run.json").stat().st_size == size
    assert folder.course() == replace(course, cause=course.cause[:256])
    (folder.path / "run.json").unlink()
    with pytest.raises(BadInput, match="cannot be written"):
        folder.write_end_of_course(course)


def test_a_killed_run_without_a_cycle_file_has_a_report_too(
    killed: RunFolder, tmp_path: Path
) -> None:
    folder = cut(killed, tmp_path / "run")
    (folder.path / "cycles.csv").unlink()
    assert call("report", folder.path).code == 0
    assert "did not finish" in folder.report.read_text()


@pytest.mark.parametrize("lost", [("summary.json",), ("summary.json", "clearance.csv")])
def test_a_report_made_later_does_not_pass_what_the_cameras_failed(
    tmp_path: Path, lost: tuple[str, ...]
) -> None:
    run = fake_run.make(every=5)
    seen = run.clearance
    near = replace(seen, distance=seen.distance - 0.05, at_most=seen.at_most - 0.05)
    folder = fake_run.write(replace(run, clearance=near), tmp_path / "run", pictures=False)
    course = RunCourse(run.context.course.started, "virtual", True, True, "finished")
    folder.write_course(course)
    folder.write_end_of_course(course)
    assert folder.summary()["verdict"] == "FAILED"
    for name in lost:
        (folder.path / name).unlink()
    assert call("report", folder.path).code == 0
    assert RunFolder.open(folder.path).summary()["verdict"] == "FAILED"


def test_a_run_that_is_active_has_no_report_yet(killed: RunFolder, tmp_path: Path) -> None:
    folder = cut(killed, tmp_path / "run")
    with folder.held():
        one_message(call("report", folder.path), 2, "still in progress")
    assert call("report", folder.path).code == 0


def test_what_a_program_wrote_while_it_ran_is_what_it_writes_at_the_end(
    short_plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_table = RunFolder.write_table

    def not_cycles(folder: RunFolder, name: str, table: Table) -> None:
        if name != "cycles.csv":
            write_table(folder, name, table)

    monkeypatch.setattr(RunFolder, "write_table", not_cycles)
    run = ("run", short_plan, "--rig", RIG, "--fast", "--no-camera", "-o")
    assert call(*run, tmp_path / "appended").code == 0
    monkeypatch.undo()
    assert call(*run, tmp_path / "written").code == 0
    appended = (tmp_path / "appended/cycles.csv").read_bytes()
    assert appended == (tmp_path / "written/cycles.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize(("number", "path_mm", "whole"), [(31, 1.0, True), (32, 15.0, False)])
def test_cycles_up_to_the_last_second_outlive_a_kill_of_the_program_or_of_all_of_it(
    slow_run: PreparedRun,
    slow_rig: Path,
    short_plan: Path,
    tmp_path: Path,
    number: int,
    path_mm: float,
    whole: bool,
) -> None:
    run = tmp_path / "run"
    with moving_over_udp(slow_run, slow_rig, short_plan, run, number) as (process, _):
        child = real_time_process(process.pid)
        elapsed = wait_until(lambda status: (status["path_mm"] or 0.0) > path_mm)
        if whole:
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        process.kill()
        process.wait()
        wait_until_gone(child)
    ended = RunFolder(run).course().final_state  # a busy computer may have stopped it before
    table = RunFolder(run).cycles_cut_short(8)
    assert table.time[-1] > elapsed - 1.0
    answer = call("report", run, "--json")
    assert answer.code == 0, answer
    summary = json.loads(answer.out)
    assert summary["cycles"] == len(table)
    assert summary["final_state"] == (ended or "not_ended")


@pytest.mark.slow
@pytest.mark.real_time
def test_a_folder_that_is_removed_while_drives_move_ends_in_a_latched_fault(
    slow_run: PreparedRun, slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run, number = tmp_path / "run", 33
    with moving_over_udp(slow_run, slow_rig, short_plan, run, number) as (process, _):
        while run.exists():  # a file that is made meanwhile keeps it
            shutil.rmtree(run, ignore_errors=True)
        out, err = process.communicate()
    assert process.returncode == 1, (out, err)
    assert "\nFAILED " in out
    assert "some files of the run could not be written" in err
    channel = f"239.74.163.22:{20000 + (os.getpid() * 7 + number) % 20000}"
    latched = FaultLatch(BusSettings("udp_multicast", channel)).read()
    assert latched is not None
    assert "recording failed" in latched.cause


def wait_until(enough: Callable[[dict[str, float]], bool]) -> float:
    """Waits until the run reports it, or ends; returns its last reported time, [s]."""
    elapsed = 0.0
    while True:
        with find_runs() as runs:
            answers = ask_all(runs, "status")
        if not answers or answers[0].status is None:
            return elapsed
        elapsed = float(answers[0].status["elapsed_s"] or 0.0)
        if enough(answers[0].status):
            return elapsed
        signal.sigtimedwait([], 0.01)
