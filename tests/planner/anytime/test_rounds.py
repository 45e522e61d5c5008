"""Searches in rounds: repeatable bit for bit, never worse for more, and allowed by other routes."""

from __future__ import annotations

import itertools
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from model.pose import Pose
from model.scene import scene_from_document
from planner.anytime.path import advance, handle_of
from planner.anytime.problem import ASK_PROOF, LEAST_MARGIN, NO_MARGIN
from planner.anytime.state import BEST, KEPT, new_search
from planner.check import check_path
from planner.costs import capacity_margins, margin_reserve
from planner.edge_checks import FREE, ExactChecks
from planner.settings import CLEARANCE_RESERVE, MARGIN_RESERVE, OBJECTIVES
from tests.planner.anytime.scenes_of_the_search import (
    best_points,
    ends_of,
    problem,
    random_question,
    searched,
)
from tests.planner.collision.sampled_oracle import CoalScene

ROOT = Path(__file__).parents[3]
LAST_VERTEX_PRICE = 1e-4
"""What a vertex of the best path is worth at least, part of the straight distance."""


@pytest.fixture(scope="module")
def asked(gachon, ready_scene):
    made = {}

    def make(number: int, name: str = "length"):
        if (number, name) not in made:
            scene = ready_scene(f"environment_{number}")
            made[number, name] = (problem(gachon, scene, OBJECTIVES[name]), scene)
        return made[number, name]

    return make


@pytest.mark.parametrize("name", ["length", "kinematic", "clearance", "capacity"])
def test_the_same_seed_and_rounds_give_the_same_path_bit_for_bit(asked, name) -> None:
    once, again, other = (searched(*asked(2, name), 14, seed) for seed in (3, 3, 4))
    assert best_points(once).tobytes() == best_points(again).tobytes()
    assert once.points.tobytes() == again.points.tobytes()
    assert best_points(once).tobytes() != best_points(other).tobytes()


def test_rounds_one_by_one_are_the_same_as_all_at_once(asked) -> None:
    question, scene = asked(3)
    step_by_step = new_search(*ends_of(scene), 9)
    for _ in range(20):
        advance(handle_of(question, step_by_step), 1)
    assert best_points(step_by_step).tobytes() == best_points(searched(*asked(3), 20, 9)).tobytes()


