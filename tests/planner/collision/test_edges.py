"""Translations: what is accepted keeps its clearance, what keeps it is accepted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from model.errors import BadInput
from model.kinematics import cables_at
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import load_scene
from planner.collision.edges import edge_clearance, edge_free
from planner.collision.world import build_world
from tests.configs import CONFIGS, GACHON, HALL
from tests.planner.collision.sampled_oracle import KINDS, CoalScene, changed_rig, random_scene

COAL = 1e-6
"""How far coal's own distances are trusted, [m]."""


def random_edge(rng: np.random.Generator, rig: Rig, reach: float) -> tuple[Array, Array]:
    start = rng.uniform(rig.workspace_lower, rig.workspace_upper)
    direction = rng.normal(size=3)
    end = start + reach * direction / np.linalg.norm(direction)
    return start, np.clip(end, rig.workspace_lower, rig.workspace_upper)


def swept_distance(rig: Rig, oracle: CoalScene, start: Pose, end: Pose) -> float:
    """By hulls of what is swept, which is exact for point exits."""
    before, after = cables_at(rig, start), cables_at(rig, end)
    corners = np.concatenate([p.apply(rig.platform_corners) for p in (start, end)])
    found = [oracle.points_distance(corners)]
    for exit, b, c in zip(before.exits, before.anchors, after.anchors, strict=True):
        found.append(oracle.points_distance(np.array([exit, b, c])) - rig.cable_radius)
    return min(found)


@pytest.mark.parametrize("kind", KINDS)
def test_clearance_along_an_edge_agrees_with_coal_on_the_swept_hulls(kind: str) -> None:
    rng = np.random.default_rng(KINDS.index(kind))
    for trial in range(12):
        scene = random_scene(rng, GACHON, 2, [kind])
        rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.3 * (trial % 2)).as_matrix()
        world, oracle = build_world(GACHON, scene, rotation, 0.01), CoalScene(scene)
        for _ in range(6):
            start, end = random_edge(rng, GACHON, float(rng.choice([0.0, 0.04, 0.4])))
            found, body, owner = edge_clearance(world, start, end)
            expected = swept_distance(GACHON, oracle, Pose(start, rotation), Pose(end, rotation))
            assert max(found, 0.0) == pytest.approx(expected, rel=0, abs=COAL)
            assert 0 <= body <= GACHON.cable_count
            assert 0 <= owner < 2
            free = edge_free(world, start, end)
            assert free == (found >= 0.01) or abs(found - 0.01) < 1e-9


def test_accepted_edges_keep_their_clearance_at_every_sampled_pose() -> None:
    rng = np.random.default_rng(5)
    accepted = 0
    for _ in range(12):
        scene = random_scene(rng, GACHON, int(rng.integers(1, 5)))
        world, oracle = build_world(GACHON, scene, np.eye(3), 0.01), CoalScene(scene)
        for _ in range(12):
            start, end = random_edge(rng, GACHON, 0.15)
            if not edge_free(world, start, end):
                continue
            accepted += 1
            for share in np.linspace(0.0, 1.0, 6):
                pose = Pose.level(start + share * (end - start))
                assert oracle.pose_distance(GACHON, pose) >= 0.01 - COAL
    assert accepted > 20


def test_grazing_edges_are_decided_to_a_nanometre_whatever_the_shape() -> None:
    rng = np.random.default_rng(6)
    decided = 0
    for trial in range(40):
        scene = random_scene(rng, GACHON, 1, [KINDS[trial % len(KINDS)]])
        start, end = random_edge(rng, GACHON, 0.1)
        plain = build_world(GACHON, scene, np.eye(3), 0.0)
        clearance = edge_clearance(plain, start, end)[0]
        if not 1e-6 < clearance < 0.2:
            continue
        decided += 1
        for shift in (1e-9, 1e-6):
            keeps = build_world(GACHON, scene, np.eye(3), clearance - shift)
            misses = build_world(GACHON, scene, np.eye(3), clearance + shift)
            assert edge_free(keeps, start, end)
            assert not edge_free(misses, start, end)
    assert decided > 10


