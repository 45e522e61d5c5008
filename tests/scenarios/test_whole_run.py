"""A complete run with the real program: its files are complete and consistent."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from executor.recording.run_folder import RunFolder
from model.kinematics import cables_to
from model.plan import load_plan
from model.rig import Rig, load_rig
from model.winches import WinchMap
from tests.cli.plans import HALL, RIG
from tests.cli.program import Answer, call


@pytest.fixture(scope="module")
def answer_and_folder(
    short_plan: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Answer, RunFolder]:
    """The run with the synthetic camera."""
    path = tmp_path_factory.mktemp("a folder") / "a run"
    answer = call("run", short_plan, "--rig", RIG, "-o", path, "--fast")
    return answer, RunFolder.open(path)


@pytest.fixture(scope="module")
def folder(answer_and_folder: tuple[Answer, RunFolder]) -> RunFolder:
    return answer_and_folder[1]


@pytest.fixture(scope="module")
def summary(folder: RunFolder) -> dict[str, Any]:
    return folder.summary()


def lengths_of(rig: Rig, folder: RunFolder) -> np.ndarray:
    """Free lengths of the drives' counts, computed from the winches' data alone."""
    cycles, winches = folder.cycles(), WinchMap(rig)
    counts_per_metre = np.array([w.counts_per_metre for w in rig.winches])
    change = cycles.actual_counts / counts_per_metre
    there = np.array([w.drum_to_outlet for w in rig.winches])
    tensions = np.where(np.isnan(cycles.tensions), cycles.planned_tensions, cycles.tensions)
    whole = (winches.home_unstrained + change) * (1.0 + tensions / rig.cable_stiffness)
    return np.asarray(whole - there)


def test_the_verdict_is_reported_with_the_path_of_the_report(
    answer_and_folder: tuple[Answer, RunFolder],
) -> None:
    answer, folder = answer_and_folder
    assert answer.code == 0, answer
    assert "PASSED" in answer.out
    assert f"report: {folder.report}" in answer.out.splitlines()


def test_every_file_of_the_run_folder_is_there_and_no_other(folder: RunFolder) -> None:
    assert {path.name for path in folder.path.iterdir()} == {
        "SHA256SUMS",
        "clearance.csv",
        "cycles.csv",
        "events.jsonl",
        "pictures",
        "plan.json",
        "poses.csv",
        "fused.csv",
        "report.html",
        "rig.json",
        "run.json",
        "run.mcap",
        "summary.json",
    }


def test_the_plan_in_the_folder_is_the_plan_that_was_run(
    folder: RunFolder, short_plan: Path, summary: dict[str, Any]
) -> None:
    assert (folder.path / "plan.json").read_bytes() == short_plan.read_bytes()
    assert summary["plan_hash"] == load_plan(short_plan).document.hash
    assert folder.rig().hash == load_rig(RIG).hash == summary["rig_hash"]


def test_cycles_events_and_summary_agree(folder: RunFolder, summary: dict[str, Any]) -> None:
    cycles, events = folder.cycles(), folder.events()
    assert len(cycles) == summary["cycles"]
    assert np.allclose(np.diff(cycles.time), 0.010), "a cycle every 10 ms of simulated time"
    assert (np.diff(cycles.path_index) >= 0).all()
    assert np.diff(cycles.path_index).max() <= 1, "no row of the table is skipped"
    states = list(dict.fromkeys(cycles.state))
    assert states == ["enabling", "approaching", "moving", "securing"]
    assert [event.code for event in events] == ["enabled", "moving", "held"]
    begins = {state: cycles.time[cycles.state.index(state)] for state in states}
    for event, state in zip(events, ("approaching", "moving"), strict=False):
        assert abs(event.time_s - begins[state]) <= 0.011
    assert [vars_of(event) for event in events] == summary["events"]
    assert summary["final_state"] == "finished"
    assert summary["lost_replies"] == int(cycles.missing.sum()) == 0
    assert summary["travelled_mm"] == pytest.approx(cycles.travelled[-1] * 1000.0)
    assert summary["duration_s"] == pytest.approx(len(cycles) * 0.010)


def vars_of(event: Any) -> dict[str, Any]:
    return {"time_s": event.time_s, "code": event.code, "text": event.text}


def test_the_platform_follows_within_a_tenth_of_a_millimetre(
    folder: RunFolder, summary: dict[str, Any]
) -> None:
    cycles = folder.cycles()
    assert summary["following_error_mm"]["max"] <= 0.1
    assert np.nanmax(cycles.following_error) <= 1e-4
    assert summary["encoder_error_mm"]["max"] <= 0.1
    goal = load_plan(folder.path / "plan.json").waypoints[-1].position
    assert np.linalg.norm(cycles.encoder[-1] - goal) < 1e-4
    moving = np.array(cycles.state) == "moving"
    steps = np.linalg.norm(np.diff(cycles.planned[moving], axis=0), axis=1) / 0.010
    assert steps.max() <= 0.020 * (1 + 1e-3)


@pytest.mark.parametrize("which", ["short", "hall"])
def test_poses_from_drive_positions_agree_with_an_independent_method(
    request: pytest.FixtureRequest, which: str
) -> None:
    """Counts → lengths by the winches' data; lengths ← the logged pose by inverse kinematics."""
    folder = request.getfixturevalue("folder" if which == "short" else "hall_folder")
    rig, cycles = folder.rig(), folder.cycles()
    anchors = cycles.encoder[:, None, :] + rig.anchors
    lengths = cables_to(rig, anchors).lengths
    following = np.array(cycles.state) == "moving"
    assert np.abs(lengths_of(rig, folder) - lengths)[following].max() < 2e-4
    assert np.abs(cycles.lengths - lengths_of(rig, folder))[following].max() < 1e-6


