"""Algorithm 1 and 3 on the paper's rig: trees, steps, costs, readings, and where they stop."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from model.errors import BadInput
from planner.costs import KinematicCost
from planner.rrt.rrt import edge_cost, kinematic_field, length_field
from planner.rrt.search import PaperPlanner
from planner.rrt.variants import AlgorithmVariant
from planner.settings import CLEARANCE_RESERVE, PlannerSettings

PAPER = PlannerSettings(mode="paper", cost="length")
STEP = PAPER.step


@pytest.fixture(scope="module")
def cost(gachon) -> KinematicCost:
    return KinematicCost(gachon, np.eye(3))


@pytest.fixture(scope="module")
def searched(gachon, ready_scene):
    """A search in an environment, and its planner."""
    scenes = {n: ready_scene(f"environment_{n}") for n in (1, 2, 3)}
    exact = {}

    def run(number: int, settings: PlannerSettings, seed: int = 0):
        scene = scenes[number]
        planner = PaperPlanner(gachon, scene, settings, CLEARANCE_RESERVE, exact=exact.get(number))
        exact[number] = planner._exact
        start, goal = np.array(scene.start.position), np.array(scene.goal.position)
        return planner, planner.search(start, goal, np.random.default_rng(seed))

    return run


def edges_of(result) -> list[tuple[np.ndarray, np.ndarray]]:
    return [
        (result.points[parent], result.points[node])
        for node, parent in enumerate(result.parents.tolist())
        if parent >= 0
    ]


@pytest.mark.parametrize("sampler", ["adaptive", "goal-bias"])
@pytest.mark.parametrize("mode", ["paper", "rewire"])
def test_all_edges_of_a_tree_are_allowed_and_its_path_joins_the_ends(
    searched, ready_scene, sampler, mode
) -> None:
    planner, result = searched(2, replace(PAPER, sampler=sampler, mode=mode))
    scene = ready_scene("environment_2")
    assert all(planner.edge(a, b) for a, b in edges_of(result))
    assert np.array_equal(result.path[0], scene.start.position)
    assert np.array_equal(result.path[-1], scene.goal.position)
    assert result.best_distance == 0.0


def test_full_steps_put_every_node_one_step_from_the_one_it_grew_from(searched) -> None:
    """Eq. 9 as written; the goal itself is joined from within its radius."""
    _, result = searched(1, PAPER)
    nodes = result.points[:-1]
    for k in range(1, len(nodes)):
        distances = np.linalg.norm(nodes[:k] - nodes[k], axis=1)
        assert np.min(np.abs(distances - STEP)) < 1e-12
    assert np.linalg.norm(result.path[-1] - result.path[-2]) <= PAPER.goal_radius


def test_steps_to_the_sample_are_no_longer_than_a_step(searched) -> None:
    _, result = searched(3, replace(PAPER, readings=AlgorithmVariant(steer="to-sample")))
    nodes = result.points[:-1]
    nearest = [np.linalg.norm(nodes[:k] - nodes[k], axis=1).min() for k in range(1, len(nodes))]
    assert max(nearest) <= STEP + 1e-12
    assert min(nearest) < STEP - 1e-3


@pytest.mark.parametrize("sampler", ["adaptive", "goal-bias"])
def test_with_a_spacing_no_two_nodes_are_nearer(searched, sampler) -> None:
    readings = AlgorithmVariant(steer="to-sample", spacing=0.030)
    _, result = searched(3, replace(PAPER, sampler=sampler, readings=readings))
    nodes = result.points[:-1]  # the exact goal may be nearer to its parent
    apart = np.linalg.norm(nodes[:, None] - nodes, axis=-1)[np.triu_indices(len(nodes), 1)]
    assert apart.min() >= 0.030
    _, free = searched(
        3, replace(PAPER, sampler=sampler, readings=AlgorithmVariant(steer="to-sample"))
    )
    close = np.linalg.norm(free.points[:, None] - free.points, axis=-1)
    assert close[np.triu_indices(len(close), 1)].min() < 0.030


def test_goal_sight_joins_the_goal_from_the_first_node_that_sees_it(searched) -> None:
    planner, result = searched(2, replace(PAPER, readings=AlgorithmVariant(goal_sight=True)))
    goal = result.path[-1]
    seeing = [planner.edge(node, goal) for node in result.points[:-1]]
    assert seeing == [False] * (len(seeing) - 1) + [True]


def test_the_tree_of_the_paper_mode_does_not_depend_on_the_cost_but_its_parents_do(
    searched,
) -> None:
    """So Fig. 9a is the same for both costs."""
    _, by_length = searched(2, PAPER, seed=3)
    _, by_cost = searched(2, replace(PAPER, cost="kinematic"), seed=3)
    assert np.array_equal(by_length.points, by_cost.points)
    assert not np.array_equal(by_length.parents, by_cost.parents)


def test_each_node_hangs_on_the_best_neighbour_of_its_time(searched) -> None:
    planner, result = searched(1, PAPER, seed=1)
    costs = np.zeros(len(result.points))
    for node in range(1, len(result.points) - 1):
        distances = np.linalg.norm(result.points[:node] - result.points[node], axis=1)
        costs[node] = costs[result.parents[node]] + distances[result.parents[node]]
        near = np.flatnonzero(distances <= PAPER.neighbour_radius)
        better = near[costs[near] + distances[near] < costs[node] - 1e-12]
        assert not any(planner.edge(result.points[k], result.points[node]) for k in better)


def test_rewiring_makes_the_path_cheaper_and_the_paper_mode_stops_at_the_first(searched) -> None:
    _, first = searched(1, PAPER)
    _, improved = searched(1, replace(PAPER, mode="rewire"))
    length = [np.linalg.norm(np.diff(r.path, axis=0), axis=1).sum() for r in (first, improved)]
    assert length[1] < 0.95 * length[0]
    assert improved.iterations > 500


def test_the_same_random_numbers_give_the_same_tree(searched) -> None:
    runs = [searched(3, PAPER, seed=s)[1] for s in (5, 5, 6)]
    assert np.array_equal(runs[0].points, runs[1].points)
    assert runs[0].edge_checks == runs[1].edge_checks
    assert not np.array_equal(runs[0].points, runs[2].points)


def test_a_search_in_portions_for_its_progress_is_the_same_search(searched, ready_scene) -> None:
    planner, whole = searched(3, PAPER, seed=2)
    scene, reports = ready_scene("environment_3"), []
    start, goal = np.array(scene.start.position), np.array(scene.goal.position)
    reported = planner.search(
        start, goal, np.random.default_rng(2), lambda *state: reports.append(state)
    )
    assert np.array_equal(whole.points, reported.points)
    assert reports


@pytest.mark.parametrize("sampler", ["adaptive", "goal-bias"])
def test_refusals_are_counted_and_named(searched, sampler) -> None:
    _, result = searched(3, replace(PAPER, sampler=sampler, max_iterations=80))
    assert result.path is None
    assert result.iterations == 80
    assert result.refused["obstacle clearance"] > 0
    assert all(obstacle.startswith("obstacle_") for _, obstacle in result.blocking_pairs)
    assert sum(result.blocking_pairs.values()) == result.refused["obstacle clearance"]


def test_algorithm_3_leaves_no_node_that_can_be_skipped_from_a_kept_one(searched) -> None:
    planner, result = searched(3, PAPER)
    kept = planner.shortcut(result.path)
    rows = [int(np.flatnonzero((result.path == node).all(axis=1))[0]) for node in kept]
    assert rows[0] == 0
    assert rows[-1] == len(result.path) - 1
    for here, following in pairwise(rows):
        assert planner.edge(result.path[here], result.path[following])
        for skipped in range(following + 1, len(result.path)):
            assert not planner.edge(result.path[here], result.path[skipped])


def test_algorithm_3_takes_no_costlier_shortcut_under_the_kinematic_cost(searched, cost) -> None:
    planner, result = searched(1, replace(PAPER, cost="kinematic"), seed=4)
    kept = planner.shortcut(result.path)
    field = planner.field

    def total(path: np.ndarray) -> float:
        return sum(edge_cost(field, a, b) for a, b in pairwise(path))

    assert total(kept) <= total(result.path) + 1e-9
    assert len(kept) < len(result.path)


def test_compiled_costs_are_those_of_the_plain_definition(cost) -> None:
    rng = np.random.default_rng(0)
    lower, upper = np.array([-0.25, -0.25, 0.15]), np.array([0.25, 0.25, 0.65])
    field = kinematic_field(cost)
    for start, end in rng.uniform(lower, upper, (200, 2, 3)):
        assert edge_cost(field, start, end) == pytest.approx(cost.edge(start, end), rel=1e-12)
        length = np.linalg.norm(end - start)
        assert edge_cost(length_field(), start, end) == pytest.approx(length, rel=1e-12)
    assert edge_cost(field, lower, lower) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"failure_rate": "k"},
        {"focus": "first"},
        {"cone_draw": "area"},
        {"steer": "far"},
        {"spacing": -0.01},
        {"spacing": float("nan")},
    ],
)
def test_unknown_readings_are_refused(wrong) -> None:
    with pytest.raises(BadInput):
        AlgorithmVariant(**wrong)
