"""The verdict: passed only if all measurements kept their limits; reasons state values."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from executor.evaluation import _planned
from executor.recording.clearance import ClearanceTable, no_clearance
from executor.recording.record_files import CameraRecord, RunCourse
from executor.recording.run_folder import RunEvent
from executor.recording.summary import _clearance, summarize
from executor.recording.tables import CycleTable, PoseTable
from executor.recording.verdict import distances, encoder_pose, following, replies, tensions
from executor.report.page import _nearest
from executor.report.tiles import chips
from executor.trajectory.path import rounded
from model.files.scene_file import StopDocument
from model.pose import Array, Pose, matrix_from_rotation_vector
from model.statics.wrench_sets import rms_anchor_radius
from tests.executor import fake_run


@pytest.fixture(scope="module")
def run() -> fake_run.FakeRun:
    return fake_run.make(rate_hz=2.0, every=20)


def summary(run: fake_run.FakeRun, **context: Any) -> dict[str, Any]:
    return replace(run, context=fake_run.changed(run.context, **context)).summary


def rows(
    source: str, distance_mm: float, uncertainty_mm: float, planned_mm: float
) -> ClearanceTable:
    one = np.array([distance_mm / 1e3])
    planned = np.array([planned_mm / 1e3])
    return ClearanceTable(
        np.array([3.25]),
        (source,),
        one,
        np.array([uncertainty_mm / 1e3]),
        np.array([(distance_mm + uncertainty_mm) / 1e3]),
        ("cable 3",),
        ("box",),
        planned,
        ("box",),
        one[:, None],
        planned[:, None],
    )


def joined(*tables: ClearanceTable) -> ClearanceTable:
    """The rows of tables of the same obstacles."""
    columns = {f.name: [getattr(one, f.name) for one in tables] for f in fields(ClearanceTable)}
    made = {
        name: sum(each, ()) if isinstance(each[0], tuple) else np.concatenate(each)
        for name, each in columns.items()
    }
    return ClearanceTable(**made | {"obstacles": tables[0].obstacles})


def test_a_good_run_passes_and_says_by_how_much(run: fake_run.FakeRun) -> None:
    made = run.summary
    assert (made["verdict"], made["passed"]) == ("PASSED", True)
    assert made["sentence"] == "The run reached the goal and met every check."
    assert any("limit 2 mm" in reason for reason in made["reasons"])
    assert all(any(sign.isdigit() for sign in reason) for reason in made["reasons"])


@pytest.mark.parametrize(
    ("travelled_mm", "said"),
    [
        (0.0, "0 mm"),
        (0.3, "0.3 mm"),
        (0.5, "0.5 mm"),
        (0.04, "0.04 mm"),
        (9.876, "9.88 mm"),
        (57.6, "58 mm"),
    ],
)
def test_a_short_jog_is_not_rounded_to_whole_millimetres(
    run: fake_run.FakeRun, travelled_mm: float, said: str
) -> None:
    travelled = np.linspace(0.0, travelled_mm / 1e3, len(run.cycles))
    made = replace(run, cycles=replace(run.cycles, travelled=travelled)).summary
    assert any(f"s and {said}." in reason for reason in made["reasons"])


def test_the_figures_are_those_of_the_tables(run: fake_run.FakeRun) -> None:
    made, cycles, poses = run.summary, run.cycles, run.poses
    off = np.linalg.norm(cycles.encoder - cycles.planned, axis=1) * 1e3
    assert made["encoder_error_mm"]["max"] == pytest.approx(off.max(), abs=1e-6)
    assert made["encoder_error_mm"]["rms"] == pytest.approx(np.sqrt((off**2).mean()), abs=1e-6)
    seen = [k for k, status in enumerate(poses.status) if status == "ok"]
    tag = np.linalg.norm(poses.position[seen] - poses.planned[seen], axis=1) * 1e3
    assert made["tag_error_mm"] == {
        "max": pytest.approx(tag.max(), abs=1e-6),
        "rms": pytest.approx(np.sqrt((tag**2).mean()), abs=1e-6),
        "frames": len(poses),
        "frames_without_pose": len(poses) - len(seen),
    }
    by_camera = [k for k, s in enumerate(run.clearance.source) if s == "tag"]
    least = min(by_camera, key=lambda k: run.clearance.distance[k])
    assert made["clearance_mm"]["source"] == "tag"
    assert made["clearance_mm"]["at_s"] == run.clearance.time[least]
    assert made["clearance_mm"]["pair"][1] == run.clearance.obstacle[least]
    assert made["tension_n"]["planned_max"] == pytest.approx(
        cycles.planned_tensions.max(), abs=1e-4
    )
    assert made["started"] == "2026-03-04T05:06:07.000+00:00"
    assert made["lateness_ms"] is None


def test_without_camera_and_obstacles_these_figures_are_null(run: fake_run.FakeRun) -> None:
    made = replace(run, poses=PoseTable.empty(), clearance=no_clearance()).summary
    assert made["passed"]
    assert made["tag_error_mm"] is None
    assert made["clearance_mm"] is None


def test_lateness_is_reported_for_a_run_in_real_time(run: fake_run.FakeRun) -> None:
    late = np.arange(len(run.cycles)) * 1e-6
    slow = replace(run, cycles=replace(run.cycles, lateness=late))
    made = summary(slow, fast=False)
    assert made["lateness_ms"]["max"] == pytest.approx(late[-1] * 1e3, abs=1e-4)
    assert made["lateness_ms"]["p50"] == pytest.approx(np.median(late) * 1e3, abs=1e-4)


def test_a_warning_of_a_drive_is_stated_with_the_verdict(run: fake_run.FakeRun) -> None:
    limit = "cable 4 (drive 4) reports that an internal limit is active (bit 11 of 6041h)"
    made = summary(run, events=(RunEvent(1.0, "drive_warning", limit),))
    assert made["verdict"] == "PASSED"
    assert f"Warning: {limit}." in made["reasons"]


def test_a_stopped_run_is_not_passed_and_not_a_fault(run: fake_run.FakeRun) -> None:
    events = (RunEvent(1.0, "stop", "The operator stopped the run."),)
    made = summary(run, final_state="stopped", events=events)
    assert (made["verdict"], made["passed"]) == ("STOPPED", False)
    assert made["reasons"] == [
        "The run ended after 42.8 s and 854 mm, before the goal: The operator stopped the run."
    ]


@pytest.mark.parametrize("after", ["securing", "latched"])
def test_reasons_state_when_the_motion_ended(run: fake_run.FakeRun, after: str) -> None:
    """Not when the record ended, with the drives at rest."""
    states = list(run.cycles.state)
    states[150:] = [after] * len(states[150:])
    ended = replace(run, cycles=replace(run.cycles, state=tuple(states)))
    (reason,) = summary(ended, final_state="stopped", cause="stopped")["reasons"][:1]
    assert f"after {run.cycles.time[149]:.1f} s" in reason


@pytest.mark.parametrize(
    ("leg", "at", "turn_deg", "where"),
    [
        (1, "goal", 0.0, "before the goal"),
        (2, "goal", 0.0, "at the goal"),
        (2, "goal", 1.0, "before the goal"),
        (2, "start", 0.0, "before the goal"),
    ],
)
def test_a_run_ends_at_the_goal_only_at_the_end_of_its_last_leg(
    run: fake_run.FakeRun, leg: int, at: str, turn_deg: float, where: str
) -> None:
    """A task may begin where it ends, pass there in between, or only rotate on its last leg."""
    scene, count = run.context.plan.scene, len(run.cycles)
    stop = StopDocument(name="shelf", position_mm=[0.0, 0.0, 400.0])
    half = np.radians(turn_deg) / 2.0
    cycles = replace(
        run.cycles,
        leg=np.full(count, leg),
        planned=np.tile(getattr(scene, at).position, (count, 1)),
        planned_rotation=np.tile([np.cos(half), 0.0, 0.0, np.sin(half)], (count, 1)),
    )
    plan = replace(run.context.plan, scene=scene.changed(stops=[stop]))
    ended = replace(run, cycles=cycles, context=replace(run.context, plan=plan))
    made = summary(ended, final_state="stopped")
    assert made["sentence"] == f"The run was stopped {where}."


def test_a_fault_is_failed_and_names_its_cause_even_when_notes_follow(
    run: fake_run.FakeRun,
) -> None:
    events = (RunEvent(1.0, "following_error", "cable 4 jammed"), RunEvent(1.1, "late", "a note"))
    assert "a note" in summary(run, final_state="latched", events=events)["reasons"][0]
    made = summary(run, final_state="latched", events=events, cause="cable 4 jammed")
    assert made["verdict"] == "FAILED"
    assert "cable 4 jammed" in made["reasons"][0]


FIRST = "cable 5 (drive 5): over-current; quick stop of all drives"
HOLDS = "cable 6 (drive 6) stopped on its own: quick stop active"
UNHELD = "cable 4 (drive 4) restarted; drives still enabled: cable 3 (drive 3)"


@pytest.mark.parametrize("cause", [FIRST, f"{FIRST}; {UNHELD}"])
def test_drives_that_may_not_hold_are_named_besides_the_cause(
    run: fake_run.FakeRun, cause: str
) -> None:
    """Each once, also in the folder of an earlier version, whose cause lacks them."""
    codes = ("drive_fault", "drive_fault", "not_held")
    texts = (FIRST, HOLDS, UNHELD)
    events = tuple(RunEvent(1.0, *each) for each in zip(codes, texts, strict=True))
    made = summary(run, final_state="latched", events=events, cause=cause)
    said = f"Some drives may not hold: {UNHELD}. "
    said += "Support the platform and press the emergency stop."
    assert [c["text"] for c in made["checks"] if c["name"] == "held"] == [said]
    assert made["reasons"][0].endswith(f"{FIRST}.")
    alone = summary(run, final_state="latched", events=events[:2], cause=FIRST)
    assert "held" not in [check["name"] for check in alone["checks"]]


def test_a_stopped_run_that_broke_a_limit_is_failed(run: fake_run.FakeRun) -> None:
    near = replace(run, clearance=rows("tag", 5.0, 1.0, 5.0))
    assert summary(near, final_state="stopped")["verdict"] == "FAILED"


def test_a_run_of_no_cycles_fails_with_a_whole_summary(run: fake_run.FakeRun) -> None:
    none = CycleTable(**{f.name: getattr(run.cycles, f.name)[:0] for f in fields(CycleTable)})
    early = replace(run, cycles=none, poses=PoseTable.empty(), clearance=no_clearance())
    made = summary(early, final_state="latched", fast=False)
    assert made["verdict"] == "FAILED"
    assert made["following_error_mm"]["max"] is None
    assert made["travelled_mm"] is None


@pytest.mark.parametrize(("worst_mm", "passed"), [(1.999, True), (2.0, True), (2.001, False)])
def test_the_following_error_is_held_against_its_limit(
    run: fake_run.FakeRun, worst_mm: float, passed: bool
) -> None:
    errors = np.full(len(run.cycles), np.nan)
    errors[17] = worst_mm / 1e3
    check = following(replace(run.cycles, following_error=errors), 0.002)
    assert check.passed is passed
    assert f"{worst_mm:.3f} mm" in check.text


def test_no_drive_position_at_all_does_not_pass(run: fake_run.FakeRun) -> None:
    unknown = replace(run.cycles, following_error=np.full(len(run.cycles), np.nan))
    assert not following(unknown, 0.002).passed


def test_positions_that_were_received_are_not_denied(run: fake_run.FakeRun) -> None:
    """Drives that were never enabled still report positions; there is no error to judge."""
    unknown = np.full(len(run.cycles), np.nan)
    asked = len(run.cycles) * run.cycles.cable_count
    for lost, expected in (
        (0, f"{asked} of {asked} replies"),
        (1, f"{asked - 1} of {asked} replies"),
        (asked, "No drive position was ever received."),
    ):
        missing = np.zeros(len(run.cycles), dtype=int)
        missing[: lost // 8] = 8
        missing[-1] += lost % 8
        check = following(replace(run.cycles, following_error=unknown, missing=missing), 0.002)
        assert not check.passed
        assert expected in check.text
        assert ("No drive position" in check.text) is (lost == asked)


@pytest.mark.parametrize(("simulated", "passed"), [(True, False), (False, True)])
def test_lost_replies_fail_simulated_drives_and_are_reported_on_a_bus(
    run: fake_run.FakeRun, simulated: bool, passed: bool
) -> None:
    missing = run.cycles.missing.copy()
    missing[3] = 2
    context = fake_run.changed(run.context, simulated=simulated)
    check = replies(replace(run.cycles, missing=missing), context)
    assert check.passed is passed
    assert check.text.startswith("2 of ")


@pytest.mark.parametrize("end", ["lost", "silent", "simulated"])
def test_the_drive_with_the_largest_share_of_lost_replies_is_named(
    run: fake_run.FakeRun, end: str
) -> None:
    share = "largest share of lost replies: cable 3 (drive 3), 2 of 300"
    events = [RunEvent(1.0, "reply_lost", "cable 3 (drive 3) did not answer for 1 cycle")]
    events += [RunEvent(1.5, "drive_silent", "cable 3 (drive 3): gone")] if end == "silent" else []
    events += [RunEvent(2.0, "reply_lost", share)]
    missing = run.cycles.missing.copy()
    missing[[3, 9]] = 1
    context = fake_run.changed(run.context, simulated=end == "simulated", events=tuple(events))
    check = replies(replace(run.cycles, missing=missing), context)
    assert check.passed is (end == "lost")
    assert check.text.endswith(f"; {share}.")


@pytest.mark.parametrize(
    ("final_state", "few"),
    [("finished", True), ("stopped", True), ("latched", False), ("not_ended", False)],
)
def test_replies_lost_in_a_run_that_ended_with_a_fault_are_not_called_few(
    run: fake_run.FakeRun, final_state: str, few: bool
) -> None:
    """As of a drive that restarted and then was silent to the end."""
    missing = (np.arange(len(run.cycles)) >= 150).astype(int)
    context = fake_run.changed(run.context, simulated=False, final_state=final_state)
    check = replies(replace(run.cycles, missing=missing), context)
    assert check.passed
    assert ("too few" in check.text) is few
    assert check.text.startswith(f"{len(run.cycles) - 150} of ")


@pytest.mark.parametrize(
    ("tension", "passed"), [(2.4, False), (2.6, True), (101.9, True), (102.1, False)]
)
def test_a_slack_or_overloaded_cable_fails_and_is_named(
    run: fake_run.FakeRun, tension: float, passed: bool
) -> None:
    changed = run.cycles.tensions.copy()
    changed[9, 4] = tension
    (check,) = tensions(replace(run.cycles, tensions=changed), run.context.rig)
    assert check.passed is passed
    assert passed or f"Cable 5 {'went slack' if tension < 5 else 'pulled'}" in check.text
    assert "limits 5 and 100 N; a run fails below 2.5 or above 102 N" in check.text


def test_drives_whose_positions_fit_no_pose_on_the_path_fail_the_run(run: fake_run.FakeRun) -> None:
    """The encoders give no clearance there, and no camera may have measured one."""
    assert not [check for check in run.summary["checks"] if check["name"] == "encoder_pose"]
    rows = np.flatnonzero(run.cycles.time >= run.cycles.path_began)[[40, 70]]
    encoder = run.cycles.encoder.copy()
    encoder[rows] = np.nan
    made = replace(run, cycles=replace(run.cycles, encoder=encoder)).summary
    assert made["verdict"] == "FAILED"
    (reason,) = made["reasons"]
    assert f"in 2 cycles on the path, first at {run.cycles.time[rows[0]]:.2f} s" in reason
    missing = run.cycles.missing.copy()
    missing[rows] = 1
    assert not encoder_pose(replace(run.cycles, encoder=encoder, missing=missing))


def test_a_slack_cable_does_not_hide_an_overloaded_one(run: fake_run.FakeRun) -> None:
    changed = run.cycles.tensions.copy()
    changed[9, 4], changed[11, 1] = 1.0, 111.0
    (check,) = tensions(replace(run.cycles, tensions=changed), run.context.rig)
    assert not check.passed
    assert "Cable 5 went slack: 1.00 N at 1.80 s; cable 2 pulled 111.00 N at 2.20 s" in check.text


@pytest.mark.parametrize(
    ("state", "lost", "until"),
    [
        ("latched", {}, ""),
        ("latched", {2: 8}, "; that of cable 3 only until 1.40 s"),
        (
            "latched",
            {2: 8, 4: 9},
            "; that of cable 3 only until 1.40 s; that of cable 5 only until 1.60 s",
        ),
        ("latched", dict.fromkeys(range(8), 8), "; tensions are known only until 1.40 s"),
        (
            "latched",
            {**dict.fromkeys(range(8), 9), 2: 8},
            "; tensions are known only until 1.60 s; that of cable 3 only until 1.40 s",
        ),
        ("moving", dict.fromkeys(range(8), 8), "; tensions are known only until 1.40 s"),
        ("securing", dict.fromkeys(range(8), 8), ""),
    ],
)
def test_tensions_unknown_after_a_fault_are_stated(
    run: fake_run.FakeRun, state: str, lost: dict[int, int], until: str
) -> None:
    """Other runs end with drives that hold on their own; their tensions are those before."""
    cycles, known = run.cycles, run.cycles.tensions.copy()
    for cable, cycle in lost.items():
        known[cycle:, cable] = np.nan
    ended = replace(cycles, tensions=known, state=(*cycles.state[:-1], state))
    (check,) = tensions(ended, run.context.rig)
    assert check.passed
    assert check.text.partition("102 N)")[2] == f"{until}."


def test_drives_without_torque_are_not_judged_by_it(run: fake_run.FakeRun) -> None:
    unknown = replace(run.cycles, tensions=np.full_like(run.cycles.tensions, np.nan))
    assert tensions(unknown, run.context.rig) == []
    assert replace(run, cycles=unknown).summary["tension_n"]["min"] is None


@pytest.mark.parametrize("source", ["tag", "encoder"])
@pytest.mark.parametrize(
    ("distance", "uncertainty", "passed"),
    [(10.0, 0.0, True), (9.9, 0.0, False), (9.0, 1.0, True), (9.0, 0.99, False), (30, 40, True)],
)
def test_a_clearance_fails_only_when_too_small_beyond_its_uncertainty(
    source: str, distance: float, uncertainty: float, passed: bool
) -> None:
    check = distances(rows(source, distance, uncertainty, distance), 0.010)[0]
    assert check.passed is passed
    assert "cable 3 to box" in check.text
    assert "required 10 mm" in check.text
    (upper,) = re.findall(r"to (\d+\.\d) mm \(", check.text)
    assert (float(upper) >= 10.0) is passed, "a verdict contradicts its own figures"


@pytest.mark.parametrize("source", ["tag", "encoder"])
@pytest.mark.parametrize("error", [None, 1.4e-3])
def test_an_interval_that_leaves_out_the_geometry_says_so(source: str, error: float | None) -> None:
    check = distances(rows(source, 20.0, 0.1, 20.0), 0.010, platform_error=error)[0]
    is_exact = ", taking the rig's geometry as exact: 20.0 mm" in check.text
    assert is_exact is (source == "encoder" and error is None)


def test_a_clearance_measured_just_before_the_start_is_at_zero() -> None:
    """By the camera's latency."""
    measured = rows("tag", 20.0, 0.0, 9.0)
    early = replace(measured, time=np.full(len(measured), -0.02))
    assert "at 0.0 s" in distances(early, 0.010)[0].text


