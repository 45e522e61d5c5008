"""The uncertainty of a clearance follows from that of the pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from model.cameras import Z_95
from model.clearance import ClearanceModel
from model.errors import BadInput
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Camera, Rig, rig_from_document
from model.scene import Scene, load_scene, scene_from_document
from simulation.camera.camera import SyntheticCamera
from tracking.camera_model import distort_pixels, project_undistorted, undistort_pixels
from tracking.clearance import MeasuredClearance, clearance_of, require_stated_errors
from tracking.detection.tags import tag_corners
from tracking.edges.refine import RefinedTag
from tracking.fusion import fuse_poses
from tracking.measurement import PoseMeasurement
from tracking.pnp import TagView, moved, solve_pnp
from tracking.shared_errors import (
    SharedErrors,
    implied_rotation,
    tag_error_slopes,
)
from tracking.tracker import Tracker

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def crowded() -> Scene:
    return load_scene(CONFIGS / "environment_3.yaml")


@pytest.fixture(scope="module")
def ball() -> Scene:
    """One as far from the platform at home as from cable 5."""
    document = load_scene(CONFIGS / "environment_3.yaml").document
    plain = document.model_dump(mode="json", exclude_unset=True)
    sphere = {"sphere": {"radius_mm": 20.0}, "position_mm": [0.0, 300.0, 300.0]}
    return scene_from_document(
        SceneDocument.model_validate(plain | {"obstacles": [{"name": "ball", **sphere}]})
    )


def measurement(pose: Pose, covariance: np.ndarray) -> PoseMeasurement:
    return PoseMeasurement(0.0, pose, covariance, (301, 303), 0.03, "found", unstated=False)


@pytest.mark.parametrize("seed", range(6))
def test_uncertainty_agrees_with_distances_at_scattered_poses(
    rig: Rig, crowded: Scene, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    model = ClearanceModel(rig, crowded)
    turn = matrix_from_rotation_vector(rng.normal(size=3) * 0.05)
    pose = Pose(rng.uniform([-0.05, -0.1, 0.5], [0.15, 0.05, 0.6]), turn)
    root = rng.standard_normal((6, 6)) * np.array([*[2e-5] * 3, *[2e-4] * 3])[:, None]
    covariance = root @ root.T
    stated = clearance_of(model, measurement(pose, covariance))
    assert stated is not None
    steps = rng.multivariate_normal(np.zeros(6), covariance, size=300)
    distances = []
    for step in steps:
        rotation = matrix_from_rotation_vector(step[3:]) @ pose.rotation
        near = model.obstacles(Pose(pose.position + step[:3], rotation))
        distances.append([n.distance for n in near])
    scatter = np.std(np.array(distances), axis=0)
    predicted = stated.uncertainties / Z_95
    apart = np.array([n.distance > 0.0 for n in stated.nearest])
    assert apart.sum() >= 2
    np.testing.assert_allclose(predicted[apart], scatter[apart], rtol=0.15)
    assert np.all(predicted > 0.85 * scatter)  # where bodies overlap, the worst direction


def test_the_smallest_distance_counts_the_others_uncertainty_too(rig: Rig, crowded: Scene) -> None:
    near = ClearanceModel(rig, crowded).obstacles(rig.home)
    first, second = replace(near[0], distance=0.010), replace(near[1], distance=0.011)
    measured = MeasuredClearance((first, second), np.array([0.001, 0.004]))
    assert measured.distance == pytest.approx(0.010)
    assert measured.uncertainty == pytest.approx(0.003)  # the second may be only 7 mm away


def test_a_less_certain_body_behind_the_nearest_counts(rig: Rig, ball: Scene) -> None:
    """Where outlets are known badly, a cable may be nearer than the platform that is measured."""
    error = 8e-3
    known = replace(rig, outlet_error=error, anchor_error=0.0)
    model = ClearanceModel(known, ball)
    (bodies,) = model.near(rig.home, within=0.05)
    assert [body.first for body in bodies[:2]] == ["platform", "cable 5"], bodies
    assert bodies[1].distance - bodies[0].distance < 0.002
    stated = clearance_of(model, measurement(rig.home, np.eye(6) * 1e-10))
    assert stated is not None
    assert stated.distance == pytest.approx(bodies[0].distance)
    draw, low = np.random.default_rng(5), stated.distance - stated.uncertainty
    true = [
        ClearanceModel(
            replace(rig, outlets=rig.outlets + draw.normal(0.0, error / Z_95, (8, 3))), ball
        )
        .obstacles(rig.home)[0]
        .distance
        for _ in range(300)
    ]
    assert np.mean(np.array(true) < low) < 0.05
    assert np.mean(np.array(true) < stated.distance - 1e-3) > 0.1, "so the nearest alone misleads"


@given(seed=st.integers(0, 2**32 - 1), within=st.floats(0.0, 0.3))
@settings(max_examples=25)
def test_bodies_near_an_obstacle_are_those_that_comparing_all_finds(
    rig: Rig, crowded: Scene, seed: int, within: float
) -> None:
    pose = Pose.level(rig.home.position + np.random.default_rng(seed).uniform(-0.15, 0.15, 3))
    model = ClearanceModel(rig, crowded)
    everything = model.near(pose, within=10.0)
    for all_bodies, some, nearest in zip(
        everything, model.near(pose, within), model.obstacles(pose), strict=True
    ):
        assert len(all_bodies) == rig.cable_count + 1
        assert some[0].distance == pytest.approx(nearest.distance, abs=1e-12)
        limit = nearest.distance + within
        expected = [near.first for near in all_bodies if near.distance <= limit]
        assert {near.first for near in some} == set(expected)


def test_touching_bodies_take_the_worst_direction(rig: Rig, crowded: Scene) -> None:
    model = ClearanceModel(rig, crowded)
    covariance = np.diag([1e-8, 4e-8, 1e-8, 0.0, 0.0, 0.0])
    found = clearance_of(model, measurement(Pose.level([0.2, -0.15, 0.2]), covariance))
    assert found is not None
    assert found.distance < 0.0
    assert np.all(np.isfinite(found.uncertainties))
    assert found.uncertainties.max() >= 0.99 * Z_95 * 2e-4  # along the least known direction


def test_a_scene_without_obstacles_has_no_clearance(rig: Rig, crowded: Scene) -> None:
    """Also where errors are not stated: then there is nothing that they could change."""
    empty = ClearanceModel(rig, replace(crowded, obstacles=()))
    measured = measurement(rig.home, np.eye(6) * 1e-8)
    assert clearance_of(empty, measured) is None
    assert clearance_of(empty, replace(measured, unstated=True)) is None
    with pytest.raises(BadInput, match="unknown"):
        clearance_of(ClearanceModel(rig, crowded), replace(measured, unstated=True))


def looking(rig: Rig, **said: object) -> Camera:
    """The rig's camera, from a rig file with these keys."""
    plain = rig.document.model_dump(mode="json", exclude_unset=True)
    plain["cameras"][0] |= said
    return rig_from_document(RigDocument.model_validate(plain)).cameras[0]


