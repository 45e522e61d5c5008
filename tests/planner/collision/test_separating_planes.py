"""Cores: what they refuse is too near, and a core is what a line from the outlet meets."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from model.pose import Array
from model.rig import load_rig
from model.scene import load_scene
from planner.collision.edges import edge_clearance
from planner.collision.separating_planes import cable_core, core_of
from planner.collision.world import build_world
from planner.kernels.scene_arrays import pieces_of
from tests.configs import CONFIGS, GACHON
from tests.planner.collision.sampled_oracle import KINDS, random_scene
from tests.planner.kernels.definitions import segment_box_definition


@pytest.mark.parametrize("kind", ["box", "rotated box", "sphere", "capsule", "cylinder"])
def test_an_anchor_is_behind_a_core_exactly_where_its_cable_meets_the_box(kind: str) -> None:
    rng = np.random.default_rng(KINDS.index(kind))
    behind = 0
    for _ in range(40):
        (piece,) = pieces_of(random_scene(rng, GACHON, 1, [kind]))
        eye, arm = GACHON.outlets[rng.integers(8)], rng.normal(size=3) * 0.05
        planes, core = cable_core(piece, eye, arm, 0.01), core_of(piece, 0.01)
        assert core is not None
        at = rng.uniform(GACHON.workspace_lower, GACHON.workspace_upper, (50, 3))
        eye_in_core, *anchors = core.pose.inverse().apply(np.vstack([eye, at + arm]))
        for position, anchor in zip(at, anchors, strict=True):
            ends = (eye_in_core, anchor)
            found = bool(np.all(planes[:, :3] @ position >= planes[:, 3]))
            if found:
                assert segment_box_definition(*ends, core.half) < 1e-9
            else:
                assert segment_box_definition(*ends, core.half - 1e-7) > 0.0
            behind += found
    assert behind > 10


@pytest.mark.parametrize("kind", KINDS)
def test_positions_behind_a_core_are_too_near_to_an_obstacle(kind: str) -> None:
    rng = np.random.default_rng(KINDS.index(kind))
    behind = 0
    for trial in range(10):
        scene = random_scene(rng, GACHON, 2, [kind])
        rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.3 * (trial % 2)).as_matrix()
        clearance = float(rng.choice([0.0, 0.01, 0.03]))
        world = build_world(GACHON, scene, rotation, clearance)
        for position in rng.uniform(*world.limits, (60, 3)):
            if any(_is_behind(world.planes, *pair[3:], position) for pair in world.pairs):
                behind += 1
                assert edge_clearance(world, position, position)[0] < clearance + 1e-12
    assert (behind > 20) == (kind in ("box", "rotated box", "sphere", "capsule", "cylinder"))


def test_no_cores_where_the_outlet_is_inside_or_exits_move() -> None:
    scene = load_scene(CONFIGS / "environment_1.yaml")
    (piece,) = pieces_of(scene)
    assert len(cable_core(piece, piece.pose.position, np.zeros(3), 0.01)) == 0
    pulleys = load_rig(CONFIGS / "hall_10_6.yaml")
    assert pulleys.pulley_radius > 0.0
    world = build_world(pulleys, scene, np.eye(3), 0.01)
    cables = world.pairs[:, 1] < pulleys.cable_count
    assert np.all(world.pairs[cables, 3] == world.pairs[cables, 4])
    assert np.all(world.pairs[~cables, 3] < world.pairs[~cables, 4])


def _is_behind(planes: Array, first: int, last: int, position: Array) -> bool:
    some = planes[first:last]
    return len(some) > 0 and bool(np.all(some[:, :3] @ position >= some[:, 3]))
