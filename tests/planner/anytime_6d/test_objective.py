"""Objectives of turning paths: their values against the model, and what they change."""

from __future__ import annotations

import itertools
from dataclasses import astuple
from functools import cache

import numpy as np
import pytest

from model.clearance import ClearanceModel
from model.errors import BadInput, NoSolution
from model.files.plan_file import PlanDocument
from model.plan import plan_from_document
from model.pose import Array, Pose, interpolate
from model.rig import Rig
from model.scene import load_scene
from planner.anytime_6d.local_search import (
    copied,
    line_cost,
    line_length,
    measure,
    new_line,
    replace,
)
from planner.anytime_6d.problem import move_length, move_lows, move_sum, pose_clearance, pose_cost
from planner.check import verify
from planner.costs import KinematicCost
from planner.planning import make_plan
from planner.settings import OBJECTIVES, TurningSettings, Weights
from tests.configs import CONFIGS, GACHON, HALL
from tests.planner.anytime_6d.rotating_scenes import Judge, problem_of, random_pose, turning

RAMP = load_scene(CONFIGS / "turn.yaml")
WIDE = turning("environment_1", 7.0, 2.0)
EVERYTHING = Weights(length=0.4, kinematic=0.7, clearance=2.0, capacity=1e-3)
SCENES = [(GACHON, "environment_2"), (HALL, "hall_pillar")]


def row(pose: Pose) -> Array:
    return np.concatenate([pose.position, pose.quaternion])


@pytest.mark.parametrize(("rig", "name"), SCENES)
def test_the_cost_of_a_pose_is_that_of_the_model(rig: Rig, name: str) -> None:
    scene = turning(name, 9.0, 4.0)
    problem, kinematic = problem_of(rig, scene), KinematicCost(rig, scene.start.rotation)
    rng, compared = np.random.default_rng(5), 0
    for _ in range(60):
        pose = random_pose(rng, rig, scene)
        wanted = kinematic.mean_along_poses([pose])
        found = pose_cost(
            problem.world, problem.load, problem.objective, pose.rotation, tuple(pose.position)
        )
        assert found >= wanted - 1e-9  # parts below 0 count as 0
        compared += found == pytest.approx(wanted, rel=1e-7)
    assert compared > 30


@pytest.mark.parametrize(("rig", "name"), SCENES)
def test_the_clearance_of_a_pose_is_that_of_the_model(rig: Rig, name: str) -> None:
    scene = turning(name, 9.0, 4.0)
    problem, model = problem_of(rig, scene), ClearanceModel(rig, scene)
    rng, apart = np.random.default_rng(6), 0
    for _ in range(60):
        pose = random_pose(rng, rig, scene)
        nearest = model.smallest(pose)
        assert nearest is not None
        found = pose_clearance(problem.world, tuple(pose.position), pose.rotation, np.inf)
        if nearest.distance > 0.0:
            apart += 1
            assert found == pytest.approx(nearest.distance, abs=1e-7)
            near = pose_clearance(problem.world, tuple(pose.position), pose.rotation, 0.01)
            assert near == pytest.approx(min(0.01, nearest.distance), abs=1e-7)
        else:
            assert found <= 1e-9
    assert apart > 20


@pytest.mark.parametrize(("rig", "name"), SCENES)
def test_moves_are_worth_what_dense_poses_say(rig: Rig, name: str) -> None:
    scene = turning(name, 6.0, 2.0)
    problem, judge = problem_of(rig, scene, EVERYTHING), Judge(rig, scene)
    world, load, objective = problem.world, problem.load, problem.objective
    kinematic = KinematicCost(rig, scene.start.rotation)
    rng = np.random.default_rng(7)
    for _ in range(4):
        start, end = random_pose(rng, rig, scene), random_pose(rng, rig, scene)
        length = float(move_length(row(start), row(end), objective.radian))
        only_length = problem_of(rig, scene).objective
        assert move_sum(world, load, only_length, row(start), row(end)) == pytest.approx(length)
        dense = _dense(start, end, 101)
        mean = float(np.mean([max(0.0, kinematic.mean_along_poses([p])) for p in dense]))
        total = move_sum(world, load, objective, row(start), row(end))
        assert total == pytest.approx((0.4 + 0.7 * mean) * length, rel=0.02)
        clearance, margin = move_lows(world, load, objective, row(start), row(end))
        least = min(judge.margin(pose) for pose in dense)
        assert least - 1e-6 <= margin + 1e-6
        assert margin == pytest.approx(least, abs=0.02 * rig.max_tension)
        assert clearance < np.inf


def _dense(start: Pose, end: Pose, count: int) -> list[Pose]:
    return [interpolate(start, end, float(s)) for s in np.linspace(0.0, 1.0, count)]