def square(rig: Rig, camera: Camera, pose: Pose) -> list[TagView]:
    """The platform's tags that face the camera, observed without errors."""
    there = camera.world_from_camera.inverse().compose(pose)
    views = []
    for tag in rig.platform_tags:
        at = there.compose(tag.pose)
        if -at.rotation[:, 2] @ at.position / np.linalg.norm(at.position) > 0.3:
            corners = project_undistorted(camera, there.apply(tag_corners(tag)))
            whitening = np.eye(8) / 0.02
            seen = RefinedTag(corners, whitening, whitening @ corners.ravel(), np.ones(4, bool))
            views.append(TagView(tag, seen))
    return views


def shared_of(rig: Rig, camera: Camera, pose: Pose) -> np.ndarray:
    return SharedErrors(rig, camera).of(pose, square(rig, camera, pose))


POSE_DEVIATIONS = np.array([0.8, 0.5, 1.2, 0.06, 0.09, 0.03])
"""Standard deviations of a camera's pose, [mm] and [deg]."""


def test_errors_of_the_camera_pose_are_propagated_to_the_clearance(
    rig: Rig, crowded: Scene
) -> None:
    """Cameras with random errors as stated measure clearances that scatter as stated."""
    rng = np.random.default_rng(5)
    camera = looking(rig, pose_covariance=np.diag(POSE_DEVIATIONS**2).tolist(), error_mm=None)
    known = replace(rig, tag_error=0.0, outlet_error=0.0, anchor_error=0.0)
    camera = replace(camera, lens_covariance=np.zeros((8, 8)))
    model = ClearanceModel(rig, crowded)
    pose = Pose(np.array([0.05, -0.03, 0.55]), matrix_from_rotation_vector([0.02, -0.01, 0.03]))
    seen = camera.world_from_camera.inverse().compose(pose)
    sure = replace(
        measurement(pose, np.zeros((6, 6))),
        shared=shared_of(known, camera, pose),
    )
    stated = clearance_of(model, sure)
    assert stated is not None
    distances = []
    for step in rng.normal(size=(300, 6)) * POSE_DEVIATIONS:
        turn = matrix_from_rotation_vector(np.radians(step[3:]))
        here = camera.world_from_camera
        moved = Pose(here.position + step[:3] / 1e3, turn @ here.rotation)
        distances.append([n.distance for n in model.obstacles(moved.compose(seen))])
    scatter = np.std(np.array(distances), axis=0)
    apart = np.array([n.distance > 0.005 for n in stated.nearest])
    assert apart.sum() >= 2
    np.testing.assert_allclose(stated.uncertainties[apart] / Z_95, scatter[apart], rtol=0.2)
    assert stated.uncertainties.max() > 1e-3  # where 0.5 mm were stated before, whatever was known