@pytest.mark.parametrize("side", [9.9, 10.1])
@pytest.mark.parametrize("together", [True, False])
def test_a_clearance_that_one_of_several_cameras_measures_counts_too(
    side: float, together: bool
) -> None:
    """As for the stop: whether or not the others agree."""
    each = [rows("tag:side", side, 0.0, 9.0), rows("tag:front", 30.0, 0.0, 9.0)]
    checks = distances(joined(*each, *[rows("tag", 20.0, 0.0, 9.0)] * together), 0.010)
    found = {check.name: check for check in checks}
    assert found["clearance_tag:side"].passed is (side > 10.0)
    assert f"measured by camera side alone: {side} mm" in found["clearance_tag:side"].text
    assert found["clearance_tag:front"].passed
    assert ("clearance_tag" in found) is together


@pytest.mark.parametrize(("distance", "passed"), [(39.01, True), (38.99, False), (60.0, True)])
def test_the_camera_is_also_held_against_the_plan(distance: float, passed: bool) -> None:
    required, planned = distances(rows("tag", distance, 1.0, 40.0), 0.010)
    assert required.passed
    assert planned.passed is passed
    assert planned.name == "clearance_plan"


@pytest.mark.parametrize("on_path", [False, True])
def test_only_along_the_path_is_the_platform_compared_with_the_plan(
    run: fake_run.FakeRun, on_path: bool
) -> None:
    """Until the first second it approaches the start, from 3 mm beside it."""
    cycles, poses, seen = run.cycles, run.poses, run.clearance
    aside, early = np.array([0.0, 0.003, 0.0]), cycles.time < 1.0
    state = "moving" if on_path else "approaching"
    nearer = (seen.time < 1.0) * (np.array(seen.source) == "tag") * 0.003
    made = replace(
        run,
        cycles=replace(
            cycles,
            state=tuple(state if k else "moving" for k in early),
            encoder=cycles.encoder + early[:, None] * aside,
        ),
        poses=replace(poses, position=poses.position + (poses.time < 1.0)[:, None] * aside),
        clearance=replace(seen, distance=seen.distance - nearer, at_most=seen.at_most - nearer),
    ).summary
    assert made["verdict"] == ("FAILED" if on_path else "PASSED")
    assert (made["encoder_error_mm"]["max"] > 2.0) is on_path
    assert (made["tag_error_mm"]["max"] > 2.0) is on_path
    assert made["tag_error_mm"]["frames"] == len(poses)
    text = next(check["text"] for check in made["checks"] if check["name"] == "camera")
    assert ("largest 0." in text or "largest 1." in text) is not on_path


