"""Rounding: within the tolerance, within its share of the lines, and only where it is allowed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from executor.trajectory.path import HALVINGS, LONGEST_SHARE, Path, poses_of, rounded
from model.pose import Pose, interpolate
from tests.executor.routes import WEIGHT, always, at_mm, random_route

seeds = st.integers(0, 2**32 - 1)
RIGHT_ANGLE = [at_mm(0, 0, 0), at_mm(100, 0, 0), at_mm(100, 100, 0)]


def _apart(pose: Pose, other: Pose) -> float:
    return float(np.hypot(pose.distance_to(other), WEIGHT * pose.angle_to(other)))


def _distance_to_move(pose: Pose, start: Pose, end: Pose) -> float:
    """Smallest distance to a straight move by ternary search, as the path measures it, [m]."""
    low, high = 0.0, 1.0
    for _ in range(36):
        thirds = low + (high - low) / 3.0, high - (high - low) / 3.0
        near, far = (_apart(pose, interpolate(start, end, share)) for share in thirds)
        low, high = (low, thirds[1]) if near < far else (thirds[0], high)
    return _apart(pose, interpolate(start, end, low))


def _rounded_corners(path: Path) -> list[int]:
    return [i for i, segment in enumerate(path.segments) if not segment.straight]


@given(seed=seeds, rotated=st.booleans())
@settings(max_examples=25)
def test_a_corner_keeps_the_tolerance_on_both_sides_and_uses_it(seed, rotated):
    """Largest distances of the curve from the lines and of the corner point from the curve."""
    tolerance = 10.0 ** np.random.default_rng(seed).uniform(-4, -2)
    waypoints = random_route(seed, rotated, count=3, sharpest_deg=75.0 if rotated else 104.0)
    path = rounded(waypoints, tolerance, WEIGHT, always)
    (index,) = _rounded_corners(path)
    segment = path.segments[index]
    samples = poses_of(*segment.at(np.linspace(0.0, segment.length, 11)))
    moves = list(pairwise(waypoints))
    off = [min(_distance_to_move(pose, *move) for move in moves) for pose in samples]
    nearest = min(_apart(pose, waypoints[1]) for pose in samples)
    # Rotation vectors are not exactly additive: 1 % with rotated poses.
    allowed = tolerance * (1.01 if rotated else 1.0 + 1e-6)
    assert max(off) <= allowed
    assert nearest <= allowed
    limited_by_line = min(path.segments[0].length, path.segments[2].length) < 0.56 * min(
        _apart(*move) for move in moves
    )
    assert limited_by_line or nearest == pytest.approx(tolerance, rel=0.02)


@given(seed=seeds, rotated=st.booleans())
@settings(max_examples=40)
def test_corners_leave_a_tenth_of_every_line(seed, rotated):
    waypoints = random_route(seed, rotated)
    path = rounded(waypoints, 1.0, WEIGHT, always)
    lines = [segment.length for segment in path.segments if segment.straight]
    moves = [_apart(a, b) for a, b in pairwise(waypoints)]
    assert len(lines) == len(moves)
    for left, whole in zip(lines, moves, strict=True):
        assert left >= (1.0 - 2.0 * LONGEST_SHARE) * whole * (1.0 - 1e-6)


@given(seed=seeds, rotated=st.booleans())
@settings(max_examples=40)
def test_segments_meet_and_the_ends_are_the_waypoints(seed, rotated):
    waypoints = random_route(seed, rotated)
    path = rounded(waypoints, 0.002, WEIGHT, always)
    ends = [poses_of(*s.at(np.array([0.0, s.length]))) for s in path.segments]
    for (_, end), (begin, _) in pairwise(ends):
        assert _apart(end, begin) < 1e-9
    assert _apart(ends[0][0], waypoints[0]) < 1e-9
    assert _apart(ends[-1][1], waypoints[-1]) < 1e-9


def test_rotation_counts_for_the_tolerance():
    """A corner between two pure rotations moves the platform's corners as well."""
    about_x, about_y = Rotation.from_rotvec([0.8, 0, 0]), Rotation.from_rotvec([0, 0.8, 0])
    turns = [about_x.inv().as_matrix(), np.eye(3), about_y.as_matrix()]
    waypoints = [Pose(np.zeros(3), turn) for turn in turns]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    (index,) = _rounded_corners(path)
    segment = path.segments[index]
    middle = poses_of(*segment.at(np.array([segment.length / 2.0])))[0]
    assert WEIGHT * middle.angle_to(waypoints[1]) == pytest.approx(0.001, rel=1e-3)


def test_a_refused_corner_is_halved_until_it_is_allowed():
    reaches: list[float] = []

    def third_time(poses: list[Pose]) -> bool:
        reaches.append(poses[0].distance_to(RIGHT_ANGLE[1]))
        return len(reaches) == 3

    path = rounded(RIGHT_ANGLE, 0.001, WEIGHT, third_time)
    assert reaches == pytest.approx([reaches[0], reaches[0] / 2, reaches[0] / 4])
    assert _rounded_corners(path) == [1]
    begin = path.segments[1].at(np.array([0.0]))[0][0]
    assert np.linalg.norm(begin - RIGHT_ANGLE[1].position) == pytest.approx(reaches[-1])


