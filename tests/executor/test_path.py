"""The path: lines and rounded corners that join smoothly and are measured by their length."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from executor.trajectory.path import MIDDLE_SHARE, Path, corner, line, poses_of
from model.pose import Pose, interpolate
from tests.executor.routes import WEIGHT, at_mm, polyline, random_pose, steps_between

seeds = st.integers(0, 2**32 - 1)
SIDES = st.sampled_from([0.0, 0.4])


def _corner(seed: int, turn: float, leg: float = 0.004) -> tuple[Pose, Pose, Pose, Path]:
    """Two lines and a corner of legs [m] between them, of 20° to 160° in a random plane."""
    rng = np.random.default_rng(seed)
    at = random_pose(rng, 0.2, 1.0)
    first, across = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    angle = np.radians(rng.uniform(20.0, 160.0))
    onward = np.cos(angle) * first + np.sin(angle) * across
    turns = [Rotation.from_rotvec(rng.normal(size=3) * turn * leg).as_matrix() for _ in range(2)]
    before = Pose(at.position - leg * first, at.rotation @ turns[0])
    after = Pose(at.position + leg * onward, at.rotation @ turns[1])
    far = [interpolate(at, before, 2.0), interpolate(at, after, 2.0)]
    path = Path(
        (
            line(far[0], before, WEIGHT),
            corner(before, at, after, WEIGHT),
            line(after, far[1], WEIGHT),
        )
    )
    return before, at, after, path


def _coordinates(path: Path, at: Pose, travelled: np.ndarray) -> np.ndarray:
    """Position and ρ times the rotation vector from the corner's pose, shape (n, 6), [m]."""
    positions, rotations = path.at(travelled)
    vectors = Rotation.from_matrix(at.rotation.T @ rotations).as_rotvec()
    return np.hstack([positions, WEIGHT * vectors])


@given(seed=seeds)
def test_a_line_is_the_straight_move_with_a_constant_axis(seed):
    rng = np.random.default_rng(seed)
    start, end = random_pose(rng, 0.3, 1.5), random_pose(rng, 0.3, 1.5)
    segment = line(start, end, WEIGHT)
    shares = np.array([0.0, 0.2, 0.7, 1.0])
    positions, rotations = segment.at(shares * segment.length)
    ends = Rotation.from_matrix([start.rotation, end.rotation])
    assert positions == pytest.approx(
        start.position + shares[:, None] * (end.position - start.position), abs=1e-12
    )
    assert rotations == pytest.approx(Slerp([0, 1], ends)(shares).as_matrix(), abs=1e-9)
    rotated = (ends[0].inv() * ends[1]).magnitude()
    moved = np.linalg.norm(end.position - start.position)
    assert segment.length == pytest.approx(np.hypot(moved, WEIGHT * rotated), rel=1e-9)


def test_a_line_without_length_stays_where_it_is():
    pose = at_mm(10, 20, 30, turn_deg=5)
    segment = line(pose, pose, WEIGHT)
    assert segment.length == 0.0
    positions, rotations = Path((segment,)).at(np.zeros(3))
    assert positions == pytest.approx(np.tile(pose.position, (3, 1)), abs=0)
    assert rotations == pytest.approx(np.tile(pose.rotation, (3, 1, 1)), abs=0)


@given(seed=seeds, turn=SIDES)
@settings(max_examples=50)
def test_a_corner_joins_its_lines_with_one_tangent_and_without_curvature(seed, turn):
    _, at, _, path = _corner(seed, turn)
    h = 1e-6
    for joint in path.starts[1:3]:
        left, here, right = _coordinates(path, at, joint + np.array([-h, 0.0, h]))
        assert (here - left) / h == pytest.approx((right - here) / h, abs=1e-3)
        # Zero on the line's side, so a jump of the curvature would show here in full.
        assert np.linalg.norm(right - 2.0 * here + left) / h**2 < 0.02 * path.segments[1].bends[0]


@given(seed=seeds, turn=SIDES)
@settings(max_examples=50)
def test_the_middle_of_a_corner_lies_on_the_bisector_at_the_stated_distance(seed, turn):
    before, at, after, path = _corner(seed, turn)
    middle = path.starts[1] + path.segments[1].length / 2.0
    position = path.at(np.array([middle]))[0][0]
    legs = before.position + after.position - 2.0 * at.position
    # With rotation the two legs need not be of the same length, and the middle shifts a little.
    slack = 1e-9 if turn == 0.0 else 1e-4
    assert position - at.position == pytest.approx(MIDDLE_SHARE * legs, abs=slack)


@given(seed=seeds, turn=SIDES)
@settings(max_examples=30)
def test_length_is_what_dense_poses_add_up_to(seed, turn):
    path = _corner(seed, turn)[-1]
    dense = np.linspace(0.0, path.length, 4001)
    steps = steps_between(*path.at(dense))
    assert steps.sum() == pytest.approx(path.length, rel=1e-5)


@given(seed=seeds, turn=SIDES)
@settings(max_examples=30)
def test_equal_lengths_make_equal_steps_also_through_corners(seed, turn):
    """So that the time law's speed is the platform's speed, without ripple."""
    path = _corner(seed, turn)[-1]
    dense = np.linspace(0.0, path.length, 4001)
    steps = steps_between(*path.at(dense))
    wanted = path.length / 4000
    assert steps == pytest.approx(np.full(4000, wanted), rel=2e-3 if turn else 2e-4)


@given(seed=seeds, turn=SIDES)
@settings(max_examples=20)
def test_bends_are_the_derivatives_of_the_curve_by_its_length(seed, turn):
    _, at, _, path = _corner(seed, turn)
    segment = path.segments[1]
    inside = np.linspace(path.starts[1], path.starts[2], 801)
    h = inside[1] - inside[0]
    points = _coordinates(path, at, inside)
    second = np.linalg.norm(np.diff(points, 2, axis=0), axis=1).max() / h**2
    third = np.linalg.norm(np.diff(points, 3, axis=0), axis=1).max() / h**3
    assert segment.bends == (pytest.approx(second, rel=0.01), pytest.approx(third, rel=0.05))


def test_lines_do_not_bend():
    assert line(at_mm(0, 0, 0), at_mm(1, 2, 3, turn_deg=10), WEIGHT).bends == (0.0, 0.0)


def test_lengths_outside_the_path_are_its_ends():
    path = polyline([at_mm(0, 0, 0), at_mm(10, 0, 0), at_mm(10, 5, 0)], WEIGHT)
    positions, _ = path.at(np.array([-1.0, 99.0]))
    assert positions == pytest.approx(np.array([[0, 0, 0], [0.010, 0.005, 0]]), abs=1e-15)
    assert path.length == pytest.approx(0.015)


def test_a_polyline_goes_through_its_waypoints():
    rng = np.random.default_rng(5)
    waypoints = [random_pose(rng, 0.2, 0.8) for _ in range(6)]
    path = polyline(waypoints, WEIGHT)
    for pose, waypoint in zip(poses_of(*path.at(path.starts)), waypoints, strict=True):
        assert pose.distance_to(waypoint) < 1e-12
        assert pose.angle_to(waypoint) < 1e-9


def test_a_turn_straight_back_is_not_a_corner():
    """Its curve would stop and reverse at full travelled speed."""
    with pytest.raises(ValueError, match="path reverses"):
        corner(at_mm(0, 0, 0), at_mm(10, 0, 0), at_mm(0, 0, 0), WEIGHT)
