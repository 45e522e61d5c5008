"""Rigid pose from all tags: exact, without mirror poses, with a correct covariance."""

from __future__ import annotations

import numpy as np
import pytest

from model.pose import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Camera, Rig, Tag
from tests.tracking.tag_pictures import small_camera
from tracking.camera_model import distort_pixels, project_undistorted, undistort_pixels
from tracking.detection.tags import tag_corners
from tracking.edges.refine import RefinedTag
from tracking.pnp import TagView, _Squares, moved, refine_pnp, solve_pnp

LINE_DEVIATION = (0.02, 0.001)  # offset [px] and tilt [rad] of an edge


def view_of(
    camera: Camera,
    tag: Tag,
    camera_from_body: Pose,
    rng: np.random.Generator | None,
    worse: float = 1.0,
) -> TagView:
    """A tag with edge errors as stated, or larger by a factor."""
    corners = project_undistorted(camera, camera_from_body.apply(tag_corners(tag)))
    whitening = np.zeros((8, 8))
    for edge in range(4):
        other = (edge + 1) % 4
        side = corners[other] - corners[edge]
        length = float(np.linalg.norm(side))
        normal = np.array([side[1], -side[0]]) / length
        first, second = slice(2 * edge, 2 * edge + 2), slice(2 * other, 2 * other + 2)
        whitening[2 * edge, first] = whitening[2 * edge, second] = 0.5 * normal / LINE_DEVIATION[0]
        whitening[2 * edge + 1, first] = -normal / length / LINE_DEVIATION[1]
        whitening[2 * edge + 1, second] = normal / length / LINE_DEVIATION[1]
    target = whitening @ corners.ravel()
    if rng is not None:
        target = target + worse * rng.standard_normal(8)
    seen = np.linalg.solve(whitening, target).reshape(4, 2)
    return TagView(tag, RefinedTag(seen, whitening, target, np.ones(4, dtype=bool)))


def visible(rig: Rig, camera_from_body: Pose) -> list[Tag]:
    tags = []
    for tag in rig.platform_tags:
        pose = camera_from_body.compose(tag.pose)
        if -pose.rotation[:, 2] @ pose.position > 0.35 * np.linalg.norm(pose.position):
            tags.append(tag)
    return tags


def some_pose(rng: np.random.Generator) -> Pose:
    turn = matrix_from_rotation_vector(rng.uniform(-1.5, 1.5, 3))
    return Pose(np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.8, 1.4)]), turn)


def test_exact_edges_give_the_exact_pose_from_no_guess(rig: Rig) -> None:
    rng, camera = np.random.default_rng(1), small_camera()
    for _ in range(30):
        truth = some_pose(rng)
        views = [view_of(camera, tag, truth, None) for tag in visible(rig, truth)]
        found = solve_pnp(camera, views)
        assert found is not None
        assert found.camera_from_body.distance_to(truth) < 1e-6
        assert found.camera_from_body.angle_to(truth) < 1e-5
        assert found.reprojection < 1e-3


def test_several_tags_never_end_in_a_mirror_pose(rig: Rig) -> None:
    rng, camera = np.random.default_rng(2), small_camera()
    for _ in range(60):
        truth = some_pose(rng)
        tags = visible(rig, truth)
        if len(tags) < 2:
            continue
        found = solve_pnp(camera, [view_of(camera, tag, truth, rng) for tag in tags])
        assert found is not None
        assert found.camera_from_body.angle_to(truth) < 0.03


def test_edges_that_disagree_by_more_than_they_state_widen_the_intervals(rig: Rig) -> None:
    """Twice as large: if the stated deviations counted too, coverage was 81 %."""
    rng, camera = np.random.default_rng(4), small_camera()
    inside: list[bool] = []
    for _ in range(120):
        truth = some_pose(rng)
        tags = visible(rig, truth)
        if len(tags) < 2:
            continue
        views = [view_of(camera, tag, truth, rng, worse=2.0) for tag in tags]
        found = refine_pnp(camera, views, truth)
        assert found is not None
        turn = found.camera_from_body.rotation @ truth.rotation.T
        shift = found.camera_from_body.position - truth.position
        error = np.concatenate([shift, rotation_vector_from_matrix(turn)])
        inside += (np.abs(error) <= 1.96 * np.sqrt(np.diag(found.covariance))).tolist()
    assert 0.91 < np.mean(inside) < 0.98