@pytest.mark.parametrize("source", ["tag", "encoder"])
def test_an_approach_too_near_to_an_obstacle_is_noticed(source: str) -> None:
    checks = distances(rows(source, 9.0, 0.5, 12.0), 0.010, path_began=4.0)
    assert [(check.name, check.passed) for check in checks] == [(f"clearance_{source}", False)]


def test_a_platform_that_never_left_for_its_path_is_not_compared_with_it(
    run: fake_run.FakeRun,
) -> None:
    waiting = replace(run.cycles, state=("enabling",) * len(run.cycles))
    made = summary(replace(run, cycles=waiting), final_state="stopped")
    assert made["encoder_error_mm"] == {"max": None, "rms": None}
    assert made["tag_error_mm"]["rms"] is None
    assert not [check for check in made["checks"] if check["name"] == "clearance_plan"]
    text = next(check["text"] for check in made["checks"] if check["name"] == "camera")
    assert text.endswith("images.")


def test_one_bad_row_among_good_ones_is_found(run: fake_run.FakeRun) -> None:
    """The worst row is the one furthest beyond its own uncertainty, not the smallest distance."""
    good, bad = rows("tag", 9.5, 1.0, 9.5), rows("tag", 9.9, 0.05, 9.9)
    both = joined(good, bad)
    check = distances(both, 0.010)[0]
    assert not check.passed
    assert "9.9 mm, 95 % interval 9.8 to 9.9 mm" in check.text