def test_the_camera_measures_within_a_millimetre(
    folder: RunFolder, summary: dict[str, Any]
) -> None:
    poses = folder.poses()
    assert len(poses) == pytest.approx(summary["duration_s"] * 10.0, abs=2)
    assert poses.ok.all()
    error = poses.error[poses.time >= folder.cycles().path_began]
    rms = float(np.sqrt(np.mean(error**2)))
    assert rms < 1e-3
    assert summary["tag_error_mm"]["rms"] == pytest.approx(rms * 1000.0, rel=1e-3)
    assert summary["tag_error_mm"]["frames"] == len(poses)
    kept = [name for name in poses.picture if name]
    assert len(kept) >= 6
    for name in kept:
        assert (folder.path / name).read_bytes().startswith(b"\xff\xd8")


def test_measured_clearance_is_not_below_the_plan_by_more_than_its_uncertainty(
    folder: RunFolder, summary: dict[str, Any]
) -> None:
    clearance = folder.clearance()
    for source in ("tag", "encoder"):
        rows = clearance.of(source)
        assert len(rows) > 20
        shortfall = rows.planned_distance - rows.distance
        assert (shortfall <= rows.uncertainty).all()
        assert (rows.uncertainty > 0.0).all()
        assert np.nanmedian(rows.uncertainty) < 0.005
    assert summary["clearance_mm"]["source"] == "tag"
    least = clearance.of("tag").distance.min()
    assert summary["clearance_mm"]["measured_min"] == pytest.approx(least * 1000.0, abs=1e-3)


def test_tables_have_a_value_in_every_column_of_every_row(folder: RunFolder) -> None:
    for name in ("cycles.csv", "poses.csv", "clearance.csv", "fused.csv"):
        with (folder.path / name).open(newline="") as file:
            header, *rows = list(csv.reader(file))
        assert rows
        assert all(len(row) == len(header) for row in rows)
        assert len(set(header)) == len(header)


def fused_rows(folder: RunFolder) -> Any:
    return np.genfromtxt(folder.path / "fused.csv", delimiter=",", names=True)


def test_drives_and_camera_together_give_a_pose_every_cycle(folder: RunFolder) -> None:
    rows, cycles, poses = fused_rows(folder), folder.cycles(), folder.poses()
    first = poses.time[poses.ok][0]
    assert first <= rows["time_s"][0] <= first + 0.011
    assert rows["time_s"][-1] == pytest.approx(cycles.time[-1])
    position = np.column_stack([rows[f"{axis}_mm"] for axis in "xyz"])
    planned = cycles.planned[-len(rows) :] * 1e3
    assert np.linalg.norm(position - planned, axis=1).max() < 1.0
    assert rows["age_s"].max() < 0.5


