"""Distances at one pose: against coal, closed forms and dense sampling."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.clearance import ClearanceModel, SelfModel
from model.distances import (
    box_body,
    convex_bodies,
    segment_body,
    segment_box_points,
    segment_pair_points,
    separation,
)
from model.files.scene_file import SceneDocument
from model.kinematics import cables_at
from model.pose import Pose, interpolate
from model.rig import rig_from_document
from model.scene import load_scene, scene_from_document
from model.shapes import Box, Capsule, Cylinder, Sphere, TriangleMesh, convex_hull
from tests.configs import CONFIGS, GACHON, HALL

seeds = st.integers(0, 2**32 - 1)


def scene_with(*obstacles: dict[str, object]):
    return scene_from_document(
        SceneDocument.model_validate(
            {
                "schema_version": 1,
                "name": "test",
                "start": {"position_mm": [0, 0, 445]},
                "goal": {"position_mm": [0, 0, 445]},
                "obstacles": list(obstacles),
            }
        )
    )


def random_pose(rng: np.random.Generator, reach: float = 0.5) -> Pose:
    return Pose(rng.uniform(-reach, reach, 3), Rotation.random(rng=rng).as_matrix())


def coal_distance(first, first_pose: Pose, second, second_pose: Pose) -> float:
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.gjk_max_iterations = 1e-9, 1000
    transforms = [
        coal.Transform3s(p.rotation.copy(), p.position.copy()) for p in (first_pose, second_pose)
    ]
    return coal.distance(first, transforms[0], second, transforms[1], request, result)


def coal_points(points: np.ndarray):
    cloud = coal.StdVec_Vec3s()
    for point in points:
        cloud.append(np.array(point))
    return coal.Convex.convexHull(cloud, False, "")


def obstacle_kinds(rng: np.random.Generator):
    size = rng.uniform(0.05, 0.3, 3)
    corners = rng.uniform(-0.3, 0.3, (12, 3))
    return [
        (Box(size), coal.Box(*(2 * size))),
        (Sphere(size[0]), coal.Sphere(size[0])),
        (Cylinder(size[0], size[1]), coal.Cylinder(size[0], size[1])),
        (Capsule(size[0], size[1]), coal.Capsule(size[0], size[1])),
        (convex_hull(corners), coal_points(corners)),
    ]


def coal_frame(start: np.ndarray, end: np.ndarray) -> tuple[Pose, float]:
    along = end - start
    turn, _ = Rotation.align_vectors(along[None, :], np.array([[0.0, 0.0, 1.0]]))
    return Pose((start + end) / 2, turn.as_matrix()), float(np.linalg.norm(along))


@given(seeds)
def test_distance_of_a_segment_to_every_shape_agrees_with_coal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-1, 1, (2, 3))
    frame, length = coal_frame(start, end)
    for shape, oracle in obstacle_kinds(rng):
        pose = random_pose(rng)
        found = separation(segment_body(start, end), convex_bodies(shape, pose)[0])
        expected = coal_distance(coal.Capsule(1e-9, length), frame, oracle, pose) + 1e-9
        if expected > 1e-6:
            assert found.distance == pytest.approx(expected, abs=1e-6)
        else:
            assert found.distance <= 1e-6


@given(seeds)
def test_distance_of_a_box_to_every_shape_agrees_with_coal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, at = rng.uniform(0.05, 0.2, 3), random_pose(rng, 1.0)
    for shape, oracle in obstacle_kinds(rng):
        pose = random_pose(rng)
        found = separation(box_body(size, at), convex_bodies(shape, pose)[0])
        expected = coal_distance(coal.Box(*(2 * size)), at, oracle, pose)
        if expected > 1e-6:
            assert found.distance == pytest.approx(expected, abs=1e-6)
        else:
            assert found.distance <= 1e-6


@given(seeds)
def test_a_segment_that_ends_on_the_axis_of_a_tilted_cylinder_is_as_far_as_its_face(seed) -> None:
    rng = np.random.default_rng(seed)
    radius, length, gap = rng.uniform(0.05, 0.3, 3)
    end = np.array([0.0, 0.0, length / 2 + gap])
    pose = random_pose(rng)
    ends = [pose.position + pose.rotation @ at for at in (end, end + rng.uniform(0.0, 1.0, 3))]
    found = separation(segment_body(*ends), convex_bodies(Cylinder(radius, length), pose)[0])
    assert found.distance == pytest.approx(gap, abs=1e-6)


@given(seeds)
def test_a_distance_proves_itself_and_its_points_lie_that_far_apart(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = segment_body(*rng.uniform(-1, 1, (2, 3)))
    for shape, _ in obstacle_kinds(rng):
        obstacle = convex_bodies(shape, random_pose(rng))[0]
        found = separation(body, obstacle)
        gap = -obstacle.extent(-found.normal) - body.extent(found.normal)
        assert gap == pytest.approx(found.distance, abs=1e-6)
        if found.distance > 1e-6:
            apart = np.linalg.norm(found.second_point - found.first_point)
            assert apart == pytest.approx(found.distance, abs=1e-6)


@given(seeds)
def test_moving_out_by_the_depth_separates_overlapping_bodies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size, at = rng.uniform(0.05, 0.2, 3), random_pose(rng, 0.1)
    for shape, _ in obstacle_kinds(rng):
        pose = random_pose(rng, 0.1)
        obstacle = convex_bodies(shape, pose)[0]
        found = separation(box_body(size, at), obstacle)
        if found.distance >= 0.0:
            continue
        out = Pose(at.position + (found.distance - 1e-4) * found.normal, at.rotation)
        assert separation(box_body(size, out), obstacle).distance >= 1e-4 - 1e-6


def test_a_body_wholly_inside_another_touches_it() -> None:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    hull = convex_bodies(convex_hull(corners), Pose.level([0, 0, 0]))[0]
    inside = Pose.level([0.3, 0.1, 0.2])
    assert separation(box_body(np.full(3, 0.1), inside), hull).distance == pytest.approx(-0.8)
    ball = convex_bodies(Sphere(0.01), inside)[0]
    assert separation(box_body(np.full(3, 0.1), inside), ball).distance == pytest.approx(-0.11)
    line = segment_body(np.zeros(3), np.array([0.1, 0.2, 0.1]))
    assert separation(line, hull).distance == pytest.approx(-1.0)


@given(seeds)
def test_mesh_distance_is_that_of_its_nearest_triangle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hull, pose = convex_hull(rng.uniform(-0.2, 0.2, (9, 3))), random_pose(rng)
    start, end = rng.uniform(-1, 1, (2, 3))
    body = segment_body(start, end)
    mesh = convex_bodies(TriangleMesh(hull.vertices, hull.triangles), pose)
    nearest = min(separation(body, triangle).distance for triangle in mesh)
    solid = separation(body, convex_bodies(hull, pose)[0]).distance
    if solid > 1e-6:  # outside a closed mesh the surface is as far as the solid
        assert nearest == pytest.approx(solid, abs=1e-6)


@given(seeds)
def test_nearest_points_of_segments_beat_every_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-1, 1, (4, 3))
    if seed % 3 == 0:  # parallel
        ends[3] = ends[2] + rng.uniform(-2, 2) * (ends[1] - ends[0])
    on_a, on_b = segment_pair_points(*ends)
    found = np.linalg.norm(on_a - on_b)
    t = np.linspace(0, 1, 101)[:, None]
    first, second = ends[0] + t * (ends[1] - ends[0]), ends[2] + t * (ends[3] - ends[2])
    sampled = np.linalg.norm(first[:, None] - second[None], axis=-1).min()
    assert sampled - 0.05 <= found <= sampled + 1e-12


@given(seeds)
def test_nearest_points_of_segment_and_box_beat_every_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-1, 1, (2, 3))
    if seed % 3 == 0:
        end[seed % 2] = start[seed % 2]
    half = rng.uniform(0.05, 0.4, 3)
    on_segment, in_box = segment_box_points(start, end, half)
    samples = start + np.linspace(0, 1, 2001)[:, None] * (end - start)
    sampled = np.linalg.norm(samples - np.clip(samples, -half, half), axis=-1).min()
    found = np.linalg.norm(on_segment - in_box)
    assert sampled - 2e-3 <= found <= sampled + 1e-12
    assert np.all(np.abs(in_box) <= half + 1e-12)


def test_start_and_goal_of_the_paper_have_the_known_clearances() -> None:
    """Source: reference values of the first environment (independent computation)."""
    scene = load_scene(CONFIGS / "environment_1.yaml")
    model = ClearanceModel(GACHON, scene)
    start, goal = model.smallest(scene.start), model.smallest(scene.goal)
    assert start is not None
    assert goal is not None
    assert (start.first, start.second) == ("cable 7", "obstacle_1")
    assert start.distance == pytest.approx(0.0322, abs=5e-5)
    assert goal.distance == pytest.approx(0.0453, abs=5e-5)


@given(st.tuples(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.floats(0.15, 0.65)))
def test_crossing_cables_pass_at_11_to_16_mm_over_the_workspace(position) -> None:
    model = ClearanceModel(GACHON, scene_with())
    pairs = SelfModel(GACHON)
    gaps = pairs.cable_pairs(cables_at(GACHON, Pose.level(position)))
    k = int(np.argmin(gaps.distances))
    assert tuple(pairs.pairs[k] + 1) in {(1, 5), (2, 6), (3, 7), (4, 8)}
    assert 0.0109 <= gaps.distances[k] <= 0.0165
    assert model.self_clearance(Pose.level(position)).distance <= gaps.distances[k]


@pytest.mark.parametrize("name", ["environment_3", "hall_pillar"])
def test_planes_cached_from_other_poses_do_not_change_the_result(name: str) -> None:
    rig = HALL if name.startswith("hall") else GACHON
    scene = load_scene(CONFIGS / f"{name}.yaml")
    used = ClearanceModel(rig, scene)
    poses = [interpolate(scene.start, scene.goal, t) for t in np.linspace(0, 1, 40)]
    along = [used.obstacles(pose) for pose in poses]
    for pose, found in zip(poses, along, strict=True):
        fresh = ClearanceModel(rig, scene).obstacles(pose)
        distances = [near.distance for near in fresh]
        assert [near.distance for near in found] == pytest.approx(distances, abs=2e-7)


@pytest.mark.parametrize("rig", [GACHON, HALL], ids=["points", "pulleys"])
def test_every_obstacle_is_reported_with_its_nearest_body(rig) -> None:
    scene = scene_with(
        {"name": "ball", "sphere": {"radius_mm": 30}, "position_mm": [300, 0, 800]},
        {"name": "post", "cylinder": {"radius_mm": 20, "length_mm": 300},
         "position_mm": [0, 900, 150]},
        {"name": "wall", "mesh": {"points_mm": [[-900, 0, 0], [-900, 99, 0], [-900, 0, 99]],
                                  "triangles": [[0, 1, 2]]}},
    )  # fmt: skip
    model, rng = ClearanceModel(rig, scene), np.random.default_rng(4)
    for _ in range(20):
        pose = Pose.level(rng.uniform(rig.workspace_lower, rig.workspace_upper))
        cables = cables_at(rig, pose)
        for obstacle, near in zip(scene.obstacles, model.obstacles(pose), strict=True):
            pieces = convex_bodies(obstacle.shape, obstacle.pose)
            bodies = [segment_body(a, b) for a, b in zip(cables.exits, cables.anchors, strict=True)]
            lines = [min(separation(b, p).distance for p in pieces) for b in bodies]
            box = box_body(rig.half_size, pose)
            every = [*(d - rig.cable_radius for d in lines),
                     min(separation(box, p).distance for p in pieces)]  # fmt: skip
            assert near.second == obstacle.name
            assert near.distance == pytest.approx(min(every), abs=2e-7)
            names = [*(f"cable {i + 1}" for i in range(rig.cable_count)), "platform"]
            assert near.first == names[int(np.argmin(every))]


def test_a_scene_without_obstacles_has_no_smallest_distance() -> None:
    model = ClearanceModel(GACHON, scene_with())
    assert model.obstacles(GACHON.home) == ()
    assert model.smallest(GACHON.home) is None


@pytest.mark.parametrize("rig", [GACHON, HALL], ids=lambda rig: rig.name)
def test_self_clearances_of_many_poses_are_those_of_each(rig) -> None:
    rng = np.random.default_rng(8)
    turn = np.radians(20.0)
    poses = [
        Pose(
            rng.uniform(rig.workspace_lower, rig.workspace_upper),
            Rotation.from_rotvec(rng.uniform(-turn, turn, 3)).as_matrix(),
        )
        for _ in range(40)
    ]
    model = ClearanceModel(rig, scene_with())
    at_once = model.self_clearances(
        np.array([p.position for p in poses]), np.array([p.rotation for p in poses])
    )
    each = [model.self_clearance(p).distance for p in poses]
    assert np.allclose(at_once, each, rtol=0.0, atol=1e-12)


def test_a_cable_along_a_face_of_the_platform_has_no_self_clearance() -> None:
    """Rotated far about z, cables lie across the platform: they pass through its edges."""
    rotated = Pose(GACHON.home.position, Rotation.from_euler("z", 150, degrees=True).as_matrix())
    model = ClearanceModel(GACHON, scene_with())
    assert model.self_clearance(rotated).distance < 0.0
    assert model.self_clearance(GACHON.home).distance > 0.010


@given(seeds)
def test_the_depth_of_a_cable_in_the_platform_is_the_shortest_way_out(seed: int) -> None:
    """Rotated far, cables pass through the platform: against the general distance of bodies."""
    rng, model = np.random.default_rng(seed), SelfModel(GACHON)
    pose = Pose(GACHON.home.position, Rotation.random(rng=rng).as_matrix())
    cables = cables_at(GACHON, pose)
    found = model.to_platform(cables, pose.position, pose.rotation).distances
    box = box_body(GACHON.half_size, pose)
    starts = cables.anchors + model.stub * cables.directions
    for start, end, distance in zip(starts, cables.exits, found, strict=True):
        expected = separation(segment_body(start, end), box).distance - GACHON.cable_radius
        assert distance == pytest.approx(expected, abs=2e-7)
        if distance < -GACHON.cable_radius:  # no point of the cable is deeper than that
            points = start + np.linspace(0.0, 1.0, 101)[:, None] * (end - start)
            local = (points - pose.position) @ pose.rotation
            deepest = np.min(GACHON.half_size - np.abs(local), axis=-1).max()
            assert deepest + GACHON.cable_radius <= -distance + 1e-9


def test_cables_that_share_an_anchor_are_compared_beyond_a_stub() -> None:
    document = GACHON.document
    anchors = [list(a) for a in document.anchors_mm]
    anchors[1] = anchors[0]
    rig = rig_from_document(document.model_copy(update={"anchors_mm": anchors}))
    model = SelfModel(rig)
    cables = cables_at(rig, rig.home)
    shared = model.cable_pairs(cables).distances[0]
    angle = np.arccos(cables.directions[0] @ cables.directions[1])
    assert shared == pytest.approx(2 * model.stub * np.sin(angle / 2))


@pytest.mark.parametrize("apart_mm", [0.0, 3.9, 4.1, 30.0])
def test_ends_that_are_only_near_each_other_leave_nothing_out(apart_mm: float) -> None:
    """Two posts with outlets close together, whose cables cross just below them."""
    document = GACHON.document
    outlets = [list(o) for o in document.outlets_mm]
    outlets[1] = [outlets[0][0] + apart_mm, *outlets[0][1:]]
    cables = document.cables.model_copy(update={"radius_mm": 2.0})
    update = {"outlets_mm": outlets, "cables": cables}
    rig = rig_from_document(document.model_copy(update=update))
    model = SelfModel(rig)
    assert model.stub == pytest.approx(0.0325)
    assert (model.stubs[0] > 0.0).tolist() == [False, apart_mm < 4.0]


def test_the_cable_radius_reduces_every_distance() -> None:
    document = GACHON.document
    thick = document.cables.model_copy(update={"radius_mm": 2.0})
    rig = rig_from_document(document.model_copy(update={"cables": thick}))
    scene = load_scene(CONFIGS / "environment_1.yaml")
    thin_model, thick_model = ClearanceModel(GACHON, scene), ClearanceModel(rig, scene)
    thin, found = thin_model.smallest(scene.start), thick_model.smallest(scene.start)
    assert thin is not None
    assert found is not None
    assert found.distance == pytest.approx(thin.distance - 0.002)
    difference = (
        thin_model.self_clearance(scene.start).distance
        - thick_model.self_clearance(scene.start).distance
    )
    assert difference == pytest.approx(0.004)


@given(seeds, st.floats(0.0, 0.3))
def test_a_bound_over_a_translation_holds_for_every_obstacle(seed: int, wanted: float) -> None:
    """Also for those that come after one whose bound fails."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-0.2, -0.2, 0.25], [0.2, 0.2, 0.5], (2, 3))
    spheres = [
        {"name": f"sphere {k}", "position_mm": at, "sphere": {"radius_mm": 20.0}}
        for k, at in enumerate((rng.uniform(-0.3, 0.6, (4, 3)) * 1e3).tolist())
    ]
    model = ClearanceModel(GACHON, scene_with(*spheres))
    bound = model.at_least(Pose.level(positions.mean(axis=0)), positions, wanted)
    for share in np.linspace(0.0, 1.0, 9):
        nearest = model.smallest(Pose.level(positions[0] + share * (positions[1] - positions[0])))
        assert nearest is not None
        assert nearest.distance >= bound - 1e-9