def test_only_the_smallest_clearance_is_called_so() -> None:
    """A less certain one may be smaller than the one that fails."""
    table = joined(rows("tag", 5.0, 20.0, 5.0), rows("tag", 18.0, 1.0, 18.0))
    failed, passed = (distances(table, required)[0] for required in (0.020, 0.010))
    assert not failed.passed
    assert "Clearance measured by the camera: 18.0 mm, 95 % interval 17.0 to" in failed.text
    assert "mallest" not in failed.text
    assert passed.passed
    assert "Smallest clearance measured by the camera: 5.0 mm" in passed.text


def test_an_interval_with_two_halves_is_not_given_by_one_of_them() -> None:
    table = replace(rows("tag", 20.0, 4.0, 20.4), at_most=np.array([0.0206]))
    check = distances(table, 0.010)[1]
    assert check.passed
    assert "±" not in check.text
    assert "at most 0.40 mm below the planned one" in check.text
    assert "extends 0.60 mm upwards" in check.text


def test_a_camera_that_never_saw_the_platform_fails_the_run(run: fake_run.FakeRun) -> None:
    count = len(run.poses)
    blind = replace(
        run.poses,
        status=("no tags in the image",) * count,
        position=np.full((count, 3), np.nan),
    )
    made = replace(run, poses=blind).summary
    assert made["verdict"] == "FAILED"
    assert f"None of {count} images gave a pose: no tags in the image." in made["reasons"]