def test_one_value_by_the_operator_replaces_all_shared_errors(rig: Rig, crowded: Scene) -> None:
    """For the cables too, unless calibrations state every part of the chain."""
    pose = Pose(np.array([0.05, -0.03, 0.55]), np.eye(3))
    shared = SharedErrors(rig, looking(rig, error_mm=1.96))
    one = np.diag([1e-6] * 3 + [0.0] * 3)
    np.testing.assert_allclose(shared.of(pose, []), one, atol=1e-15)
    assert not shared.unstated
    assert shared.operator_error == pytest.approx(1.96e-3)
    half = looking(rig, error_mm=1.96, pose_covariance=np.eye(6).tolist())
    np.testing.assert_allclose(SharedErrors(rig, half).of(pose, []), one, atol=1e-15)
    sure = measurement(pose, np.zeros((6, 6)))
    stated = clearance_of(
        ClearanceModel(rig, crowded), replace(sure, shared=one, cable_error=1.96e-3)
    )
    assert stated is not None
    assert np.all(stated.uncertainties <= 1.96e-3 * (1.0 + 1e-9))
    assert np.all(stated.uncertainties >= 1.96e-3 * (1.0 - 1e-9)), "also in a cable's middle"


def test_tags_that_are_off_as_stated_count_once(rig: Rig) -> None:
    """Tag errors make edges fit worse, which must not widen the pose's own scatter."""
    rng, scatter, values = np.random.default_rng(8), 0.03, []
    camera = looking(rig)
    count = 4 + camera.distortion.size
    camera = replace(
        camera,
        error=None,
        lens_covariance=np.zeros((count, count)),
        pose_covariance=np.zeros((6, 6)),
    )
    stated = replace(rig, tag_error=0.25e-3, outlet_error=0.0, anchor_error=0.0)
    shared = SharedErrors(stated, camera)
    for _ in range(200):
        turn = matrix_from_rotation_vector(rng.normal(size=3) * 0.08)
        pose = Pose(rng.uniform([-0.1, -0.1, 0.35], [0.15, 0.1, 0.55]), turn)
        views = []
        for view in square(rig, camera, pose):
            shifts = tag_error_slopes(view.tag, 0.25e-3) @ rng.standard_normal(6)
            points = pose.apply(tag_corners(view.tag) + shifts)
            seen = project_undistorted(camera, camera.world_from_camera.inverse().apply(points))
            seen = seen + scatter * rng.standard_normal(seen.shape)
            whitening = np.eye(8) / scatter
            corners = RefinedTag(seen, whitening, whitening @ seen.ravel(), np.ones(4, bool))
            views.append(TagView(view.tag, corners))
        bundle = solve_pnp(camera, views, camera.world_from_camera.inverse().compose(pose))
        assert bundle is not None
        found = camera.world_from_camera.compose(bundle.camera_from_body)
        turn = np.kron(np.eye(2), camera.world_from_camera.rotation)
        own = turn @ shared.scatter(bundle, views) @ turn.T
        error = np.concatenate(
            [
                found.position - pose.position,
                rotation_vector_from_matrix(found.rotation @ pose.rotation.T),
            ]
        )
        values.append(error @ np.linalg.solve(own + shared.of(found, views), error))
    assert 5.5 < np.mean(values) < 6.5


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_lens_error_is_propagated_through_extrinsics_and_pose_together(
    rig: Rig, fisheye: bool
) -> None:
    """Against poses by a slightly wrong lens, with extrinsics found with it."""
    lens = {"lens": "fisheye", "distortion": [0.01, -0.004, 0.002, -0.001]} if fisheye else {}
    camera = looking(rig, **lens)
    pose = Pose(np.array([0.05, -0.03, 0.55]), matrix_from_rotation_vector([0.1, -0.05, 0.2]))
    count = 4 + camera.distortion.size
    by_lens = np.zeros((6, count))
    by_lens[:3, 0] = 1e-6, -2e-6, 3e-6
    by_lens[3:, 2] = 1e-5, 2e-5, -1e-5
    deviations = np.array([0.3, 0.2, 0.5, 0.4, *[1e-3] * (count - 4)])
    known = replace(rig, tag_error=0.0, outlet_error=0.0, anchor_error=0.0)
    calibrated = replace(
        camera,
        error=None,
        lens_covariance=np.diag(deviations**2),
        pose_covariance=by_lens @ np.diag(deviations**2) @ by_lens.T,
        pose_by_lens=by_lens,
    )
    expected = np.zeros((6, 6))
    for k in range(count):
        step = by_lens[:, k] * deviations[k]
        world_from_camera = moved(camera.world_from_camera, step)
        matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
        if k < 4:
            matrix[k % 2, k % 2 if k < 2 else 2] += deviations[k]
        else:
            distortion[k - 4] += deviations[k]
        lens = {"matrix": matrix, "distortion": distortion}
        off = replace(camera, **lens, world_from_camera=world_from_camera)
        views = []
        for view in square(rig, camera, pose):
            corners = undistort_pixels(off, distort_pixels(camera, view.seen.corners))
            whitening = view.seen.whitening
            seen = replace(view.seen, corners=corners, target=whitening @ corners.ravel())
            views.append(TagView(view.tag, seen))
        found = solve_pnp(off, views, camera.world_from_camera.inverse().compose(pose))
        assert found is not None
        measured = world_from_camera.compose(found.camera_from_body)
        turn = rotation_vector_from_matrix(measured.rotation @ pose.rotation.T)
        change = np.concatenate([measured.position - pose.position, turn])
        expected += np.outer(change, change)
    got = shared_of(known, calibrated, pose)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        got / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03
    )


