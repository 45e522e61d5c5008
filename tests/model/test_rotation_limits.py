"""How far a platform is tilted and rotated along a move, against dense samples of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.pose import Pose, RotationLimits, interpolate, largest_rotations

seeds = st.integers(0, 2**32 - 1)


def pose_of(rotation: Rotation) -> Pose:
    return Pose(np.zeros(3), rotation.as_matrix())


@given(seeds, st.floats(0.05, 3.0))
def test_the_largest_tilt_and_turn_are_those_of_dense_samples(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    first, last = (pose_of(Rotation.from_rotvec(rng.normal(size=3) * size * 0.5)) for _ in range(2))
    poses = [interpolate(first, last, s) for s in np.linspace(0.0, 1.0, 401)]
    tilts = [math.acos(min(pose.rotation[2, 2], 1.0)) for pose in poses]
    halves = [math.atan2(pose.quaternion[3], pose.quaternion[0]) for pose in poses]
    tilt, turn = largest_rotations(first.quaternion, last.quaternion)
    assert max(tilts) - 1e-7 <= tilt <= max(tilts) + 1e-3
    around = np.ptp(np.unwrap(2.0 * np.array(halves))) - abs(2.0 * (halves[-1] - halves[0]))
    if abs(around) < 1e-6:  # no half turn along it
        assert turn == pytest.approx(2.0 * np.abs(halves).max(), abs=1e-6)
    else:
        assert turn == math.pi


@given(st.floats(0.0, 1.5), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_a_tilt_after_a_turn_is_distinguished(tilt: float, turn: float, about: float) -> None:
    axis = np.array([math.cos(about), math.sin(about), 0.0])
    pose = pose_of(Rotation.from_rotvec(tilt * axis) * Rotation.from_rotvec([0.0, 0.0, turn]))
    found = largest_rotations(pose.quaternion, pose.quaternion)
    assert found == pytest.approx((tilt, abs(turn)), abs=1e-6)
    assert (pose.tilt, pose.turn) == pytest.approx((tilt, turn), abs=1e-6)


def test_a_move_between_allowed_ends_may_tilt_too_far_in_between() -> None:
    half, aside = math.radians(10.0), math.radians(30.0)
    ends = [
        [math.cos(half) * math.cos(a), math.sin(half), 0.0, math.cos(half) * math.sin(a)]
        for a in (-aside, aside)
    ]
    first, last = (Pose.from_quaternion(np.zeros(3), end) for end in ends)
    limits = RotationLimits(2.0 * half, math.radians(90.0))
    assert limits.excess(first, first) is None
    assert limits.excess(last, last) is None
    excess = limits.excess(first, last)
    assert excess is not None
    in_the_middle = 2.0 * math.atan(math.tan(half) / math.cos(aside))
    assert excess.measured == pytest.approx(in_the_middle, abs=1e-9)


def test_what_is_exceeded_is_reported_with_figures() -> None:
    limits = RotationLimits(math.radians(10.0), math.radians(30.0))
    level = pose_of(Rotation.identity())
    tipped = pose_of(Rotation.from_euler("y", 12, degrees=True))
    spun = pose_of(Rotation.from_euler("z", -45, degrees=True))
    for pose, sentence in (
        (tipped, "tilted by 12 deg, rotation_limits allow 10 deg"),
        (spun, "rotated by 45 deg, rotation_limits allow 30 deg"),
    ):
        excess = limits.excess(level, pose)
        assert excess is not None
        assert excess.sentence() == sentence


def test_a_turn_without_limit_may_go_around_the_back() -> None:
    first, last = (pose_of(Rotation.from_euler("z", a, degrees=True)) for a in (170, -170))
    assert RotationLimits(0.1, math.pi).excess(first, last) is None
    assert RotationLimits(0.1, math.radians(175.0)).excess(first, last) is not None


@given(st.floats(0.5, 89.0), st.floats(-math.pi, math.pi), st.floats(0.5, 170.0))
def test_a_pose_at_its_limits_keeps_them_with_six_decimals(
    tilt: float, about: float, turn: float
) -> None:
    """As its quaternion is written in a scene file."""
    axis = np.array([math.cos(about), math.sin(about), 0.0])
    rotation = Rotation.from_rotvec(math.radians(tilt) * axis)
    rotation *= Rotation.from_rotvec([0.0, 0.0, math.radians(turn)])
    x, y, z, w = rotation.as_quat().round(6)
    written = np.array([w, x, y, z])
    pose = Pose.from_quaternion(np.zeros(3), written / np.linalg.norm(written))
    limits = RotationLimits(math.radians(tilt), math.radians(turn))
    assert limits.excess(pose, pose) is None


def test_an_excess_of_a_thousandth_of_a_degree_shows_in_its_figures() -> None:
    level = pose_of(Rotation.identity())
    tipped = pose_of(Rotation.from_euler("y", 10.0004, degrees=True))
    excess = RotationLimits(math.radians(10.0), math.pi).excess(level, tipped)
    assert excess is not None
    assert excess.sentence() == "tilted by 10.0004 deg, rotation_limits allow 10 deg"
