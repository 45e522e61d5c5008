"""Self clearance: the proof over the workspace and along edges against dense sampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.clearance import SelfModel
from model.distances import segment_pair_points
from model.errors import BadInput
from model.kinematics import cables_to
from model.pose import Array
from model.rig import Rig
from planner.collision.world import (
    build_robot,
    build_world,
    self_edge_free,
    self_rotating_edge_free,
)
from planner.kernels.primitives import segment_pair_squared
from tests.configs import GACHON, HALL
from tests.planner.collision.sampled_oracle import changed_rig, random_scene

EMPTY = random_scene(np.random.default_rng(0), GACHON, 0)


def thick(rig: Rig) -> Rig:
    cables = rig.document.cables.model_copy(update={"radius_mm": 1.5})
    return changed_rig(rig, cables=cables)


def shared_anchors(rig: Rig) -> Rig:
    """Pairs of cables meet in one point of the platform, so that stubs are left out."""
    anchors = [[round(v / 65.0) * 65.0 for v in a] for a in rig.document.anchors_mm]
    for i in range(0, len(anchors), 2):
        anchors[i + 1] = anchors[i]
    return changed_rig(rig, anchors_mm=anchors)


def gaps(rig: Rig, positions: Array, rotations: Array) -> Array:
    """Smallest self clearance at each pose, shape (k,)."""
    model = SelfModel(rig)
    anchors = np.einsum("kij,mj->kmi", rotations, rig.anchors) + positions[:, None, :]
    cables = cables_to(rig, anchors)
    between = model.cable_pairs(cables).distances.min(axis=-1)
    return np.minimum(
        between, model.to_platform(cables, positions, rotations).distances.min(axis=-1)
    )


def level(count: int) -> Array:
    return np.broadcast_to(np.eye(3), (count, 3, 3))


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_segment_pairs_agree_with_their_definition(seed: int, coarse: bool) -> None:
    ends = np.random.default_rng(seed).uniform(-1, 1, (4, 3))
    ends = np.round(2 * ends) / 2 if coarse else ends
    found = segment_pair_squared(*(tuple(e.tolist()) for e in ends)) ** 0.5
    assert found == pytest.approx(
        float(np.linalg.norm(np.subtract(*segment_pair_points(*ends)))), rel=0, abs=1e-12
    )


def test_the_paper_rig_is_proved_over_its_whole_workspace() -> None:
    world = build_world(GACHON, EMPTY, np.eye(3), 0.01)
    robot = build_robot(GACHON, world, 0.0091)
    assert len(robot.open_pairs) == 0
    assert len(robot.open_cables) == 0
    home = GACHON.home.position
    assert self_edge_free(world, robot, home, GACHON.workspace_upper)


@pytest.mark.parametrize("rig", [GACHON, HALL, thick(GACHON), shared_anchors(GACHON)])
@pytest.mark.parametrize("share", [0.9, 1.1, 1.6])
def test_edges_are_decided_as_dense_sampling_decides_them(rig: Rig, share: float) -> None:
    rng = np.random.default_rng(3)
    low, high = rig.workspace_lower, rig.workspace_upper
    somewhere = rng.uniform(low, high, (2000, 3))
    clearance = share * max(float(gaps(rig, somewhere, level(2000)).min()), 0.002)
    world = build_world(rig, EMPTY, np.eye(3), 0.01)
    robot = build_robot(rig, world, clearance)
    starts = rng.uniform(low, high, (60, 3))
    ends = np.clip(starts + rng.normal(size=(60, 3)) * 0.1 * (high - low), low, high)
    edges = list(zip(starts, ends, strict=True))
    free = [self_edge_free(world, robot, *edge) for edge in edges]
    for (start, end), allowed in zip(edges, free, strict=True):
        positions = start + np.linspace(0.0, 1.0, 41)[:, None] * (end - start)
        least = float(gaps(rig, positions, level(41)).min())
        spacing = float(np.linalg.norm(end - start)) / 40.0
        if allowed:
            assert least >= clearance - 1e-9
        else:
            assert least <= clearance + spacing
    if share < 1.0:
        assert all(free)


@pytest.mark.parametrize("rig", [GACHON, HALL])
def test_turning_edges_keep_the_self_clearance_they_are_accepted_with(rig: Rig) -> None:
    rng = np.random.default_rng(4)
    world = build_world(rig, EMPTY, np.eye(3), 0.01)
    robot = build_robot(rig, world, 0.012)
    low, high = rig.workspace_lower, rig.workspace_upper
    shares = np.linspace(0.0, 1.0, 41)
    answers = []
    for _ in range(60):
        start = rng.uniform(low, high)
        end = np.clip(start + rng.normal(size=3) * 0.05, low, high)
        first = Rotation.from_rotvec(rng.normal(size=3) * 0.05)
        turn = rng.normal(size=3) * 0.1
        allowed = self_rotating_edge_free(world, robot, start, end, first.as_matrix(), turn)
        turns = (first * Rotation.from_rotvec(shares[:, None] * turn)).as_matrix()
        least = float(gaps(rig, start + shares[:, None] * (end - start), turns).min())
        answers.append(allowed)
        if allowed:
            assert least >= 0.012 - 1e-9
        else:
            assert least <= 0.012 + 0.01
    assert any(answers)
    assert not all(answers)


def test_cables_that_cross_are_never_free() -> None:
    outlets = [list(o) for o in GACHON.document.outlets_mm]
    outlets[0], outlets[1] = outlets[1], outlets[0]
    crossed = changed_rig(GACHON, outlets_mm=outlets)
    world = build_world(crossed, EMPTY, np.eye(3), 0.01)
    robot = build_robot(crossed, world, 0.005)
    assert len(robot.open_pairs) + len(robot.open_cables) > 0
    home = crossed.home.position
    least = gaps(crossed, home[None, :], level(1))[0]
    assert self_edge_free(world, robot, home, home) == (least >= 0.005)


def test_a_negative_self_clearance_is_refused() -> None:
    world = build_world(GACHON, EMPTY, np.eye(3), 0.01)
    with pytest.raises(BadInput, match="self clearance"):
        build_robot(GACHON, world, float("nan"))
