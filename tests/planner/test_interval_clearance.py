"""Clearances proved over whole intervals, against distances at dense poses."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.clearance import ClearanceModel, RobotBodies, ShiftedBodies
from model.errors import Fault
from model.pose import Pose, interpolate
from planner.bounds import smallest_along, smallest_over_intervals
from planner.path import PosePath

TOLERANCE = 0.1e-3
OVERLAP = 1e-6
SHAPES = (
    {"box": {"size_mm": [90.0, 60.0, 200.0]}},
    {"sphere": {"radius_mm": 50.0}},
    {"capsule": {"radius_mm": 25.0, "length_mm": 120.0}},
    {"cylinder": {"radius_mm": 40.0, "length_mm": 100.0}},
)


def random_case(gachon, scene_with, seed):
    random = np.random.default_rng(seed)
    obstacles = []
    for k in range(int(random.integers(1, 4))):
        position = random.uniform([-300, -300, 100], [300, 300, 800])
        shape = SHAPES[int(random.integers(len(SHAPES)))]
        obstacles.append({"name": f"thing_{k}", "position_mm": position.tolist(), **shape})
    corners = random.uniform([-200, -200, 200], [200, 200, 600], (int(random.integers(2, 5)), 3))
    rotation = np.array(gachon.home.rotation)
    poses = [Pose(corner / 1e3, rotation) for corner in corners]
    return ClearanceModel(gachon, scene_with(*obstacles)), PosePath(gachon, poses), poses


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_smallest_clearance_is_that_of_the_bound_by_motion(gachon, scene_with, seed) -> None:
    """Overlaps are left out: how deep they are is a bound, not a distance."""
    model, path, _ = random_case(gachon, scene_with, seed)
    samples = path.samples(0.01)

    def evaluate(at):
        return np.array([model.smallest(path.pose(p)).distance for p in at.tolist()])

    required = 0.010
    found = smallest_over_intervals(model, path, required, TOLERANCE)
    other = smallest_along(samples, evaluate, lambda motion: motion, required, TOLERANCE)
    if other.proved <= 0.0:
        assert found.proved <= max(other.value, 0.0) + 1e-9
        assert other.value > -OVERLAP or found.proved < 0.0
        return
    assert found.proved <= other.value + 1e-9
    assert other.proved <= found.value + 1e-9
    assert found.value - found.proved <= TOLERANCE + 1e-9


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_pose_of_a_path_is_nearer_than_is_proved(gachon, scene_with, seed) -> None:
    """Nor free, where it overlaps."""
    model, path, poses = random_case(gachon, scene_with, seed)
    found = smallest_over_intervals(model, path, 0.0, TOLERANCE)
    moves = pairwise(poses)
    sampled = [interpolate(a, b, t) for a, b in moves for t in np.linspace(0.0, 1.0, 40)]
    smallest = min(model.smallest(pose).distance for pose in sampled)
    assert found.proved <= max(smallest, 0.0) + 1e-9
    assert smallest > -OVERLAP or found.proved < 0.0
    if found.value > 0.0:
        assert found.value == pytest.approx(model.smallest(path.pose(found.at)).distance, abs=1e-9)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_shifted_bodies_reach_as_far_as_the_robot_at_any_of_the_positions(gachon, seed) -> None:
    random = np.random.default_rng(seed)
    positions = random.uniform(-0.2, 0.6, (4, 3))
    directions = random.normal(size=(3, gachon.cable_count + 1, 3))
    rotation = np.array(gachon.home.rotation)
    reach = ShiftedBodies(gachon, rotation, positions).reach(directions)
    each = [
        RobotBodies(gachon, Pose(position, rotation)).reach(directions) for position in positions
    ]
    assert reach == pytest.approx(np.max(each, axis=0), abs=1e-12)
    shares = random.dirichlet(np.ones(4))
    between = Pose(shares @ positions, rotation)
    assert (RobotBodies(gachon, between).reach(directions) <= reach + 1e-12).all()


def test_a_nan_distance_proves_nothing(gachon, scene_with, monkeypatch) -> None:
    model, path, _ = random_case(gachon, scene_with, 1)
    monkeypatch.setattr(ClearanceModel, "smallest", lambda _model, _pose: None)
    with pytest.raises(Fault, match="unknown"):
        smallest_over_intervals(model, path, 0.0, TOLERANCE)