def test_covariance_agrees_with_the_scatter_of_repeated_measurements(rig: Rig) -> None:
    rng, camera = np.random.default_rng(3), small_camera()
    truth = some_pose(rng)
    normalised, errors, stated = [], [], []
    for _ in range(150):
        views = [view_of(camera, tag, truth, rng) for tag in visible(rig, truth)]
        found = solve_pnp(camera, views)
        assert found is not None
        turn = found.camera_from_body.rotation @ truth.rotation.T
        shift = found.camera_from_body.position - truth.position
        error = np.concatenate([shift, rotation_vector_from_matrix(turn)])
        normalised.append(error @ np.linalg.solve(found.covariance, error))
        errors.append(error)
        stated.append(np.sqrt(np.diag(found.covariance)))
    assert 4.0 < np.mean(normalised) < 7.0  # 6 degrees of freedom; never less than the scatter
    np.testing.assert_allclose(np.mean(stated, axis=0), np.std(errors, axis=0), rtol=0.3)


def test_a_tag_with_a_wrong_edge_hardly_moves_the_pose(rig: Rig) -> None:
    rng, camera = np.random.default_rng(4), small_camera()
    truth = Pose(np.array([0.0, 0.0, 1.0]), matrix_from_rotation_vector([0.6, 0.5, 0.1]))
    views = [view_of(camera, tag, truth, rng) for tag in visible(rig, truth)]
    assert len(views) >= 3
    clean = solve_pnp(camera, views)
    target = views[0].seen.target.copy()
    target[0] += 100.0  # two pixels
    bad = RefinedTag(views[0].seen.corners, views[0].seen.whitening, target, views[0].seen.edges)
    spoilt = solve_pnp(camera, [TagView(views[0].tag, bad), *views[1:]])
    assert clean is not None
    assert spoilt is not None
    assert spoilt.camera_from_body.distance_to(clean.camera_from_body) < 3e-3
    assert spoilt.edge_errors[0, 0] > 50.0  # and the edge shows


def test_a_single_tag_has_a_second_best_pose(rig: Rig) -> None:
    rng, camera = np.random.default_rng(5), small_camera()
    tag = rig.platform_tags[0]
    upright = Pose(np.zeros(3), np.diag([1.0, -1.0, -1.0])).compose(tag.pose.inverse())
    lean = Pose(np.array([0.0, 0.0, 2.2]), matrix_from_rotation_vector([0.5, 0.0, 0.0]))
    found = solve_pnp(camera, [view_of(camera, tag, lean.compose(upright), rng)])
    assert found is not None
    assert found.cost < found.second_best_cost < np.inf


def test_jacobian_matches_finite_differences(rig: Rig) -> None:
    rng, camera = np.random.default_rng(6), small_camera()
    truth = some_pose(rng)
    views = [view_of(camera, tag, truth, rng) for tag in visible(rig, truth)]
    squares = _Squares.of(camera, views)
    analytic = squares.jacobian(truth)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        numeric = (squares.errors(moved(truth, step)) - squares.errors(moved(truth, -step))) / 2e-6
        np.testing.assert_allclose(analytic[..., k], numeric, rtol=1e-4, atol=1e-1)


def test_a_start_behind_the_camera_gives_no_pose(rig: Rig) -> None:
    camera, truth = small_camera(), Pose.level([0.0, 0.0, 1.0])
    views = [view_of(camera, tag, truth, None) for tag in visible(rig, truth)]
    assert refine_pnp(camera, views, Pose.level([0.0, 0.0, -1.0])) is None


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 0.001, -0.001, 0.01)])
def test_distortion_is_put_on_and_taken_off(distortion: tuple[float, ...]) -> None:
    camera = small_camera(distortion)
    points: Array = np.random.default_rng(7).uniform([0, 0], [319, 239], (5, 4, 2))
    back = distort_pixels(camera, undistort_pixels(camera, points))
    np.testing.assert_allclose(back, points, atol=1e-5)
