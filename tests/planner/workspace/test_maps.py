"""Maps against the same quantities pose by pose, and against the paper's values."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import current_process
from pathlib import Path

import numpy as np
import pytest

from model.clearance import ClearanceModel
from model.errors import BadInput
from model.kinematics import structure_matrix
from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Rig
from model.scene import Scene, empty_scene, legs_of
from planner import parallel
from planner.check import NEAR_AXIS, check_path
from planner.costs import KinematicCost, capacity_margins
from planner.space import finite_range
from planner.workspace import compute as computing
from planner.workspace.compute import VERDICTS, compute
from planner.workspace.grid import slice_through, volume
from planner.workspace.maps import Extremes, Question, costs, values_at
from tests.model.statics.robots import largest_smallest_tension

LEVEL = np.eye(3)
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def extremes(gachon):
    return Extremes.over_workspace(Question.about(gachon))


def test_costs_of_singular_poses_are_the_worst_as_in_plans() -> None:
    condition, volume = np.array([1.0, np.inf, 3.0]), np.array([2.0, 0.0, 1.0])
    values = {"condition_number": condition, "force_volume": volume}
    found = costs(values, Extremes((1.0, 3.0), (0.5, 1.0)))
    assert found["dexterity_cost"].tolist() == [0.0, 1.0, 1.0]
    assert found["wrench_cost"].tolist() == [0.0, 1.0, 1.0]
    same = costs(values, Extremes((1.0, 1.0), (0.5, 0.5)))  # of a workspace of one point
    assert same["dexterity_cost"][:2].tolist() == [0.0, 1.0]
    assert finite_range(np.array([2.0, np.inf, 1.0])) == (1.0, 2.0)


def test_a_script_without_the_guard_is_told_of_it(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from planner.parallel import worker_pool\n"
        "with worker_pool(2, None) as pool:\n    print(list(pool.map(abs, [1, -2])))\n"
    )
    done = subprocess.run(
        [sys.executable, script], cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 1
    assert 'if __name__ == "__main__"' in done.stderr


def test_a_daemonic_process_maps_alone_unless_workers_are_named(gachon, monkeypatch) -> None:
    """A worker of `multiprocessing.Pool` was told that its script lacks the guard."""
    monkeypatch.setattr(parallel, "parent_process", current_process)
    monkeypatch.setattr(parallel.os, "cpu_count", lambda: 4)
    monkeypatch.setitem(current_process()._config, "daemon", True)
    monkeypatch.setattr(computing, "POINTS_FOR_ONE_PROCESS", 0)
    rows = slice_through(2, 0.445, np.array([-0.1, -0.1, 0.3]), np.array([0.1, 0.1, 0.6]), 0.05)
    question = Question.about(gachon)
    (maps,) = computing.map_workspace(question, [rows])
    assert np.isfinite(maps.values["capacity_margin"]).all()
    with pytest.raises(BadInput, match="cannot start others") as caught:
        computing.map_workspace(question, [rows], workers=2)
    assert "workers=1" in caught.value.next_step


NESTED = """
from concurrent.futures import ProcessPoolExecutor
from planner.parallel import default_workers, worker_pool
def work(number):
    with worker_pool(2, None) as pool:
        return default_workers(), list(pool.map(abs, [number]))
if __name__ == "__main__":
    with ProcessPoolExecutor(1) as pool:
        print(*pool.map(work, [-3]))
"""


def test_a_child_process_shares_its_work_only_where_workers_are_named(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(NESTED)
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py"], capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stdout == "(1, [3])\n", done.stderr


@pytest.fixture(scope="module")
def reference_slice(gachon):
    """The slice of the paper's Fig. 7 that reference values are known for, 20 mm apart."""
    millimetres = Question.about(gachon, length=0.001)
    corners = np.array([-0.2, -0.2, 0.3]), np.array([0.2, 0.2, 0.6])
    grid = slice_through(2, 0.445, *corners, 0.02)
    return compute(millimetres, Extremes.over_workspace(millimetres), grid)


def test_the_reference_slice_has_the_reference_volumes(gachon, reference_slice):
    """Known for tensions from 0 to 100 N; the volume goes with the third power of the range."""
    scale = (100.0 / (gachon.max_tension - gachon.min_tension)) ** 3
    volumes = reference_slice.values["force_volume"] * scale
    assert volumes.min() == pytest.approx(2.6451e7, abs=5e2)
    assert volumes.max() == pytest.approx(2.9108e7, abs=5e2)


