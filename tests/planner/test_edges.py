"""Edges against obstacles: what is allowed keeps the clearance everywhere, what is not does not."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpr.cables import cables_at
from cdpr.clearance import ClearanceModel
from cdpr.poses import Pose, interpolate
from cdpr.shapes import Box
from planner.edges import ObstacleEdges
from planner.swept import anchor_motion, exit_motion, swept


def random_edges(rig, count: int, seed: int, longest: float, turn_deg: float = 0.0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        start = rng.uniform(rig.workspace_lower, rig.workspace_upper)
        along = rng.normal(size=3)
        end = start + along / np.linalg.norm(along) * rng.uniform(0.0, longest)
        turns = Rotation.from_rotvec(np.radians(rng.uniform(-turn_deg, turn_deg, (2, 3))))
        first, second = turns.as_matrix()
        yield Pose(start, first), Pose(end, second)


def smallest_sampled(rig, scene, start: Pose, end: Pose, count: int) -> float:
    model = ClearanceModel(rig, scene)
    poses = [interpolate(start, end, t) for t in np.linspace(0, 1, count)]
    return min(model.smallest(pose).distance for pose in poses)


def test_edges_decide_as_dense_sampling_does_for_point_exits(gachon, ready_scene) -> None:
    scene, required, count = ready_scene("environment_2"), 0.010, 40
    edges = ObstacleEdges(gachon, scene, required)
    decided = []
    for start, end in random_edges(gachon, 50, seed=1, longest=0.15):
        sampled = smallest_sampled(gachon, scene, start, end, count)
        between = start.distance_to(end) / (count - 1) / 2.0
        allowed = edges.clear(start, end)
        decided.append(allowed)
        if allowed:
            assert sampled >= required - 1e-6
        else:
            assert sampled < required + between + 1e-6
    assert 4 < sum(decided) < 46


@pytest.mark.parametrize("turn_deg", [0.0, 6.0])
def test_allowed_edges_with_pulleys_and_turning_keep_the_clearance(
    hall, ready_scene, turn_deg: float
) -> None:
    scene, required = ready_scene("hall_pillar"), 0.040
    edges = ObstacleEdges(hall, scene, required)
    allowed = 0
    for start, end in random_edges(hall, 25, seed=2, longest=0.4, turn_deg=turn_deg):
        if edges.clear(start, end):
            allowed += 1
            assert smallest_sampled(hall, scene, start, end, 25) >= required - 1e-6
        else:
            assert smallest_sampled(hall, scene, start, end, 40) < required + 0.008
    assert 5 < allowed < 25


def coal_segment(start: np.ndarray, end: np.ndarray):
    """coal's capsule of practically no radius, and its place."""
    turn, _ = Rotation.align_vectors((end - start)[None, :], np.array([[0.0, 0.0, 1.0]]))
    shape = coal.Capsule(1e-9, float(np.linalg.norm(end - start)))
    return shape, coal.Transform3s(turn.as_matrix(), (start + end) / 2)


def coal_hull(points: np.ndarray):
    cloud = coal.StdVec_Vec3s()
    for point in points:
        cloud.append(point.copy())
    return coal.Convex.convexHull(cloud, False, ""), coal.Transform3s()


def test_allowed_edges_are_clear_by_coal_too(gachon, ready_scene) -> None:
    """Another library's word on the swept platform, and on the cables at places of the edge."""
    scene, required = ready_scene("environment_3"), 0.010
    edges, seen = ObstacleEdges(gachon, scene, required), 0
    request = coal.DistanceRequest()
    for start, end in random_edges(gachon, 80, seed=3, longest=0.15):
        if not edges.clear(start, end):
            continue
        seen += 1
        bodies = [coal_hull(swept(gachon, start, end).platform)]
        for t in (0.0, 0.3, 0.5, 0.8, 1.0):
            cables = cables_at(gachon, interpolate(start, end, t))
            ends = zip(cables.exits, cables.anchors, strict=True)
            bodies += [coal_segment(*both) for both in ends]
        for obstacle in scene.obstacles:
            assert isinstance(obstacle.shape, Box)
            box = coal.Box(*(2 * obstacle.shape.half_size))
            place = coal.Transform3s(np.eye(3), obstacle.pose.position.copy())
            for body, where in bodies:
                distance = coal.distance(body, where, box, place, request, coal.DistanceResult())
                assert distance >= required - 1e-6
    assert seen > 5


def test_remembered_planes_do_not_change_an_answer(gachon, ready_scene) -> None:
    scene = ready_scene("environment_2")
    used = ObstacleEdges(gachon, scene, 0.010)
    for start, end in random_edges(gachon, 100, seed=4, longest=0.1):
        fresh = ObstacleEdges(gachon, scene, 0.010)
        assert used.clear(start, end) == fresh.clear(start, end)


def test_a_cable_radius_counts_as_clearance(gachon, ready_scene) -> None:
    from cdpr.rig import rig_from_document

    scene = ready_scene("environment_1")
    document = gachon.document
    thick_cables = document.cables.model_copy(update={"radius_mm": 3.0})
    thick = rig_from_document(document.model_copy(update={"cables": thick_cables}))
    gap = ClearanceModel(gachon, scene).smallest(scene.start)
    required = gap.distance - 0.002
    assert ObstacleEdges(gachon, scene, required).clear(scene.start, scene.start)
    assert not ObstacleEdges(thick, scene, required).clear(scene.start, scene.start)


def test_a_small_ball_inside_the_platform_is_a_collision(gachon, scene_with) -> None:
    scene = scene_with({"name": "ball", "sphere": {"radius_mm": 3}, "position_mm": [0, 0, 445]})
    assert not ObstacleEdges(gachon, scene, 0.0).clear(scene.start, scene.goal)


@pytest.mark.parametrize("turn_deg", [0.0, 10.0])
def test_hulls_grown_by_their_bound_hold_all_that_is_swept(hall, turn_deg: float) -> None:
    rng = np.random.default_rng(5)
    for start, end in random_edges(hall, 30, seed=6, longest=0.4, turn_deg=turn_deg):
        hulls = swept(hall, start, end)
        directions = rng.normal(size=(20, hall.cable_count + 1, 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        reach = hulls.reach(directions) + hulls.growth
        for t in np.linspace(0, 1, 9):
            pose = interpolate(start, end, float(t))
            cables = cables_at(hall, pose)
            along = directions[:, :-1]
            for points in (cables.exits, cables.anchors):
                assert np.all(np.sum(along * points, axis=-1) <= reach[:, :-1] + 1e-9)
            corners = pose.apply(hall.platform_corners)
            assert np.all(directions[:, -1] @ corners.T <= reach[:, -1:] + 1e-9)


def test_anchors_and_exits_move_no_farther_than_their_bounds(hall) -> None:
    for start, end in random_edges(hall, 30, seed=7, longest=0.3, turn_deg=8.0):
        before, after = cables_at(hall, start), cables_at(hall, end)
        moved = np.linalg.norm(after.anchors - before.anchors, axis=-1)
        assert np.all(moved <= anchor_motion(hall, start, end) + 1e-12)
        rolled = np.linalg.norm(after.exits - before.exits, axis=-1)
        assert np.all(rolled <= exit_motion(hall, start, end) + 1e-12)
