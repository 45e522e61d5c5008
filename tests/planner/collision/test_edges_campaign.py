"""Random edges, a part of them grazing, in scenes of all shapes."""

from __future__ import annotations

import numpy as np
import pytest

from model.pose import Array, Pose
from planner.collision.edges import edge_free
from planner.collision.world import build_world
from planner.kernels.scene_arrays import World
from tests.configs import GACHON
from tests.effort import cases
from tests.planner.collision.sampled_oracle import CoalScene, random_scene

CLEARANCE = 0.01
SCENES, EDGES, GRAZING = cases(125), 140, 20
POSES, POSES_GRAZING = 2, 5
"""Poses checked along an edge; a grazing one touches somewhere, any other seldom comes near."""
COAL = 1e-7
"""How far coal's own distances are trusted, [m]; those of cylinders are off by up to 1e-8."""


def grazing(world: World, free_edge: tuple[Array, Array], other: Array) -> tuple[Array, Array]:
    """The free edge with its end drawn toward a point until it is barely free."""
    start, end = free_edge
    low, high = 0.0, 1.0
    for _ in range(45):
        middle = (low + high) / 2.0
        if edge_free(world, start, end + middle * (other - end)):
            low = middle
        else:
            high = middle
    return start, end + low * (other - end)


@pytest.mark.slow
def test_no_accepted_edge_violates_its_clearance_anywhere() -> None:
    rng = np.random.default_rng(2026)
    accepted = 0
    for _ in range(SCENES):
        scene = random_scene(rng, GACHON, int(rng.integers(1, 4)))
        world, oracle = build_world(GACHON, scene, np.eye(3), CLEARANCE), CoalScene(scene)
        low, high = GACHON.workspace_lower, GACHON.workspace_upper
        starts = rng.uniform(low, high, (EDGES, 3))
        reach = rng.choice([0.02, 0.1, 0.5], (EDGES, 1))
        ends = np.clip(starts + reach * rng.normal(size=(EDGES, 3)), low, high)
        pairs = zip(starts, ends, strict=True)
        free = np.array([edge_free(world, *edge) for edge in pairs])
        edges = list(zip(starts[free], ends[free], strict=True))
        blocked = ends[~free]
        looked_at = [(edge, rng.uniform(size=POSES)) for edge in edges]
        if edges and len(blocked):
            for k in range(GRAZING):
                touching = grazing(world, edges[k % len(edges)], blocked[k % len(blocked)])
                looked_at.append((touching, np.linspace(0.0, 1.0, POSES_GRAZING)))
        accepted += len(looked_at)
        for (start, end), shares in looked_at:
            for share in shares:
                pose = Pose.level(start + share * (end - start))
                assert oracle.pose_distance(GACHON, pose) >= CLEARANCE - COAL
    assert accepted > 16 * SCENES