@pytest.mark.parametrize(
    ("poses", "by"), [((9, 9), "2 cameras together"), ((0, 9), "camera side only")]
)
def test_only_cameras_that_gave_a_pose_are_said_to_measure(
    run: fake_run.FakeRun, poses: tuple[int, int], by: str
) -> None:
    cameras = tuple(
        CameraRecord(name, "0", 9, seen, 9 - seen, 2.0, "")
        for name, seen in zip(("front", "side"), poses, strict=True)
    )
    reasons = [text for text in summary(run, cameras=cameras)["reasons"] if by in text]
    assert len([text for text in reasons if "images" in text]) == 1
    assert len([text for text in reasons if "learance" in text]) >= 1
    own = joined(rows("tag", 20.0, 0.0, 9.0), rows("tag:side", 20.0, 0.0, 9.0))
    texts = [check.text for check in distances(own, 0.010, cameras)]
    assert len({*texts}) == len(texts) == 3  # no reason is stated twice


def test_drives_that_say_they_are_simulated_are_believed_on_every_bus() -> None:
    """They may lose replies like real ones: the bus is real."""
    run = fake_run.make(rate_hz=1.0, every=100, camera=False)
    course = RunCourse(run.context.course.started, "udp_multicast", False, False, "finished")
    for events, simulated in (((), False), ((RunEvent(0.0, "simulated", ""),), True)):
        context = replace(run.context, course=course, events=events)
        cycles = replace(run.cycles, missing=run.cycles.missing + (run.cycles.path_index == 0))
        summary = summarize(context, cycles, run.poses, run.clearance)
        assert summary["simulated"] is simulated
        assert summary["verdict"] == "PASSED"
        assert ("simulated drives" in chips(summary)) is simulated


