"""Edges on which the platform turns: against coal at dense poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.kinematics import cables_to
from model.pose import Pose
from model.rig import Rig
from planner.collision.edges import edge_clearance, edge_free
from planner.collision.rotating_edges import rotated_by, rotating_edge_free
from planner.collision.world import build_world
from planner.kernels.scene_arrays import exit_point, exit_travel
from tests.configs import GACHON, HALL
from tests.planner.collision.sampled_oracle import KINDS, CoalScene, random_scene

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_a_share_of_a_turn_is_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, turn, share = Rotation.random(rng=rng), rng.normal(size=3), rng.uniform()
    expected = (start * Rotation.from_rotvec(share * turn)).as_matrix()
    assert np.allclose(rotated_by(start.as_matrix(), turn, share), expected, rtol=0, atol=1e-14)


@given(seeds)
def test_exits_are_those_of_the_model_and_travel_no_farther_than_bounded(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world = build_world(HALL, random_scene(rng, HALL, 0), np.eye(3), 0.01)
    position = rng.uniform(HALL.workspace_lower, HALL.workspace_upper)
    delta = rng.normal(size=3) * 0.05
    anchors = HALL.anchors + position + np.linspace(0.0, 1.0, 9)[:, None, None] * delta
    exits = cables_to(HALL, anchors).exits
    for cable in range(HALL.cable_count):
        ends = [tuple(anchors[k, cable].tolist()) for k in (0, -1)]
        assert np.allclose(exit_point(world, cable, ends[0]), exits[0, cable], rtol=0, atol=1e-12)
        travelled = np.linalg.norm(exits[:, cable] - exits[0, cable], axis=1).max()
        bound = exit_travel(world, cable, *ends, float(np.linalg.norm(delta)))
        assert travelled <= bound + 1e-12


@pytest.mark.parametrize("rig", [GACHON, HALL])
def test_turning_edges_agree_with_coal_at_dense_poses(rig: Rig) -> None:
    rng = np.random.default_rng(11)
    shares = np.linspace(0.0, 1.0, 21)
    accepted, wrongly_refused, count = 0, 0, 0
    for trial in range(16):
        scene = random_scene(rng, rig, 1, [KINDS[trial % len(KINDS)]])
        world, oracle = build_world(rig, scene, np.eye(3), 0.01), CoalScene(scene)
        for _ in range(4):
            start = rng.uniform(rig.workspace_lower, rig.workspace_upper)
            end = np.clip(
                start + rng.normal(size=3) * 0.02, rig.workspace_lower, rig.workspace_upper
            )
            first, turn = Rotation.from_rotvec(rng.normal(size=3) * 0.2), rng.normal(size=3) * 0.1
            free = rotating_edge_free(world, start, end, first.as_matrix(), turn)
            least = min(
                oracle.pose_distance(
                    rig,
                    Pose(
                        start + s * (end - start),
                        (first * Rotation.from_rotvec(s * turn)).as_matrix(),
                    ),
                )
                for s in shares
            )
            count += 1
            if free:
                accepted += 1
                assert least >= 0.01 - 1e-6
            else:
                wrongly_refused += least > 0.0115
    assert accepted > 5
    assert wrongly_refused <= count // 20  # between samples bodies come a little nearer


def test_an_edge_without_turn_is_decided_as_a_translation() -> None:
    rng = np.random.default_rng(12)
    still = np.zeros(3)
    for trial in range(24):
        scene = random_scene(rng, GACHON, 2, [KINDS[trial % len(KINDS)]])
        world = build_world(GACHON, scene, np.eye(3), 0.01)
        for _ in range(4):
            start = rng.uniform(GACHON.workspace_lower, GACHON.workspace_upper)
            end = rng.uniform(GACHON.workspace_lower, GACHON.workspace_upper)
            as_turning = rotating_edge_free(world, start, end, np.eye(3), still)
            near_limit = abs(edge_clearance(world, start, end)[0] - 0.01) < 1e-8
            assert as_turning == edge_free(world, start, end) or near_limit


def test_a_turn_that_is_not_a_number_is_never_free() -> None:
    world = build_world(GACHON, random_scene(np.random.default_rng(0), GACHON, 0), np.eye(3), 0.0)
    home = GACHON.home.position
    assert rotating_edge_free(world, home, home, np.eye(3), np.array([0.1, 0.0, 0.0]))
    assert not rotating_edge_free(world, home, home, np.eye(3), np.array([np.nan, 0.0, 0.0]))


def test_a_platform_that_only_turns_into_an_obstacle_is_refused() -> None:
    """The corners of a turning cube come nearer than its faces at both ends of a quarter turn."""
    rng = np.random.default_rng(13)
    scene = random_scene(rng, GACHON, 1, ["sphere"])
    radius = scene.obstacles[0].shape.radius
    half = float(GACHON.half_size[0])
    beside = scene.obstacles[0].pose.position - np.array([half + radius + 0.02, 0.0, 0.0])
    position = np.clip(beside, GACHON.workspace_lower, GACHON.workspace_upper)
    if not np.array_equal(position, beside):
        pytest.fail("choose a seed whose ball is inside the workspace")
    world = build_world(GACHON, scene, np.eye(3), 0.0)
    quarter = np.array([0.0, 0.0, np.pi / 2.0])
    assert not rotating_edge_free(world, position, position, np.eye(3), quarter)