def test_an_error_of_the_principal_point_is_a_rotation_of_the_camera(rig: Rig) -> None:
    camera = looking(rig)
    by_lens = implied_rotation(camera)
    turn = camera.world_from_camera.rotation.T @ by_lens[:, 2]
    np.testing.assert_allclose(turn[1], 1.0 / camera.matrix[0, 0], rtol=0.25)


@pytest.mark.parametrize(
    "rows", [np.eye(5), np.triu(np.ones((6, 6))), -np.eye(6), np.eye(6)[:, :5]]
)
def test_what_is_no_covariance_of_a_pose_is_refused(rig: Rig, rows: np.ndarray) -> None:
    with pytest.raises(ValidationError, match="covariance"):
        looking(rig, pose_covariance=rows.tolist())


def test_a_mean_over_pictures_makes_no_shared_error_smaller(rig: Rig) -> None:
    """Two cameras of one survey have common errors: both are no more accurate than one."""
    covariance = np.diag(POSE_DEVIATIONS**2).tolist()
    camera = replace(looking(rig, pose_covariance=covariance), lens_covariance=np.zeros((8, 8)))
    pose = Pose(np.array([0.05, -0.03, 0.55]), np.eye(3))
    known = replace(rig, tag_error=0.0, outlet_error=0.0, anchor_error=0.0)
    shared = shared_of(known, camera, pose)
    one = replace(measurement(pose, np.eye(6) * 1e-8), shared=shared, unstated=False)
    both = fuse_poses({"a": one, "b": one})
    assert isinstance(both, PoseMeasurement)
    np.testing.assert_allclose(both.shared, shared, rtol=1e-9, atol=1e-15)
    assert not both.unstated
    half = fuse_poses({"a": one, "b": replace(one, unstated=True)})
    assert isinstance(half, PoseMeasurement)
    assert half.unstated