def test_the_reference_slice_has_the_reference_dexterity(reference_slice):
    inverse = 1.0 / reference_slice.values["condition_number"]
    assert inverse.min() == pytest.approx(0.00188, abs=5e-6)
    assert inverse.max() == pytest.approx(0.00732, abs=5e-6)


def test_toward_the_centre_dexterity_cost_falls_and_wrench_cost_rises(reference_slice):
    x, y, _ = reference_slice.grid.axes
    radius = np.hypot(*np.meshgrid(x, y, indexing="ij"))
    rings = [radius <= 0.05, (radius > 0.1) & (radius <= 0.15), radius > 0.2]
    dexterity, wrench = (
        [reference_slice.values[name][..., 0][ring].mean() for ring in rings]
        for name in ("dexterity_cost", "wrench_cost")
    )
    assert dexterity == sorted(dexterity)
    assert wrench == sorted(wrench, reverse=True)


def test_the_paper_s_workspace_box_is_closed_and_feasible(gachon, extremes):
    question = Question.about(gachon)
    grid = volume("box", gachon.workspace_lower, gachon.workspace_upper, 0.1)
    maps = compute(question, extremes, grid)
    assert maps.closed.all()
    assert maps.feasible.all()
    assert (maps.verdict == 0).all()


def test_the_costs_are_the_planner_s(gachon, extremes):
    question = Question.about(gachon)
    grid = volume("box", gachon.workspace_lower, gachon.workspace_upper, 0.15)
    maps = compute(question, extremes, grid)
    expected = KinematicCost(gachon, LEVEL).at(grid.points(0, grid.count))
    assert maps.values["cost"].ravel() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("rotation_vector", [(0.0, 0.0, 0.0), (0.1, -0.05, 0.2)])
def test_every_value_is_that_of_its_pose(hall, ready_scene, rotation_vector):
    """Pulleys, ten cables, payload, a disturbance and round obstacles, level and rotated."""
    scene = ready_scene("hall_pillar")
    rotation = matrix_from_rotation_vector(np.array(rotation_vector))
    random = np.random.default_rng(3)
    positions = random.uniform(hall.workspace_lower, hall.workspace_upper, (12, 3))
    values = values_at(Question.about(hall, scene, rotation), positions)
    assert values["capacity_margin"] == pytest.approx(
        capacity_margins(hall, scene, positions, rotation), abs=1e-9
    )
    model = ClearanceModel(hall, scene)
    for k, position in enumerate(positions):
        pose = Pose(position, rotation)
        closed = largest_smallest_tension(structure_matrix(hall, pose)) > 1e-6
        assert closed == (values["closure_margin"][k] > 0.0)
        near, own = model.smallest(pose).distance, model.self_clearance(pose).distance
        assert values["self_clearance"][k] == pytest.approx(own, abs=1e-9)
        assert max(values["obstacle_clearance"][k], 0.0) == pytest.approx(max(near, 0.0), abs=3e-7)


def test_poses_of_a_suspended_robot_are_allowed_without_wrench_closure(gachon) -> None:
    above = gachon.outlets * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.5]
    anchors = gachon.anchors * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.065]  # on the platform's top
    crane = replace(gachon, outlets=above, anchors=anchors, mass=4.0, min_tension=1.0)
    at = crane.home.position
    question = Question.about(crane)
    maps = compute(question, Extremes((1.0, 2.0), (1.0, 2.0)), volume("at", at, at + 1e-6, 1.0))
    assert not maps.closed.any()
    assert maps.feasible.all()
    assert (maps.verdict == 0).all()


def test_a_pose_without_a_cable_is_unknown_and_forbidden(hall):
    in_a_pulley = hall.outlets[2] + np.array([0.03, 0.0, 0.0]) - hall.anchors[2]
    question = Question.about(hall)
    positions = np.stack([hall.home.position, in_a_pulley, hall.home.position])
    values = values_at(question, positions)
    assert np.isnan([values[name][1] for name in values]).all()
    assert np.isfinite([values[name][[0, 2]] for name in values]).all()
    grid = volume("at", in_a_pulley, in_a_pulley + 1e-6, 1.0)
    maps = compute(question, Extremes((1.0, 2.0), (1.0, 2.0)), grid)
    assert (maps.verdict != 0).all()
    assert not maps.collision_free.any()