def test_another_process_finds_the_same_path(asked) -> None:
    code = (
        "from pathlib import Path;"
        "from model.rig import load_rig;"
        "from model.scene import load_scene;"
        "from tests.planner.anytime.scenes_of_the_search import best_points, problem, searched;"
        "rig = load_rig(Path('configs/gachon_8_6.yaml'));"
        "scene = load_scene(Path('configs/environment_3.yaml'));"
        "print(best_points(searched(problem(rig, scene), scene, 20, 5)).tobytes().hex())"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert bytes.fromhex(said) == best_points(searched(*asked(3), 20, 5)).tobytes()


@pytest.mark.parametrize("name", ["length", "kinematic", "clearance"])
@pytest.mark.parametrize("seed", [0, 1])
def test_more_rounds_never_give_a_worse_path(asked, name, seed) -> None:
    """Worse by cost and a hundredth of a percent of the straight distance for every vertex."""
    question, scene = asked(3, name)
    search, last = new_search(*ends_of(scene), seed), np.inf
    unit = OBJECTIVES[name].length + OBJECTIVES[name].kinematic * float(question.kinematic.mean())
    straight = float(np.linalg.norm(np.subtract(*ends_of(scene))))
    for _ in range(40):
        cost = advance(handle_of(question, search), 1)
        worth = cost + LAST_VERTEX_PRICE * straight * unit * search.counts[BEST, 0]
        assert worth <= last + 1e-12
        last = worth


@pytest.mark.parametrize("number", [1, 2, 3])
def test_all_stored_paths_are_allowed_by_the_other_checks(asked, gachon, number) -> None:
    question, scene = asked(number)
    search = searched(question, scene, 25, seed=number)
    checks = ExactChecks(
        gachon,
        scene,
        np.eye(3),
        obstacle_clearance=scene.obstacle_clearance + CLEARANCE_RESERVE,
        self_clearance=scene.self_clearance + CLEARANCE_RESERVE,
        margin_reserve=MARGIN_RESERVE * gachon.max_tension,
    )
    for k in range(KEPT + 1):
        path = search.points[k, : search.counts[k, 0]]
        assert np.array_equal(path[[0, -1]], ends_of(scene))
        assert all(checks.problem(*edge) == FREE for edge in itertools.pairwise(path))


@pytest.fixture(scope="module")
def random_paths(gachon):
    """Paths through random scenes after 14 rounds, and these scenes, by seed; each made once."""

    @cache
    def path(seed):
        scene = random_question(gachon, seed)
        if scene is None:
            return None, np.empty((0, 3))
        return scene, best_points(searched(problem(gachon, scene), scene, 14, seed))

    return path


@pytest.mark.parametrize("seed", range(12))
def test_paths_in_random_scenes_pass_check_and_coal(gachon, random_paths, seed) -> None:
    scene, path = random_paths(seed)
    if scene is None:
        pytest.skip("these obstacles leave no two free positions")
    if not len(path):
        return
    report = check_path(gachon, scene, [Pose.level(point) for point in path])
    assert report.passed, report.violations
    oracle = CoalScene(scene)
    for start, end in itertools.pairwise(path):
        for share in np.linspace(0.0, 1.0, 12):
            at = oracle.pose_distance(gachon, Pose.level(start + share * (end - start)))
            assert at >= scene.obstacle_clearance


def test_most_random_scenes_have_a_path(random_paths) -> None:
    """So that the test above checks something."""
    scenes, paths = zip(*(random_paths(seed) for seed in range(12)), strict=True)
    assert sum(scene is not None for scene in scenes) >= 8
    assert sum(len(path) > 0 for path in paths) >= 6


def test_where_wrenches_are_hardly_held_the_best_path_is_proved_or_proofs_are_required(
    hall, ready_scene
) -> None:
    """On this robot the cells of the workspace prove a tenth of it."""
    scene = ready_scene("hall_pillar")
    question = problem(hall, scene)
    assert not question.holding.everywhere
    search = searched(question, scene, 12)
    path = best_points(search)
    assert check_path(hall, scene, [Pose(p, scene.start.rotation) for p in path]).passed
    assert search.totals[5] == 0 or question.terms[LEAST_MARGIN] == ASK_PROOF


def test_a_grid_of_margins_that_forbids_everything_is_soon_ignored(asked) -> None:
    question, scene = asked(1)
    wrong = question._replace(
        holding=question.holding._replace(everywhere=False), terms=question.terms.copy()
    )
    wrong.terms[LEAST_MARGIN] = 1e9
    search = searched(wrong, scene, 12)
    assert wrong.terms[LEAST_MARGIN] == NO_MARGIN
    assert 0 < search.totals[5] < 12
    assert len(best_points(search)) > 2


def test_an_end_with_little_margin_is_left_without_proofs(hall, ready_scene) -> None:
    """Margins of the grid must be large on edges, but not larger than an end's own."""
    scene = ready_scene("hall_pillar")
    reserve, low, high = margin_reserve(hall, scene.load, turns=False), 0.0, 600.0
    for _ in range(20):  # the force up to which three times the reserve is left at the start
        force = (low + high) / 2.0
        load = scene.document.load.model_copy(update={"force_n": [force] * 3})
        loaded = scene_from_document(scene.document.model_copy(update={"load": load}))
        margin = capacity_margins(hall, loaded, scene.start.position[None, :], np.eye(3))[0]
        low, high = (force, high) if margin > 3.0 * reserve else (low, force)
    assert margin == pytest.approx(3.0 * reserve, rel=1e-3)
    question = problem(hall, loaded)
    search = searched(question, loaded, 12)
    assert question.terms[LEAST_MARGIN] < 3.0 * reserve
    path = best_points(search)
    assert len(path) > 1
    assert check_path(hall, loaded, [Pose(p, scene.start.rotation) for p in path]).passed