def test_a_change_is_worth_the_same_as_measuring_all_again() -> None:
    problem = problem_of(GACHON, RAMP, EVERYTHING)
    rng, tallies = np.random.default_rng(8), np.zeros(6, dtype=np.int64)
    line = new_line()
    for k, share in enumerate(np.linspace(0.0, 1.0, 6)):
        line.poses[k] = row(Pose.level([-0.2 + 0.02 * share, -0.15, 0.45 + 0.1 * share]))
    line.counts[0] = 6
    cost = measure(problem, line)
    made = 0
    for _ in range(150):
        before, length = copied(line), line_length(problem, line)
        first = int(rng.integers(0, line.counts[0] - 2))
        new = line.poses[first + 1 : first + 3].copy()
        new[:, :3] += rng.normal(scale=0.003, size=(2, 3))
        number = int(rng.integers(0, 3))
        if replace(problem, line, first, first + 2, new, number, False, tallies):
            made += 1
            fresh = measure(problem, copied(line))
            assert line_cost(problem, line) == pytest.approx(fresh, abs=1e-12)
            if number:
                assert fresh < cost
            assert (
                line.poses[line.counts[0] - 1].tolist()
                == before.poses[before.counts[0] - 1].tolist()
            )
            cost = fresh
        else:
            assert line_length(problem, line) == length
        if line.counts[0] < 4:
            break
    assert made >= 2


def planned(name: str, rounds: int = 25, **options: float) -> PlanDocument:
    settings = TurningSettings(weights=OBJECTIVES[name], rounds=rounds, **options)
    return make_plan(GACHON, WIDE, settings)


@pytest.fixture(scope="module")
def by_objective() -> dict[str, PlanDocument]:
    return {name: planned(name) for name in OBJECTIVES}


def rotated_length(document: PlanDocument) -> float:
    """Length, rotation counted, [m]."""
    poses = plan_from_document(document).waypoints
    radian = problem_of(GACHON, WIDE).objective.radian
    return sum(float(move_length(row(a), row(b), radian)) for a, b in itertools.pairwise(poses))


@pytest.mark.slow
def test_each_objective_is_best_by_its_own_measure(by_objective: dict[str, PlanDocument]) -> None:
    reports = {k: verify(plan_from_document(d)).report for k, d in by_objective.items()}
    for name, document in by_objective.items():
        assert reports[name].passed
        assert document.planner.name == "turning"
        assert rotated_length(by_objective["length"]) <= rotated_length(document) * 1.01
    costs = {k: d.quality.mean_kinematic_cost * rotated_length(d) for k, d in by_objective.items()}
    assert costs["kinematic"] < 0.9 * costs["length"]
    rooms = {k: d.quality.obstacle_clearance.distance_mm for k, d in by_objective.items()}
    assert rooms["clearance"] > rooms["length"] + 10.0
    margins = {k: r.capacity_margin for k, r in reports.items()}
    assert margins["capacity"] >= max(margins.values()) - 1e-6
    assert margins["capacity"] > margins["kinematic"] + 3.0


@pytest.mark.slow
def test_the_best_path_that_is_no_longer_keeps_the_limit(
    by_objective: dict[str, PlanDocument],
) -> None:
    shortest = rotated_length(by_objective["length"])
    limited = planned("kinematic", 60, longest=1.02 * shortest)
    assert shortest < rotated_length(limited) <= 1.02 * shortest + 1e-9
    assert limited.planner.longest_mm == pytest.approx(1.02e3 * shortest)
    with pytest.raises(NoSolution, match="no path of at most"):
        planned("kinematic", 20, longest=0.95 * shortest)


@pytest.mark.parametrize(
    ("weights", "longest", "factor"),
    [
        (OBJECTIVES["length"], np.inf, 0.5),
        (OBJECTIVES["length"], np.inf, 1e-12),
        (OBJECTIVES["kinematic"], 0.66, 1e3),
    ],
)
def test_only_the_ratios_of_the_weights_matter(
    weights: Weights, longest: float, factor: float
) -> None:
    """With a small weight of the length alone, the first path already counted as the shortest."""
    scaled = Weights(*(factor * weight for weight in astuple(weights)))
    assert weighted(scaled, longest).waypoints == weighted(weights, longest).waypoints


@cache
def weighted(weights: Weights, longest: float) -> PlanDocument:
    """The plan for these weights."""
    settings = TurningSettings(weights=weights, rounds=40, longest=longest)
    return make_plan(GACHON, WIDE, settings)


def test_a_longest_path_must_be_a_length() -> None:
    with pytest.raises(BadInput, match="longest path"):
        TurningSettings(longest=0.0)