def test_the_scene_s_clearances_decide_what_is_free(gachon, extremes, ready_scene):
    scene = ready_scene("environment_1")
    question = Question.about(gachon, scene)
    corners = np.stack([scene.start.position, [-0.15, 0.0, 0.3], scene.goal.position])
    near = VERDICTS.index("obstacle clearance too small")
    for position, verdict in zip(corners, (0, near, 0), strict=True):
        grid = volume("at", position, position + 1e-6, 1.0)
        maps = compute(question, extremes, grid)
        assert maps.verdict[0, 0, 0] == verdict
        assert maps.collision_free[0, 0, 0] == (verdict == 0)
    tight = replace(question, scene=scene.changed(clearance=0.5))
    assert compute(tight, extremes, grid).verdict[0, 0, 0] == near


def test_a_pose_is_feasible_with_every_payload_of_the_scene(gachon, extremes, ready_scene):
    """The cables hold the empty platform at the tray, but not a part of 20 kg."""
    document = ready_scene("pick_and_place").as_dict()
    for stop in document["stops"]:
        if "mass_kg" in stop:
            stop["mass_kg"] = 20.0
    scene = Scene.from_dict(document)
    tray = scene.stops[0].pose
    margins = [gachon.at(tray, leg.scene.load).capacity_margin for leg in legs_of(scene)]
    grid = volume("at", tray.position, tray.position + 1e-6, 1.0)
    maps = compute(Question.about(gachon, scene), extremes, grid)
    assert min(margins) < 0.0 < margins[0]
    assert maps.values["capacity_margin"][0, 0, 0] == pytest.approx(min(margins), abs=1e-9)
    assert maps.verdict[0, 0, 0] == VERDICTS.index("not wrench feasible")


def test_other_workers_and_parts_change_no_value(gachon, extremes, monkeypatch):
    question = Question.about(gachon)
    grid = volume("box", gachon.workspace_lower, gachon.workspace_upper, 0.08)
    alone = compute(question, extremes, grid)
    monkeypatch.setattr(computing, "POINTS_IN_A_PART", 37)
    done = []
    with ThreadPoolExecutor(2) as pool:
        shared = compute(question, extremes, grid, pool=pool, progress=done.append)
    assert sum(done) == grid.count
    assert len(done) > 5
    for name, values in alone.values.items():
        assert shared.values[name] == pytest.approx(values, rel=1e-9, abs=1e-12)


def test_work_without_a_caller_is_cancelled(gachon, extremes, monkeypatch):
    """Ctrl-C ends after the running parts, not after all of them."""
    monkeypatch.setattr(computing, "POINTS_IN_A_PART", 8)
    question = Question.about(gachon)
    grid = volume("box", gachon.workspace_lower, gachon.workspace_upper, 0.02)
    evaluated = []
    monkeypatch.setattr(
        computing,
        "_part",
        lambda *a: evaluated.append(a[2]) or values_at(a[0], a[1].points(*a[2:])),
    )

    def interrupt(_):
        raise KeyboardInterrupt

    with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
        compute(question, extremes, grid, pool=pool, progress=interrupt)
    assert len(evaluated) < grid.count / 8 / 2


def test_a_pose_near_a_pulleys_axis_is_allowed_as_far_as_the_check_allows_it(hall) -> None:
    """Each pose against a check of that pose alone; everything else is allowed here."""
    document = hall.as_dict()
    document["outlets_mm"][4] = [0.0, 700.0, 2600.0]
    rig = Rig.from_dict(document)
    question = Question.about(rig, rotation=matrix_from_rotation_vector([0.0, 0.05, 0.1]))
    lower, upper = np.array([-0.4, 0.3, 1.1]), np.array([0.4, 0.6, 1.2])
    grid = slice_through(2, 1.1, lower, upper, 0.05)
    plenty = dict.fromkeys(("capacity_margin", "self_clearance"), np.ones(grid.shape))
    verdict = computing.Maps(question, grid, plenty).verdict
    scene = empty_scene(rig)
    for position, found in zip(grid.points(0, grid.count), verdict.ravel(), strict=True):
        report = check_path(rig, scene, [Pose(position, question.rotation)], ends=False)
        near = any(v.what.endswith(NEAR_AXIS) for v in report.violations)
        assert VERDICTS[found] == ("too close to a pulley's axis" if near else "allowed")
    assert set(verdict.ravel()) == {0, VERDICTS.index("too close to a pulley's axis")}
    point_exits = Question.about(Rig.from_dict({**document, "pulleys": None}))
    assert not computing.Maps(point_exits, grid, plenty).verdict.any()
