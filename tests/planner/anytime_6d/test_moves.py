"""Moves of the compiled search are those of the model, and what it allows is free everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.pose import Pose, RotationLimits, interpolate, largest_rotations
from model.rig import Rig
from planner.anytime_6d.problem import (
    ROTATION,
    matrix_of,
    move_allowed,
    move_length,
    put_between,
    rotation_between,
    rotations_kept,
)
from tests.configs import GACHON, HALL
from tests.planner.anytime_6d.rotating_scenes import Judge, problem_of, random_pose, row, turning

seeds = st.integers(0, 2**32 - 1)


def two_poses(seed: int, size: float) -> tuple[Pose, Pose]:
    rng = np.random.default_rng(seed)
    first, last = (
        Pose(rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3) * size).as_matrix())
        for _ in range(2)
    )
    return first, last


@given(seeds, st.floats(0.0, 1.0), st.floats(0.0, 0.9))
def test_a_share_of_a_move_is_that_of_the_check_and_the_executor(
    seed: int, share: float, size: float
) -> None:
    start, end = two_poses(seed, size)
    found = np.empty(7)
    put_between(row(start), row(end), share, found)
    expected = interpolate(start, end, share)
    assert np.allclose(found[:3], expected.position, rtol=0, atol=1e-12)
    assert np.allclose(matrix_of(found), expected.rotation, rtol=0, atol=1e-12)
    assert np.linalg.norm(rotation_between(row(start), row(end))) == pytest.approx(
        start.angle_to(end), abs=1e-9
    )


@given(seeds)
def test_the_length_of_a_move_counts_its_turning(seed: int) -> None:
    start, end = two_poses(seed, 0.5)
    expected = np.hypot(start.distance_to(end), 0.11 * start.angle_to(end))
    assert move_length(row(start), row(end), 0.11) == pytest.approx(expected, abs=1e-9)


@given(
    seeds,
    st.sampled_from([0.4, 1.5]),
    st.floats(0.02, 3.1) | st.just(np.pi),
    st.floats(0.02, 3.1) | st.just(np.pi),
)
def test_compiled_limits_are_those_of_the_scene(
    seed: int, size: float, tilt: float, turn: float
) -> None:
    start, end = two_poses(seed, size)
    found = largest_rotations(start.quaternion, end.quaternion)
    if min(abs(found[0] - tilt), abs(found[1] - turn)) < 1e-5:
        return
    kept = RotationLimits(tilt, turn).excess(start, end) is None
    assert rotations_kept(tilt, turn, row(start), row(end)) == kept


@pytest.mark.parametrize(
    ("rig", "name", "tilt_deg", "turn_deg"),
    [(GACHON, "environment_2", 7.0, 2.0), (HALL, "hall_pillar", 8.0, 5.0)],
)
def test_no_move_is_allowed_that_an_independent_judge_refuses(
    rig: Rig, name: str, tilt_deg: float, turn_deg: float
) -> None:
    scene = turning(name, tilt_deg, turn_deg)
    problem, judge = problem_of(rig, scene), Judge(rig, scene)
    rng = np.random.default_rng(31)
    tallies = np.zeros(6, dtype=np.int64)
    allowed, wrongly_refused, refused = 0, 0, 0
    for _ in range(60):
        start, end = random_pose(rng, rig, scene), random_pose(rng, rig, scene)
        end = interpolate(start, end, float(rng.choice([0.05, 0.2, 1.0])))
        if move_allowed(problem, row(start), row(end), tallies):
            allowed += 1
            assert judge.fault(start, end, 25) == ""
        elif tallies[ROTATION] == 0:
            refused += 1
            poses = [interpolate(start, end, float(s)) for s in np.linspace(0.0, 1.0, 25)]
            wrongly_refused += all(
                judge.margin(pose) > 0.02 * rig.max_tension and judge.room(pose) > 2e-3
                for pose in poses
            )
        tallies[:] = 0
    assert allowed >= 10
    assert wrongly_refused <= refused // 20
