"""Group laws of rotations and poses, near zero and near half a turn too."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from model.errors import BadInput
from model.files.documents import PoseDocument
from model.pose import (
    Pose,
    interpolate,
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    points_by_twist,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
    skew,
)

Vector = NDArray[np.float64]

angles = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(-16.0, -1.0).map(lambda e: 10.0**e),
    st.floats(-16.0, -1.0).map(lambda e: np.pi - 10.0**e),
    st.sampled_from([0.0, 1e-6, 9.99e-7, np.pi / 2, np.pi]),
)


@st.composite
def unit_vectors(draw: st.DrawFn) -> Vector:
    vector = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3)))
    norm = float(np.linalg.norm(vector))
    return vector / norm if norm > 1e-3 else np.array([0.0, 0.6, -0.8])


turns = st.builds(lambda axis, angle: axis * angle, unit_vectors(), angles)
points = st.tuples(*[st.floats(-10.0, 10.0)] * 3).map(np.array)
poses = st.builds(lambda p, v: Pose(p, matrix_from_rotation_vector(v)), points, turns)


def same(a: Pose, b: Pose, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), rtol=0, atol=atol)


@given(turns)
def test_a_rotation_vector_makes_the_rotation_that_scipy_makes(turn: Vector) -> None:
    matrix = matrix_from_rotation_vector(turn)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(turn).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


@given(turns, st.sampled_from([-1.0, 1.01, 0.0, np.nan]), st.integers(0, 2))
def test_no_pose_has_a_matrix_that_is_no_rotation(turn: Vector, factor: float, row: int) -> None:
    """Mirrored, stretched, flat or unknown along one axis."""
    matrix = matrix_from_rotation_vector(turn)
    matrix[row] *= factor
    with pytest.raises(BadInput, match="not a rotation"):
        Pose(np.zeros(3), matrix)


@given(turns)
def test_a_rotation_written_with_four_digits_is_made_exact(turn: Vector) -> None:
    """So that what is checked is what a file keeps, which normalises quaternions."""
    matrix = matrix_from_rotation_vector(turn)
    written = np.round(quaternion_from_matrix(matrix), 4)
    for pose in (
        Pose.from_quaternion([0.0, 0.0, 0.0], written),
        Pose(np.zeros(3), np.round(matrix, 4)),
    ):
        np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(pose.rotation, matrix, atol=3e-4)
        same(PoseDocument.of(pose).pose(), pose)
        assert not pose.rotation.flags.writeable


@given(turns, st.floats(-1e-10, 1e-10))
def test_a_rotation_with_round_off_is_kept_as_it_is(turn: Vector, off: float) -> None:
    matrix = matrix_from_rotation_vector(turn) * (1.0 + off)
    np.testing.assert_array_equal(Pose(np.zeros(3), matrix).rotation, matrix)


@given(turns, st.floats(0.0006, 3.0) | st.floats(-0.4, -0.0006))
def test_a_quaternion_or_matrix_of_another_length_is_refused(turn: Vector, more: float) -> None:
    matrix = matrix_from_rotation_vector(turn)
    with pytest.raises(BadInput, match="not a rotation"):
        Pose(np.zeros(3), (1.0 + more) * matrix)
    with pytest.raises(BadInput, match="not a unit quaternion"):
        Pose.from_quaternion(np.zeros(3), (1.0 + 2.0 * more) * quaternion_from_matrix(matrix))


NOT_NUMBERS: list[Any] = [
    "abc",
    ["a", "b", "c"],
    [1.0, [2.0], 3.0],
    {"x": 1.0},
    None,
    3.0,
    iter(()),
]


@pytest.mark.parametrize("values", NOT_NUMBERS)
def test_a_pose_of_other_things_than_numbers_is_bad_input(values: Any) -> None:
    for make in (
        lambda: Pose.level(values),
        lambda: Pose(values, np.eye(3)),
        lambda: Pose(np.zeros(3), values),
        lambda: Pose.from_quaternion(np.zeros(3), values),
        lambda: Pose.from_quaternion(values, [1.0, 0.0, 0.0, 0.0]),
    ):
        with pytest.raises(BadInput):
            make()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e9, -1e300])
def test_a_position_that_is_not_finite_is_refused(value: float) -> None:
    for axis in range(3):
        position = np.zeros(3)
        position[axis] = value
        with pytest.raises(BadInput, match="not finite"):
            Pose.level(position)


@pytest.mark.parametrize(("position", "rotation"), [([0.0] * 2, np.eye(3)), ([0.0] * 3, np.eye(4))])
def test_a_pose_of_other_shapes_is_refused(position: list[float], rotation: Vector) -> None:
    with pytest.raises(BadInput, match="shapes"):
        Pose(np.array(position), rotation)


@given(turns)
def test_quaternion_and_matrix_are_inverse(turn: Vector) -> None:
    matrix = matrix_from_rotation_vector(turn)
    quaternion = quaternion_from_matrix(matrix)
    assert quaternion[0] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(matrix_from_quaternion(quaternion), matrix, atol=1e-14)
    np.testing.assert_allclose(matrix_from_quaternion(-quaternion), matrix, atol=1e-14)
    expected = Rotation.from_matrix(matrix).as_quat(scalar_first=True)
    assert abs(expected @ quaternion) == pytest.approx(1.0, abs=1e-13)


@given(unit_vectors(), angles)
def test_the_rotation_vector_comes_back(axis: Vector, angle: float) -> None:
    """To round-off, tiny angles to all their digits; at half a turn either sign is right."""
    vector = rotation_vector_from_matrix(matrix_from_rotation_vector(angle * axis))
    assert np.linalg.norm(vector) <= np.pi + 1e-14
    if angle > np.pi - 1e-6 and vector @ axis < 0.0:
        vector = -vector
        np.testing.assert_allclose(vector, angle * axis, atol=3e-6)
    else:
        np.testing.assert_allclose(vector, angle * axis, rtol=0, atol=2e-15 + 1e-15 * angle)


@given(unit_vectors(), st.floats(0.0, 4.0 * np.pi))
def test_a_vector_beyond_half_a_turn_gives_the_same_rotation(axis: Vector, angle: float) -> None:
    long = matrix_from_rotation_vector(axis * angle)
    short = matrix_from_rotation_vector(rotation_vector_from_matrix(long))
    np.testing.assert_allclose(short, long, atol=1e-13)


@given(points, points)
def test_skew_is_the_cross_product(a: Vector, b: Vector) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


@given(points, points, points)
def test_points_of_a_body_move_as_its_twist_says(arm: Vector, v: Vector, w: Vector) -> None:
    moved = points_by_twist([arm, v]) @ np.concatenate([v, w])
    np.testing.assert_allclose(moved, np.add(v, np.cross([w, w], [arm, v])), atol=1e-12)


@given(poses, poses, poses, points)
def test_poses_are_a_group_that_acts_on_points(a: Pose, b: Pose, c: Pose, point: Vector) -> None:
    same(a.compose(b).compose(c), a.compose(b.compose(c)), atol=1e-12)
    same(a.compose(a.inverse()), Pose.level([0, 0, 0]), atol=1e-13)
    same(a.inverse().compose(a), Pose.level([0, 0, 0]), atol=1e-13)
    np.testing.assert_allclose(a.compose(b).apply(point), a.apply(b.apply(point)), atol=1e-12)
    np.testing.assert_allclose(a.compose(b).matrix(), a.matrix() @ b.matrix(), atol=1e-12)


@given(poses)
def test_points_map_alike_alone_and_in_arrays(pose: Pose) -> None:
    points = np.arange(24.0).reshape(2, 4, 3)
    mapped = pose.apply(points)
    assert mapped.shape == (2, 4, 3)
    np.testing.assert_allclose(mapped[1, 2], pose.apply(points[1, 2]), atol=1e-12)


@given(poses, poses, st.floats(0.0, 1.0))
def test_interpolation_goes_straight_and_turns_evenly(a: Pose, b: Pose, fraction: float) -> None:
    middle = interpolate(a, b, fraction)
    assert middle.distance_to(a) == pytest.approx(fraction * a.distance_to(b), abs=1e-12)
    whole = a.angle_to(b)
    assert middle.angle_to(a) == pytest.approx(fraction * whole, abs=1e-7)
    assert middle.angle_to(b) == pytest.approx((1.0 - fraction) * whole, abs=1e-7)
    np.testing.assert_allclose(middle.rotation @ middle.rotation.T, np.eye(3), atol=1e-13)


@given(poses, poses)
def test_interpolation_begins_and_ends_at_its_ends(a: Pose, b: Pose) -> None:
    same(interpolate(a, b, 0.0), a)
    same(interpolate(a, b, 1.0), b)


@given(poses, poses)
def test_angle_and_distance_are_symmetric(a: Pose, b: Pose) -> None:
    assert a.angle_to(b) == pytest.approx(b.angle_to(a), abs=1e-12)
    assert a.distance_to(b) == b.distance_to(a)
    assert 0.0 <= a.angle_to(b) <= np.pi + 1e-14


def test_a_pose_keeps_its_own_read_only_arrays() -> None:
    position, rotation = np.zeros(3), np.eye(3)
    pose = Pose(position, rotation)
    position[0], rotation[0, 0] = 9.0, 9.0
    assert pose.position[0] == 0.0
    assert pose.rotation[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 1.0


@given(poses)
def test_a_pose_in_a_file_is_the_same_to_a_nanometre(pose: Pose) -> None:
    document = PoseDocument.of(pose)
    again = PoseDocument.model_validate_json(document.model_dump_json())
    assert again == document
    same(document.pose(), pose, atol=1e-9)
    assert "-0.0" not in [str(x) for x in document.position_mm]


@given(poses, st.integers(0, 2))
def test_poses_of_the_same_numbers_are_equal(pose: Pose, changed: int) -> None:
    again = Pose(pose.position, pose.rotation)
    assert again == pose
    assert hash(again) == hash(pose)
    assert pose != pose.matrix().tolist()
    moved = Pose(np.nextafter(pose.position, np.eye(3)[changed] * 99.0), pose.rotation)
    assert (moved == pose) == np.array_equal(moved.position, pose.position)


def test_a_zero_of_either_sign_is_the_same_pose() -> None:
    zero, negative = Pose.level([0.0, 0.0, 1.0]), Pose.level([-0.0, 0.0, 1.0])
    assert zero == negative
    assert len({zero, negative}) == 1