@pytest.mark.parametrize(("until", "source"), [(1.0, "encoder"), (1e9, "tag")])
def test_the_smallest_clearance_is_the_encoders_where_no_camera_looked(
    until: float, source: str
) -> None:
    """Of a run that the camera saw only at its beginning, or throughout."""
    table = fake_run.make(10.0).clearance
    kept = np.array(
        [s == "encoder" or t <= until for s, t in zip(table.source, table.time, strict=True)]
    )
    distance = np.where(np.array(table.source) == "tag", table.distance + 1e-4, table.distance)
    seen = replace(
        table,
        **{
            name: np.array(getattr(table, name))[kept]
            for name in ("time", "uncertainty", "at_most", "planned_distance", "distances")
        },
        distance=distance[kept],
        planned_distances=table.planned_distances[kept],
        **{
            name: tuple(np.array(getattr(table, name))[kept].tolist())
            for name in ("source", "body", "obstacle")
        },
    )
    found = _clearance(seen, 0.0)
    assert found is not None
    assert found["source"] == source
    if source == "encoder":
        assert found["measured_min"] == pytest.approx(table.of("encoder").distance.min() * 1e3)


def passing_a_post(speed: float, camera_at: Array, off: float = 0.0) -> ClearanceTable:
    """A platform that passes a post at 22 mm after 2 s.

    Args:
        speed: Its speed, [m/s].
        camera_at: Times of the images, shape (n,), [s].
        off: By how much the encoders measure too little, [m].
    """

    def rows_of(source: str, times: Array, less: float, spread: float) -> ClearanceTable:
        distance = np.hypot(0.022, speed * (times - 2.0)) - less
        of_post = ("platform",) * len(times), ("post",) * len(times), distance, ("post",)
        uncertainty, each = np.full(len(times), spread), distance[:, None]
        names = (source,) * len(times)
        at_most = distance + uncertainty
        return ClearanceTable(times, names, distance, uncertainty, at_most, *of_post, each, each)

    encoders = rows_of("encoder", np.arange(0.0, 4.0, 0.1), off, 1.5e-4)
    return joined(rows_of("tag", camera_at, 0.0, 2e-3), encoders)