def test_cable_radius_is_taken_off_cables_but_not_off_the_platform() -> None:
    cables = GACHON.document.cables.model_copy(update={"radius_mm": 3.0})
    thick = changed_rig(GACHON, cables=cables)
    rng = np.random.default_rng(7)
    seen = set()
    for _ in range(30):
        scene = random_scene(rng, GACHON, 1, ["sphere"])
        start, end = random_edge(rng, GACHON, 0.1)
        thin_world = build_world(GACHON, scene, np.eye(3), 0.0)
        thick_world = build_world(thick, scene, np.eye(3), 0.0)
        thin, body, _ = edge_clearance(thin_world, start, end)
        found, thick_body, _ = edge_clearance(thick_world, start, end)
        if body == thick_body and thin > 0.0:
            lost = 0.0 if body == GACHON.cable_count else 0.003
            assert found == pytest.approx(thin - lost, rel=0, abs=1e-12)
            seen.add(lost)
    assert seen == {0.0, 0.003}


def test_reference_clearances_of_the_paper_scene() -> None:
    scene = load_scene(CONFIGS / "environment_3.yaml")
    world = build_world(GACHON, scene, np.eye(3), 0.01)
    at_start, body, owner = edge_clearance(world, scene.start.position, scene.start.position)
    assert at_start == pytest.approx(0.0322, abs=5e-5)
    assert (body, scene.obstacles[owner].name) == (6, "obstacle_1")
    at_goal = edge_clearance(world, scene.goal.position, scene.goal.position)[0]
    assert at_goal == pytest.approx(0.0453, abs=5e-5)
    assert not edge_free(world, scene.start.position, scene.goal.position)


def test_edges_are_as_free_backwards_as_forwards() -> None:
    scene = load_scene(CONFIGS / "environment_2.yaml")
    world = build_world(GACHON, scene, np.eye(3), 0.01)
    rng = np.random.default_rng(8)
    edges = [random_edge(rng, GACHON, 0.2) for _ in range(50)]
    forwards = [edge_free(world, start, end) for start, end in edges]
    assert forwards == [edge_free(world, end, start) for start, end in edges]


def test_positions_outside_the_workspace_or_not_numbers_are_never_free() -> None:
    scene = random_scene(np.random.default_rng(0), GACHON, 0)
    world = build_world(GACHON, scene, np.eye(3), 0.01)
    home, outside = GACHON.home.position, GACHON.workspace_upper + np.array([0.0, 0.0, 1e-6])
    assert edge_free(world, home, GACHON.workspace_upper)
    assert edge_clearance(world, home, home)[0] == np.inf
    assert not edge_free(world, home, outside)
    assert not edge_free(world, np.array([np.nan, 0.0, 0.445]), home)
    assert not edge_free(world, home, np.array([0.0, np.inf, 0.445]))


def test_a_negative_clearance_is_refused() -> None:
    scene = random_scene(np.random.default_rng(0), GACHON, 1)
    with pytest.raises(BadInput, match="clearance"):
        build_world(GACHON, scene, np.eye(3), -0.001)


def test_over_pulleys_the_clearance_agrees_with_coal_on_dense_poses() -> None:
    rng = np.random.default_rng(9)
    decided = 0
    for trial in range(10):
        scene = random_scene(rng, HALL, 2, [KINDS[trial % len(KINDS)]])
        world, oracle = build_world(HALL, scene, np.eye(3), 0.02), CoalScene(scene)
        start, end = random_edge(rng, HALL, 0.1)
        found = edge_clearance(world, start, end)[0]
        shares = np.linspace(0.0, 1.0, 41)
        sampled = min(
            oracle.pose_distance(HALL, Pose.level(start + s * (end - start))) for s in shares
        )
        # Between samples 2.5 mm apart a body comes nearer by half of that at most.
        if found > 0.0:
            decided += 1
            assert sampled - 1.25e-3 - COAL <= found <= sampled + COAL
        free = edge_free(world, start, end)
        assert free == (found >= 0.02) or abs(found - 0.02) < 1e-8
    assert decided >= 4
