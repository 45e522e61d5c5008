"""The price of a length limit, the gap between two trees, and figures in refusals."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import BadInput, distinct_figures
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene, empty_scene
from planner.anytime_6d.path import smallest_gap
from planner.costs import ClearanceSteps, KinematicCost, LengthPrice, LimitedSearch
from planner.endpoints import require_feasible_length, require_usable_ends
from planner.settings import OBJECTIVES, OptimalSettings, Weights


def price_after(prices: LengthPrice, short_enough: bool) -> float:
    """The price after paths of one kind, enough of them to change it."""
    for _ in range(6):
        prices.after_round(short_enough)
    return prices.price


@given(st.floats(-5.0, 5.0), st.lists(st.booleans(), max_size=8), st.floats(0.1, 2.0))
def test_the_price_of_length_settles_at_the_least_whatever_the_first_paths_say(
    power: float, first: list[bool], unit: float
) -> None:
    """The first paths may be too long, or short enough by chance, at any price."""
    prices, least = LengthPrice(unit), unit * 2.0**power
    for short_enough in first:
        price_after(prices, short_enough)
    found = [price_after(prices, prices.price >= least) for _ in range(80)]
    assert min(found[-8:]) < least <= max(found[-8:])
    assert max(found[-8:]) <= 1.5 * min(found[-8:])


@given(st.lists(st.booleans(), max_size=8))
def test_where_the_objective_alone_keeps_the_limit_the_price_vanishes(first: list[bool]) -> None:
    prices = LengthPrice(1.0)
    for short_enough in first:
        price_after(prices, short_enough)
    assert min(price_after(prices, True) for _ in range(40)) < 1e-3


@given(st.floats(0.0, 1.0), st.floats(0.001, 0.1), st.floats(0.01, 1.0))
def test_the_clearance_demanded_approaches_the_largest_that_the_limit_allows(
    share: float, least: float, span: float
) -> None:
    steps, most = ClearanceSteps(least, least + span), least + share * span
    found = least
    for _ in range(60):
        improved = steps.demanded <= most
        found = max(found, steps.demanded if improved else 0.0)
        if not steps.after_search(improved):
            break
    assert most - 1e-3 * span - 4e-5 <= found <= most


class Fake:
    """A search whose shortest path is as long as the clearance demanded asks for.

    By any other objective its path is longer, unless the length has a high price.
    """

    checks = 1

    def __init__(self, scene: Scene, shortest: float) -> None:
        self.rounds = 0
        self.clearance = scene.obstacle_clearance
        self.path: Array | None = np.array([[0.0, 0.0, 0.3], [0.3, 0.0, 0.3]])
        self.length = self._shortest = shortest
        self.objectives: list[Weights] = []

    def advance(self) -> None:
        """Every round finds the same path."""
        self.rounds += 1

    def weigh(self, weights: Weights) -> None:
        self.objectives.append(weights)
        self.length = self._shortest + (0.0 if weights.kinematic <= weights.length else 0.5)

    def cost_by(self, weights: Weights) -> float:
        return weights.length * self.length - weights.clearance * self.clearance


def test_a_limit_of_the_straight_distance_is_kept_by_the_straight_line(gachon: Rig) -> None:
    """0.2 − (−0.1) is 0.30000000000000004."""
    line = np.array([[-0.1, 0.0, 0.3], [0.2, 0.0, 0.3]])
    length = float(np.linalg.norm(line[1] - line[0]))
    assert length > 0.3
    scene = empty_scene(gachon).changed(start=Pose.level(line[0]), goal=Pose.level(line[1]))
    require_feasible_length(scene, 0.3)
    kinematic = KinematicCost(gachon, np.eye(3))
    fake = Fake(scene, length)
    search = LimitedSearch(lambda *_: fake, scene, OBJECTIVES["length"], 0.3, kinematic)
    search.advance()
    assert search.path is fake.path


def test_the_shortest_path_is_sought_until_the_limit_is_kept(gachon: Rig) -> None:
    scene, kinematic = empty_scene(gachon), KinematicCost(gachon, np.eye(3))
    fake = Fake(scene, 0.4)
    search = LimitedSearch(lambda *_: fake, scene, OBJECTIVES["kinematic"], 0.35, kinematic)
    for _ in range(100):
        search.advance()
    assert search.path is None
    assert fake.objectives == [OBJECTIVES["length"]]
    fake.length = 0.35
    search.advance()
    assert search.path is fake.path
    assert fake.objectives[-1] == OBJECTIVES["kinematic"]


def test_the_largest_clearance_is_demanded_without_a_limit_and_its_path_improved(
    gachon: Rig, ready_scene
) -> None:
    """Improved in every other round, while higher clearances are tried in vain."""
    scene, kinematic, most = ready_scene("environment_3"), KinematicCost(gachon, np.eye(3)), 0.0305
    begun: list[Fake] = []

    def begin(at: Scene, _: Weights) -> Fake:
        begun.append(Fake(at, 0.3 if at.obstacle_clearance <= most else math.inf))
        if at.obstacle_clearance > most:
            begun[-1].path = None
        return begun[-1]

    search = LimitedSearch(begin, scene, OBJECTIVES["clearance"], math.inf, kinematic)
    costs = []
    for _ in range(1000):
        search.advance()
        costs.append(search.cost)
    best = max((fake for fake in begun if fake.path is not None), key=lambda f: f.clearance)
    assert search.path is best.path
    assert best.clearance == pytest.approx(most, abs=4e-5)
    assert best.rounds > 250
    assert costs == sorted(costs, reverse=True)
    assert search.checks == len(begun)


def test_the_gap_between_two_full_trees_is_exact_and_takes_little_memory() -> None:
    first, second = np.random.default_rng(3).uniform(-1.0, 1.0, (2, 4096, 3))
    first[:, 0] -= 2.5
    first[1234], second[77] = [-0.9, 0.0, 0.0], [-0.5, 0.3, 0.0]
    second[:77, 0] += 1.0
    second[78:, 0] += 1.0
    tracemalloc.start()
    gap = smallest_gap(first, second)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert gap == pytest.approx(0.5)
    assert peak < 2e6


def test_rotation_in_place_counts_in_the_mean_kinematic_cost(gachon: Rig) -> None:
    """A quarter of the path in place: its own mean counts a quarter."""
    cost, tilt = KinematicCost(gachon, np.eye(3)), 0.15
    radian = float(np.sqrt((gachon.anchors**2).sum(axis=1).mean()))
    poses = [
        Pose.level([0.0, 0.0, 0.3]),
        Pose.level([3.0 * radian * tilt, 0.0, 0.3]),
        Pose.from_quaternion(
            np.array([3.0 * radian * tilt, 0.0, 0.3]),
            np.array([np.cos(tilt / 2.0), np.sin(tilt / 2.0), 0.0, 0.0]),
        ),
    ]
    shifted, rotated = cost.mean_along_poses(poses[:2]), cost.mean_along_poses(poses[1:])
    ends = [cost.mean_along_poses([pose]) for pose in poses[1:]]
    assert min(ends) < rotated < max(ends)
    assert cost.mean_along_poses(poses) == pytest.approx((3.0 * shifted + rotated) / 4.0)


@given(st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=3), st.integers(0, 4))
def test_figures_that_differ_do_not_look_alike(values: list[float], digits: int) -> None:
    for kind in ("f", "g"):
        texts = distinct_figures(values, digits, kind)
        assert [float(text) for text in texts] == pytest.approx(values, abs=1.0, rel=1.0)
        for one, text in zip(values, texts, strict=True):
            for other, same in zip(values, texts, strict=True):
                if abs(one - other) > 1e-10:
                    assert text != same


def test_an_end_just_outside_the_workspace_is_refused_with_figures_that_show_it(
    gachon: Rig,
) -> None:
    low = float(gachon.workspace_lower[2])
    scene = empty_scene(gachon).changed(start=Pose.level([0.0, 0.0, low - 1e-5]))
    with pytest.raises(BadInput) as refusal:
        require_usable_ends(gachon, scene)
    at = f"z = {low * 1e3 - 0.01:.2f} mm"
    assert f"0.01 mm outside the workspace: {at}" in refusal.value.what


def test_a_longest_path_just_too_short_is_refused_with_figures_that_show_it(gachon: Rig) -> None:
    start, goal = (Pose.level([x, 0.0, 0.3]) for x in (-0.1, 0.2))
    scene = empty_scene(gachon).changed(start=start, goal=goal)
    with pytest.raises(BadInput, match=r"at most 299\.99 mm .* straight line is 300\.00 mm"):
        require_feasible_length(scene, 0.29999)
    error = OptimalSettings(longest=0.3).too_long("here", 0.30002, 0.29, {})
    assert "300.00 mm" in error.what
    assert "300.02 mm long" in error.why