def test_a_camera_that_missed_the_smallest_clearance_does_not_replace_the_encoders() -> None:
    """Images 0.25 s before and after it, at 0.5 m/s: 127 mm, while the encoders measured 22 mm."""
    table = passing_a_post(0.5, np.arange(0.25, 4.0, 0.5))
    found = _clearance(table, 0.020)
    assert found is not None
    assert found["source"] == "encoder"
    assert found["measured_min"] == pytest.approx(22.0)
    measured = [table.of("tag"), table.of("encoder")]
    assert _nearest(measured, 2.0).startswith("clearance 22.0 mm")
    assert _nearest(measured, 1.76).startswith("clearance 126.9 mm")
    slow = passing_a_post(0.005, np.arange(0.25, 4.0, 0.5))
    assert _nearest([slow.of("tag"), slow.of("encoder")], 2.0).startswith("clearance 22.0 mm")


@pytest.mark.parametrize("speed", [0.005, 0.5])
def test_a_camera_that_saw_the_smallest_clearance_counts_before_other_encoders(
    speed: float,
) -> None:
    """Encoders of a rig that is described wrongly measure too little everywhere."""
    found = _clearance(passing_a_post(speed, np.arange(0.0, 4.0, 0.5), off=0.005), 0.020)
    assert found is not None
    assert found["source"] == "tag"
    assert found["measured_min"] == pytest.approx(22.0)