ALL = {"pose_covariance": np.eye(6).tolist(), "lens_covariance": np.eye(8).tolist()}
CABLES = {"outlets_error_mm": 1.0, "anchors_error_mm": 0.5}


@pytest.mark.parametrize(
    ("camera_says", "tags_say", "rig_says", "issues"),
    [
        ({}, None, {}, "lens_covariance.*pose_covariance.*tags.*outlets.*anchors"),
        (ALL, 0.1, {}, "outlets_error_mm"),
        (ALL, None, CABLES, "tags: error_mm"),
        ({"pose_covariance": np.eye(6).tolist()}, 0.1, CABLES, "lens_covariance"),
        (ALL, 0.1, CABLES, ""),
        ({"error_mm": 0.8}, None, {}, ""),
    ],
)
def test_no_clearance_is_measured_where_nothing_says_how_far_off_it_is(
    rig: Rig,
    crowded: Scene,
    camera_says: dict,
    tags_say: float | None,
    rig_says: dict,
    issues: str,
) -> None:
    plain = rig.document.model_dump(mode="json", exclude_unset=True)
    plain["cameras"][0] |= {"error_mm": None} | camera_says
    plain["tags"]["error_mm"] = tags_say
    said = rig_from_document(RigDocument.model_validate(plain | rig_says))
    picture = SyntheticCamera(said, crowded, said.cameras[0], 3).render(said.home, 0)
    found = Tracker(said, said.cameras[0]).observe(picture, 0.0)
    assert isinstance(found, PoseMeasurement)
    assert found.unstated is bool(issues)
    if issues:
        with pytest.raises(BadInput, match=f"(?s){issues}"):
            require_stated_errors(said, said.cameras)
        with pytest.raises(BadInput, match="error_mm"):
            clearance_of(ClearanceModel(said, crowded), found)
        return
    require_stated_errors(said, said.cameras)
    stated = clearance_of(ClearanceModel(said, crowded), found)
    assert stated is not None
    assert stated.uncertainties.min() > 0.5e-3
