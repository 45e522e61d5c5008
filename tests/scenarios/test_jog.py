"""Jogging: a short, slow, straight run from the current pose, denied by default."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.cia402.state_machine import DriveState
from executor.jogging import plan_straight_move
from executor.recording.run_folder import RunFolder
from executor.trajectory.setpoints import PreparedRun
from model.plan import plan_from_document
from model.pose import Pose
from model.rig import load_rig
from model.scene import empty_scene
from planner.check import verify
from tests.cli.plans import RIG
from tests.cli.program import call, one_message
from tests.planner.anytime_6d.rotating_scenes import upside_down
from tests.scenarios.test_real_time import drives_on

BY = ("--by-mm", "6", "0", "8")


def test_a_jog_is_a_slow_straight_run_from_where_the_platform_is(tmp_path: Path) -> None:
    run = tmp_path / "jog"
    answer = call("jog", RIG, *BY, "--no-scene", "--fast", "-o", run, "--json")
    assert answer.code == 0, answer
    summary = json.loads(answer.out)
    assert summary["verdict"] == "PASSED"
    assert summary["path_length_mm"] == pytest.approx(10.0, abs=1e-6)
    folder = RunFolder.open(run)
    assert folder.rig().motion.speed == pytest.approx(0.005)
    cycles = folder.cycles()
    speeds = np.linalg.norm(np.diff(cycles.planned, axis=0), axis=1) / 0.01
    assert speeds.max() <= 0.005 * (1 + 1e-6)
    goal = load_rig(RIG).home.position + np.array([0.006, 0.0, 0.008])
    assert cycles.encoder[-1] == pytest.approx(goal, abs=1e-5)


def test_a_platform_frame_that_points_down_is_jogged_home_like_any_other() -> None:
    rig = upside_down(load_rig(RIG))
    tilted = rig.home.rotation @ Rotation.from_euler("x", 3.0, degrees=True).as_matrix()
    start = Pose(rig.home.position + 0.005, tilted)
    plan = plan_from_document(plan_straight_move(rig, empty_scene(rig), start, rig.home))
    assert verify(plan).plan.waypoints[-1].angle_to(rig.home) < 1e-6


@pytest.mark.parametrize(
    ("options", "code", "part"),
    [
        (("--by-mm", "30", "30", "30", "--no-scene"), 3, "exceeds 50 mm"),
        (("--by-mm", "0", "0", "0", "--no-scene"), 2, "jog distance is zero"),
        (("--by-mm", "nan", "0", "0", "--no-scene"), 2, "give a finite number"),
        (BY, 2, "obstacles are unknown"),
        ((*BY, "--no-scene", "--scene", "scene.yaml"), 2, "obstacles are unknown"),
        ((*BY, "--no-scene", "--fast", "--interface", "udp_multicast"), 2, "--fast"),
        (("--fast",), 2, "no motion given"),
        (("--to-home", *BY), 2, "contradict each other"),
        (("--to-home",), 2, "obstacles are unknown"),
        ((*BY, "--no-scene", "--limit-n", "20"), 2, "no effect here: --limit-n"),
    ],
)
def test_what_is_not_clearly_allowed_is_denied(
    tmp_path: Path, options: tuple[str, ...], code: int, part: str
) -> None:
    run = tmp_path / "jog"
    one_message(call("jog", RIG, *options, "-o", run), code, part)
    assert not run.exists()


ONE = ("--cable", "3", "--mm", "1")


@pytest.mark.parametrize(
    ("options", "code", "part"),
    [
        (("--cable", "3"), 2, "needs both"),
        (("--mm", "3"), 2, "needs both"),
        (("--cable", "9", "--mm", "1"), 2, "no cable 9"),
        (("--cable", "3", "--mm", "0"), 2, "jog distance is zero"),
        (("--cable", "3", "--mm", "nan"), 2, "give a finite number"),
        (("--cable", "3", "--mm", "51"), 3, "exceeds the limit of 50 mm"),
        ((*ONE, "--limit-n", "101"), 3, "limit of 101 N"),
        ((*ONE, *BY), 2, "no effect here: --by-mm"),
        ((*ONE, "--to-home", "--scene", "none.yaml"), 2, "no effect here: --to-home, --scene"),
        ((*ONE, "--no-scene", "--clearance-mm", "0"), 2, "--no-scene, --clearance-mm"),
    ],
)
def test_what_is_not_clearly_meant_moves_no_cable(
    options: tuple[str, ...], code: int, part: str
) -> None:
    one_message(call("jog", RIG, *options, "--fast"), code, part)


HELD = ("--hold-to-run", "--one-cable")


@pytest.mark.parametrize(
    ("options", "code", "part"),
    [
        (("--one-cable",), 2, "--one-cable needs --hold-to-run"),
        ((*HELD, "--keys"), 2, "without --keys"),
        ((*HELD, "--limit-n", "101"), 3, "limit of 101 N"),
        ((*HELD, *BY), 2, "no effect here: --by-mm"),
        ((*HELD, "-o", "run"), 2, "no effect here: --output"),
        ((*HELD, "--no-scene"), 2, "no effect here: --no-scene"),
        ((*HELD, "--fast"), 2, "no effect here: --fast"),
        (("--hold-to-run", "--no-scene", "--limit-n", "20"), 2, "no effect here: --limit-n"),
    ],
)
def test_what_is_not_clearly_meant_enables_no_drive(
    options: tuple[str, ...], code: int, part: str
) -> None:
    one_message(call("jog", RIG, *options), code, part)


def test_a_jog_into_an_obstacle_is_denied(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "schema_version: 1\nname: plate\nclearance: {obstacle_mm: 10, self_mm: 5}\n"
        "start: {position_mm: [0, 0, 300]}\ngoal: {position_mm: [0, 0, 310]}\n"
        "obstacles:\n"
        "  - {name: plate, box: {size_mm: [60, 60, 10]}, position_mm: [0, 0, 540]}\n"
    )
    run = tmp_path / "jog"
    answer = call("jog", RIG, "--by-mm", "0", "0", "20", "--scene", scene, "--fast", "-o", run)
    assert answer.code in (1, 2, 3), answer
    assert "plate" in answer.said
    assert not run.exists()
    away = call("jog", RIG, "--by-mm", "0", "0", "-10", "--scene", scene, "--fast", "-o", run)
    assert away.code == 0, away


@pytest.mark.slow
@pytest.mark.real_time
def test_on_a_bus_it_begins_where_the_drives_are_and_is_not_home(
    slow_run: PreparedRun, slow_rig: Path, tmp_path: Path
) -> None:
    channel = f"239.74.163.24:{20000 + (os.getpid() * 13) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel, "--yes", "--without-real-time")
    with drives_on(channel, slow_run) as rehearsal:
        for number in (1, 2):
            before = rehearsal.pose.position
            run = tmp_path / f"jog-{number}"
            answer = call("jog", slow_rig, "--by-mm", "5", "0", "0", "--no-scene", *bus, "-o", run)
            assert answer.code == 0, answer
            moved = rehearsal.pose.position - before
            assert moved == pytest.approx([0.005, 0.0, 0.0], abs=5e-5)
            assert {drive.state for drive in rehearsal.drives} == {DriveState.QUICK_STOP_ACTIVE}