def test_a_corner_that_is_never_allowed_stays_sharp():
    asked = []

    def never(poses: list[Pose]) -> bool:
        asked.append(len(poses))
        return False

    path = rounded(RIGHT_ANGLE, 0.001, WEIGHT, never)
    assert len(asked) == HALVINGS
    assert [s.straight for s in path.segments] == [True, True]
    through = path.at(path.starts)[0]
    assert through == pytest.approx(np.array([p.position for p in RIGHT_ANGLE]), abs=1e-15)


def test_only_the_refused_corner_stays_sharp():
    waypoints = [*RIGHT_ANGLE, at_mm(200, 100, 0)]

    def not_the_first(poses: list[Pose]) -> bool:
        return poses[0].distance_to(RIGHT_ANGLE[1]) > 0.05

    path = rounded(waypoints, 0.001, WEIGHT, not_the_first)
    assert [s.straight for s in path.segments] == [True, True, False, True]


def test_the_samples_to_check_are_dense_and_cover_the_corner():
    seen: list[Pose] = []

    def looked_at(poses: list[Pose]) -> bool:
        seen.extend(poses)
        return True

    path = rounded(RIGHT_ANGLE, 0.02, WEIGHT, looked_at)
    curve = path.segments[1]
    assert max(a.distance_to(b) for a, b in pairwise(seen)) < 0.0011
    ends = poses_of(*curve.at(np.array([0.0, curve.length])))
    assert seen[0].distance_to(ends[0]) < 1e-12
    assert seen[-1].distance_to(ends[1]) < 1e-12


def test_no_tolerance_keeps_every_corner_sharp():
    path = rounded(RIGHT_ANGLE, 0.0, WEIGHT, always)
    assert [s.straight for s in path.segments] == [True, True]


def test_repeats_and_waypoints_in_between_are_left_out():
    waypoints = [
        at_mm(0, 0, 0),
        at_mm(0, 0, 0),
        at_mm(30, 0, 0, turn_deg=3),
        at_mm(100, 0, 0, turn_deg=10),
        at_mm(100, 0, 0, turn_deg=10),
    ]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    assert len(path.segments) == 1
    assert path.length == pytest.approx(_apart(waypoints[0], waypoints[-1]))


def test_a_rotation_in_place_is_not_a_repeat():
    waypoints = [at_mm(0, 0, 0), at_mm(0, 0, 0, turn_deg=10), at_mm(0, 50, 0, turn_deg=10)]
    assert len(rounded(waypoints, 0.0, WEIGHT, always).segments) == 2


def test_a_path_without_motion_has_one_segment():
    path = rounded([at_mm(1, 2, 3)] * 3, 0.001, WEIGHT, always)
    assert path.length == 0.0


@pytest.mark.parametrize(("turn_deg", "straight"), [(104.0, False), (106.0, True), (-106.0, True)])
def test_a_turn_so_sharp_that_a_stop_is_faster_stays_sharp(turn_deg, straight):
    x, y = (100.0 * f(np.radians(turn_deg)) for f in (np.cos, np.sin))
    waypoints = [at_mm(0, 0, 0), at_mm(100, 0, 0), at_mm(100 + x, y, 0)]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    assert all(segment.straight for segment in path.segments) is straight


@pytest.mark.parametrize("sideways_mm", [0.0, 1e-7, 1e-3, 1.0])
def test_a_reversal_is_stopped_at_never_rounded(sideways_mm):
    """Its curve would reverse within zero length, at any speed."""
    waypoints = [at_mm(0, 0, 0), at_mm(100, 0, 0), at_mm(0, sideways_mm, 0)]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    assert [s.straight for s in path.segments] == [True, True]
    assert path.length == pytest.approx(0.2, rel=1e-3)


def test_turning_on_in_steps_is_not_reversed_by_leaving_out_waypoints():
    """Three thirds of a turn about z: the shortest rotation between the ends is the other one."""
    waypoints = [at_mm(0, 0, 0, turn_deg=a) for a in (0, 120, 240)]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    _, rotations = path.at(np.linspace(0.0, path.length, 241))
    rotated = np.unwrap(Rotation.from_matrix(rotations).as_euler("zyx")[:, 0])
    assert np.degrees(rotated) == pytest.approx(np.linspace(0, 240, 241), abs=0.01)


def test_a_half_turn_is_rounded_on_the_side_on_which_it_is_run():
    waypoints = [at_mm(0, 0, 0), at_mm(50, 0, 0, turn_deg=180), at_mm(50, 50, 0, turn_deg=180)]
    path = rounded(waypoints, 0.001, WEIGHT, always)
    _, rotations = path.at(np.linspace(0.0, path.segments[0].length, 50))
    first = poses_of(*path.at(path.starts[1:2]))[0]
    assert _distance_to_move(first, waypoints[0], waypoints[1]) < 1e-6
    assert np.degrees(Rotation.from_matrix(rotations).magnitude()).max() > 150
