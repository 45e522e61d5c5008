"""Poses from cable lengths: warm and cold starts, pulleys, and lengths that fit no pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from model.errors import BadInput, Fault
from model.kinematics import (
    cable_lengths,
    forward_kinematics,
    poses_near,
    settled_poses_near,
)
from model.pose import Array, Pose, matrix_from_rotation_vector, moved
from model.rig import Rig
from tests.model.rig_builds import hall_rig, ipanema, paper_rig, paper_rig_with_pulleys, poses_of

RIGS = {
    "point exits": paper_rig(),
    "13 mm pulleys": paper_rig_with_pulleys(13.0),
    "ten cables": hall_rig(),
}
any_rig = pytest.mark.parametrize("name", RIGS)


def agree(found: Pose, true: Pose) -> None:
    assert found.distance_to(true) < 1e-8
    assert found.angle_to(true) < 1e-7


@any_rig
@settings(max_examples=25)
@given(data=st.data())
def test_the_pose_comes_back_without_a_guess(name: str, data: st.DataObject) -> None:
    """Rotated by up to 25°, from starts that are all level."""
    rig = RIGS[name]
    pose = data.draw(poses_of(rig))
    found = forward_kinematics(rig, cable_lengths(rig, pose))
    agree(found.pose, pose)
    assert found.worst < 1e-9


@any_rig
@settings(max_examples=25)
@given(data=st.data())
def test_a_guess_nearby_needs_few_steps(name: str, data: st.DataObject) -> None:
    rig = RIGS[name]
    pose = data.draw(poses_of(rig))
    turn = matrix_from_rotation_vector([0.01, -0.02, 0.015])
    guess = Pose(pose.position + np.array([0.004, -0.003, 0.005]), turn @ pose.rotation)
    found = forward_kinematics(rig, cable_lengths(rig, pose), guess)
    agree(found.pose, pose)
    assert found.iterations <= 8


@any_rig
def test_many_poses_near_known_ones_are_found_together(name: str) -> None:
    rig = RIGS[name]
    rng = np.random.default_rng(11)
    poses = [
        Pose(
            rig.home.position + rng.uniform(-0.1, 0.1, 3),
            matrix_from_rotation_vector(rng.uniform(-0.1, 0.1, 3)),
        )
        for _ in range(9)
    ]
    lengths = np.array([cable_lengths(rig, pose) for pose in poses])
    guesses = np.array([pose.position for pose in poses]) + rng.uniform(-0.003, 0.003, (9, 3))
    rotations = np.array([pose.rotation for pose in poses])
    positions, turns, off = poses_near(rig, lengths, guesses, rotations)
    assert off.max() < 1e-9
    for pose, position, rotation in zip(poses, positions, turns, strict=True):
        agree(Pose(position, rotation), pose)


def nearest_step(rig: Rig, start: Pose, lengths: Array) -> tuple[Array, float]:
    """The step from a pose to the least squares of lengths by SciPy, and these squares."""
    exact = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)
    best = least_squares(
        lambda x: cable_lengths(rig, moved(start, x)) - lengths, np.zeros(6), **exact
    )
    return best.x, 2.0 * best.cost


@any_rig
def test_lengths_that_contradict_each_other_settle_in_the_least_squares(name: str) -> None:
    """Errors of 5 mm, as between a rig and its file; undamped steps differ by millimetres."""
    rig, random = RIGS[name], np.random.default_rng(0)
    span = rig.workspace_upper - rig.workspace_lower
    guesses = rig.workspace_lower + random.uniform(0.2, 0.8, (40, 3)) * span
    level = np.tile(rig.home.rotation, (40, 1, 1))
    lengths = np.array(
        [cable_lengths(rig, Pose(p, r)) for p, r in zip(guesses, level, strict=True)]
    )
    lengths += random.normal(0.0, 5e-3, lengths.shape)
    positions, rotations = settled_poses_near(rig, lengths, guesses, level)
    for k in range(len(lengths)):
        here, wanted = Pose(positions[k], rotations[k]), lengths[k]
        start = cable_lengths(rig, Pose(guesses[k], level[k])) - wanted
        step, squares = nearest_step(rig, here, wanted)
        assert np.abs(step).max() < 1e-6
        assert squares <= start @ start


@any_rig
@pytest.mark.parametrize("cable", [0, 5])
def test_one_wrong_length_shows_in_the_residual(name: str, cable: int) -> None:
    """With redundant cables, one cable that is 10 mm off cannot hide."""
    rig = RIGS[name]
    lengths = cable_lengths(rig, rig.home)
    lengths[cable] += 0.01
    found = forward_kinematics(rig, lengths)
    assert found.worst > 5e-4
    expected = cable_lengths(rig, found.pose) - lengths
    np.testing.assert_allclose(found.residual, expected, atol=1e-12)


def test_the_solution_is_the_least_squares_pose() -> None:
    """With lengths that fit no pose, no small motion makes the sum of squares smaller."""
    rig = RIGS["point exits"]
    lengths = cable_lengths(rig, rig.home) + np.array([3, -2, 1, 4, -3, 2, -1, -4]) * 1e-3
    found = forward_kinematics(rig, lengths)
    least = found.residual @ found.residual
    for axis in range(6):
        for sign in (-1e-4, 1e-4):
            step = np.zeros(6)
            step[axis] = sign
            turn = matrix_from_rotation_vector(step[3:])
            moved = Pose(found.pose.position + step[:3], turn @ found.pose.rotation)
            residual = cable_lengths(rig, moved) - lengths
            assert residual @ residual > least


@pytest.mark.parametrize(
    "lengths", [[0.7] * 7, [0.7] * 9, [0.7] * 7 + [np.nan], [0.7] * 7 + [np.inf], []]
)
def test_lengths_that_are_not_one_finite_number_per_cable_are_refused(lengths: list[float]) -> None:
    with pytest.raises(BadInput, match="each of 8 cables"):
        forward_kinematics(RIGS["point exits"], np.array(lengths))


def test_a_guess_where_cables_have_no_path_is_a_fault_with_a_next_step() -> None:
    rig: Rig = RIGS["point exits"]
    guess = Pose.level(rig.outlets[0] - rig.anchors[0])  # anchor 1 in outlet 1
    with pytest.raises(Fault, match="no pose fits") as caught:
        forward_kinematics(rig, cable_lengths(rig, rig.home), guess)
    assert "counts" in caught.value.next_step


def test_a_rig_that_cannot_hold_its_platform_still_ends() -> None:
    """IPAnema 1's anchors lie in one plane with its centre: singular in the middle for moments."""
    rig = ipanema()
    pose = Pose.level([0.0, 0.0, 1.0])
    found = forward_kinematics(rig, cable_lengths(rig, pose), Pose.level([0.01, 0.02, 1.01]))
    assert found.worst < 1e-6