def test_the_noise_of_encoders_does_not_replace_a_camera_that_saw_the_smallest_clearance() -> None:
    table = passing_a_post(0.0, np.arange(0.1, 4.0, 0.2))
    encoders = np.array(table.source) == "encoder"
    distance, uncertainty = table.distance.copy(), np.where(encoders, 1e-3, table.uncertainty)
    distance[np.flatnonzero(encoders)[20]] -= 2.5e-3
    found = _clearance(replace(table, distance=distance, uncertainty=uncertainty), 0.020)
    assert found is not None
    assert found["source"] == "tag"


def test_planned_and_travelled_length_of_a_turning_path_are_of_one_measure(
    run: fake_run.FakeRun,
) -> None:
    plan, weight = run.context.plan, rms_anchor_radius(run.context.rig.anchors)
    assert run.summary["path_length_mm"] == pytest.approx(plan.document.quality.length_mm)
    turns = np.linspace(0.0, 0.3, len(plan.waypoints))[:, None] * [0.0, 0.6, 0.8]
    poses = [
        Pose(pose.position, matrix_from_rotation_vector(turn))
        for pose, turn in zip(plan.waypoints, turns, strict=True)
    ]
    driven = rounded(poses, 0.0, weight, lambda _: True)
    turning = summary(run, plan=replace(plan, waypoints=tuple(poses)))
    assert turning["path_length_mm"] == pytest.approx(driven.length * 1e3)


def test_the_planned_pose_at_an_image_is_between_those_of_two_cycles(
    run: fake_run.FakeRun,
) -> None:
    """At a steady rotation and speed, each is known in closed form; also beyond both ends."""
    times, speed, rate = run.cycles.time, np.array([0.02, 0.0, -0.01]), np.array([0.0, 0.03, 0.04])

    def at(time: float) -> Pose:
        return Pose(time * speed, matrix_from_rotation_vector(time * rate))

    cycles = replace(
        run.cycles,
        planned=times[:, None] * speed,
        planned_rotation=np.array([at(time).quaternion for time in times]),
    )
    wanted = [times[0] - 1.0, times[0], *(times[:5] + 0.7 * (times[1] - times[0])), times[-1] + 1.0]
    samples = [SimpleNamespace(found=SimpleNamespace(time=time)) for time in wanted]
    for time, pose in zip(wanted, _planned(samples, cycles), strict=True):  # type: ignore[arg-type]
        expected = at(min(max(time, times[0]), times[-1]))
        assert pose.distance_to(expected) < 1e-9
        assert np.abs(pose.rotation - expected.rotation).max() < 1e-9