def test_the_mcap_file_holds_as_much_as_the_tables(folder: RunFolder) -> None:
    counts: dict[str, int] = {}
    last: dict[str, int] = {}
    with folder.mcap.open("rb") as file:
        for _schema, channel, message in make_reader(file).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            assert message.log_time >= last.get(channel.topic, 0)
            last[channel.topic] = message.log_time
            if channel.message_encoding == "json":
                json.loads(message.data)
    assert counts["/drives"] == len(folder.cycles())
    assert counts["/tag_pose"] == int(folder.poses().ok.sum())
    assert counts["/fused_pose"] == len(fused_rows(folder))
    assert counts["/clearance"] == len(folder.clearance())
    assert counts["/events"] == len(folder.events())
    assert counts["/pictures"] == sum(1 for name in folder.poses().picture if name)


def test_the_report_is_one_file_with_the_verdict_at_its_top(
    folder: RunFolder, summary: dict[str, Any]
) -> None:
    page = folder.report.read_text()
    assert summary["sentence"] in page
    text = re.sub(r"<(style|script)\b.*?</\1>", "", page, flags=re.DOTALL)
    visible = " ".join(re.sub(r"<[^>]+>", " ", text).split())
    assert 0 < visible.index("PASSED") < 600
    assert text.index("PASSED") < text.index("<svg")
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", page), "no outside request"
    assert len(page) < 6_000_000


def test_the_report_is_made_again_from_the_folder_alone(folder: RunFolder) -> None:
    before = folder.report.read_bytes()
    folder.report.unlink()
    answer = call("report", folder.path)
    assert answer.code == 0
    assert answer.out == f"report: {folder.report}\n"
    again = folder.report.read_bytes()
    assert abs(len(again) - len(before)) < 1000


@pytest.fixture(scope="module")
def hall_folder(hall_plan: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """Ten drives, pulleys, payload, a made-up draught; no camera in the rig file."""
    path = tmp_path_factory.mktemp("hall run") / "run"
    answer = call("run", hall_plan, "--rig", HALL, "-o", path, "--fast", "--no-camera")
    assert answer.code == 0, answer
    return RunFolder.open(path)


def test_ten_drives_with_pulleys_and_payload_run_without_a_camera(hall_folder: RunFolder) -> None:
    summary = hall_folder.summary()
    assert summary["verdict"] == "PASSED"
    assert summary["tag_error_mm"] is None
    assert summary["clearance_mm"]["source"] == "encoder"
    assert summary["following_error_mm"]["max"] <= 0.1
    assert hall_folder.cycles().cable_count == 10
    assert len(hall_folder.poses()) == 0
    rig = hall_folder.rig()
    tensions = hall_folder.cycles().tensions
    assert np.nanmin(tensions) >= rig.min_tension
    assert np.nanmax(tensions) <= rig.max_tension


def test_the_drives_carry_platform_and_payload(hall_folder: RunFolder) -> None:
    """Measured tensions times the cables' directions hold up 15 kg, in every tenth cycle."""
    rig, cycles = hall_folder.rig(), hall_folder.cycles()
    following = np.flatnonzero(np.isfinite(cycles.tensions).all(axis=1))[20::10]
    anchors = cycles.encoder[following, None, :] + rig.anchors
    pull = np.einsum("nm,nmi->ni", cycles.tensions[following], cables_to(rig, anchors).directions)
    # Torque readings are whole per mille of 800 N on each of ten cables.
    assert np.abs(pull - np.array([0.0, 0.0, 15.0 * 9.80665])).max() < 4.0


def test_the_same_run_twice_is_the_same_to_the_last_digit(
    folder: RunFolder, short_plan: Path, tmp_path: Path
) -> None:
    """Simulated time, drives and platform are deterministic."""
    again = tmp_path / "again"
    answer = call("run", short_plan, "--rig", RIG, "-o", again, "--fast", "--no-camera")
    assert answer.code == 0
    assert (again / "cycles.csv").read_bytes() == (folder.path / "cycles.csv").read_bytes()
    assert (again / "events.jsonl").read_bytes() == (folder.path / "events.jsonl").read_bytes()
