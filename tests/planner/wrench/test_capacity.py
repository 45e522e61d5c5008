"""Wrench feasibility: the compiled margin, and what is proved over regions against sampling."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.kinematics import structure_matrix
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene, load_scene
from planner.collision.world import build_world
from planner.costs import capacity_margins
from planner.kernels.scene_arrays import World
from planner.wrench.capacity import build_load, factored, margins, orthogonal_vector
from planner.wrench.feasibility_proof import tensions_prove
from planner.wrench.translation import build_holding, edge_held
from tests.configs import CONFIGS, GACHON, HALL
from tests.planner.collision.sampled_oracle import changed_rig

PAPER = load_scene(CONFIGS / "environment_1.yaml")
PILLAR = load_scene(CONFIGS / "hall_pillar.yaml")
BOTH = pytest.mark.parametrize(("rig", "scene"), [(GACHON, PAPER), (HALL, PILLAR)])


def world_of(rig: Rig, scene: Scene) -> World:
    return build_world(rig, scene, np.eye(3), 0.01)


def random_edges(rng: np.random.Generator, rig: Rig, count: int) -> tuple[Array, Array]:
    low, high = rig.workspace_lower, rig.workspace_upper
    starts = rng.uniform(low, high, (count, 3))
    return starts, np.clip(starts + rng.normal(size=(count, 3)) * 0.05 * (high - low), low, high)


def smallest_margins(rig: Rig, scene: Scene, starts: Array, ends: Array) -> Array:
    """Over samples of each edge, by the definition; shape (k,)."""
    shares = np.linspace(0.0, 1.0, 17)[None, :, None]
    points = starts[:, None, :] + shares * (ends - starts)[:, None, :]
    found = capacity_margins(rig, scene, points.reshape(-1, 3), np.eye(3))
    return found.reshape(len(starts), -1).min(axis=1)


@given(st.integers(0, 2**32 - 1), st.integers(6, 12))
def test_factors_are_the_pseudo_inverse_and_a_null_space(seed: int, cables: int) -> None:
    columns = np.random.default_rng(seed).normal(size=(cables, 6))
    inverse, basis = np.empty((cables, 6)), np.empty((cables, cables))
    assert factored(columns, inverse, basis) > 0.0
    null_space = basis[:, 6:]
    assert np.allclose(inverse, np.linalg.pinv(columns.T), rtol=1e-6, atol=1e-9)
    assert np.allclose(columns.T @ null_space, 0.0, rtol=0, atol=1e-12)
    assert np.allclose(basis.T @ basis, np.eye(cables), rtol=0, atol=1e-12)


def test_cables_that_leave_a_direction_out_have_no_factors() -> None:
    columns = np.random.default_rng(0).normal(size=(8, 6))
    columns[:, 5] = columns[:, 4]
    assert factored(columns, np.empty((8, 6)), np.empty((8, 8))) == 0.0


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_the_orthogonal_vector_is_orthogonal_and_as_long_as_the_volume(
    seed: int, size: int
) -> None:
    rows = np.random.default_rng(seed).normal(size=(max(size - 1, 1), size))
    found = np.empty(size)
    orthogonal_vector(rows.copy(), size, found)
    used = rows[: size - 1]
    assert np.allclose(used @ found, 0.0, rtol=0, atol=1e-9)
    volume = np.sqrt(np.linalg.det(used @ used.T)) if size > 1 else 1.0
    assert np.linalg.norm(found) == pytest.approx(volume, rel=1e-6)


def ring(cables: int) -> Rig:
    """High and low outlets in turn on a circle, their anchors on a smaller one."""
    angles = 2.0 * np.pi * np.arange(cables) / cables
    sense = np.where(np.arange(cables) % 2, 1.0, -1.0)

    def circle(radius: float, turned: Array, low: float, high: float) -> list[list[float]]:
        height = np.where(sense > 0.0, high, low)
        points = np.column_stack([radius * np.cos(turned), radius * np.sin(turned), height])
        return [list(point) for point in points.tolist()]

    winch = GACHON.document.winches[0].model_dump(mode="json")
    return changed_rig(
        GACHON,
        outlets_mm=circle(700.0, angles, 80.0, 860.0),
        anchors_mm=circle(65.0, angles + 0.35 * sense, -65.0, 65.0),
        winches=[winch | {"node_id": i + 1} for i in range(cables)],
    )


@pytest.mark.parametrize("cables", [9, 12, 15])
def test_margins_of_many_cables_are_those_at_every_five_columns(cables: int) -> None:
    rig, rng = ring(cables), np.random.default_rng(cables)
    load = build_load(rig, PAPER, np.eye(3))
    position = rng.uniform(rig.workspace_lower, rig.workspace_upper)
    scaled = structure_matrix(rig, Pose.level(position))
    scaled[3:] /= load.length
    five = np.array(list(combinations(range(cables), 5)))
    _, sizes, right = np.linalg.svd(np.moveaxis(scaled[:, five], 0, -1))
    normals = right[sizes[:, -1] > 1e-9, -1]  # dependent columns span no facet
    gains, middle = normals @ scaled, (load.high + load.low) / 2.0
    room = np.abs(gains).sum(axis=1) * (load.high - load.low) / 2.0
    off = np.abs(normals @ load.wrench - middle * gains.sum(axis=1))
    expected = (room - np.abs(normals) @ load.spread - off).min()
    found = margins(world_of(rig, PAPER), load, position[None, :])[0]
    assert found == pytest.approx(expected, rel=0, abs=1e-9 * load.high)
    statics = capacity_margins(rig, PAPER, position[None, :], np.eye(3))[0]
    assert statics == pytest.approx(expected, rel=0, abs=1e-9 * load.high)


def test_two_cables_in_one_line_span_no_facet() -> None:
    """As if one cable were twice as strong: the margin follows from the others."""
    rig, rng = ring(10), np.random.default_rng(5)
    (x, y, z), *others = rig.document.outlets_mm[:9]  # a rig file refuses the same cable twice
    twice = changed_rig(
        rig,
        outlets_mm=[[x, y, z], [x + 1e-9, y, z], *others],
        anchors_mm=[rig.document.anchors_mm[i] for i in [0, *range(9)]],
    )
    positions = rng.uniform(rig.workspace_lower, rig.workspace_upper, (20, 3))
    found = margins(world_of(twice, PAPER), build_load(twice, PAPER, np.eye(3)), positions)
    expected = capacity_margins(twice, PAPER, positions, np.eye(3))
    assert np.isfinite(expected).any()
    assert np.allclose(found, expected, rtol=0, atol=1e-9 * rig.max_tension)


def test_a_load_on_many_cables_lists_no_facets() -> None:
    """Of 20 cables there are 15 504, with 15 cables each."""
    assert build_load(ring(20), PAPER, np.eye(3)).facets.size == 0


@BOTH
def test_compiled_margins_are_those_of_the_statics(rig: Rig, scene: Scene) -> None:
    rng = np.random.default_rng(1)
    positions = rng.uniform(rig.workspace_lower, rig.workspace_upper, (60, 3))
    found = margins(world_of(rig, scene), build_load(rig, scene, np.eye(3)), positions)
    expected = capacity_margins(rig, scene, positions, np.eye(3))
    assert np.allclose(found, expected, rtol=0, atol=1e-9 * rig.max_tension)


@pytest.mark.parametrize(
    ("rig", "scene", "reserve"),
    [(GACHON, PAPER, 0.2), (GACHON, PAPER, 8.0), (GACHON, PAPER, 15.0), (HALL, PILLAR, 60.0)],
)
def test_held_edges_keep_the_reserve_at_every_sample(
    rig: Rig, scene: Scene, reserve: float
) -> None:
    world, load = world_of(rig, scene), build_load(rig, scene, np.eye(3))
    holding = build_holding(world, load, reserve)
    starts, ends = random_edges(np.random.default_rng(2), rig, 80)
    edges = zip(starts, ends, strict=True)
    held = np.array([edge_held(world, load, holding, *edge) for edge in edges])
    least = smallest_margins(rig, scene, starts, ends)
    assert np.all(least[held] >= reserve - 1e-9)
    # A refused edge is short of the reserve somewhere, or only slightly above it.
    assert np.all(least[~held] <= reserve * 1.02 + 0.1)
    if reserve < 1.0:
        assert held.all()


def test_proved_cells_keep_the_reserve_and_change_no_answer() -> None:
    world, load = world_of(GACHON, PAPER), build_load(GACHON, PAPER, np.eye(3))
    holding = build_holding(world, load, 4.0)
    assert 0.05 < holding.cells.mean() < 1.0
    rng = np.random.default_rng(3)
    chosen = np.argwhere(holding.cells)
    chosen = chosen[rng.integers(0, len(chosen), 300)]
    size = (GACHON.workspace_upper - GACHON.workspace_lower) / holding.cells.shape
    inside = GACHON.workspace_lower + (chosen + rng.uniform(size=chosen.shape)) * size
    assert capacity_margins(GACHON, PAPER, inside, np.eye(3)).min() >= 4.0
    bare = holding._replace(cells=np.zeros_like(holding.cells), everywhere=False)
    starts, ends = random_edges(rng, GACHON, 60)
    for edge in zip(starts, ends, strict=True):
        with_cells = edge_held(world, load, holding, *edge)
        assert with_cells == edge_held(world, load, bare, *edge)


@BOTH
def test_a_box_proved_by_tensions_keeps_the_reserve_all_over(rig: Rig, scene: Scene) -> None:
    world, load = world_of(rig, scene), build_load(rig, scene, np.eye(3))
    rng = np.random.default_rng(4)
    proved = 0
    for _ in range(60):
        middle = rng.uniform(rig.workspace_lower, rig.workspace_upper)
        half = rng.uniform(0.001, 0.01, 3)
        margin = float(capacity_margins(rig, scene, middle[None, :], np.eye(3))[0])
        reserve = rng.uniform(0.0, 0.4 * margin)
        radius = float(np.linalg.norm(half))
        args = (tuple(middle.tolist()), np.diag(half), radius)
        if tensions_prove(world, load, reserve, *args):
            proved += 1
            corners = middle + rng.uniform(-1.0, 1.0, (200, 3)).round(0) * half
            assert capacity_margins(rig, scene, corners, np.eye(3)).min() >= reserve
    assert proved > 5


def test_too_weak_cables_hold_nothing() -> None:
    cables = GACHON.document.cables.model_copy(update={"min_tension_n": 0.01, "max_tension_n": 0.4})
    weak = changed_rig(GACHON, cables=cables)
    world, load = world_of(weak, PAPER), build_load(weak, PAPER, np.eye(3))
    holding = build_holding(world, load, 0.0)
    home = GACHON.home.position
    assert not holding.cells.any()
    assert not edge_held(world, load, holding, home, home)
