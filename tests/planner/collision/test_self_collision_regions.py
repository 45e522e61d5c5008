"""Edges check what is open in the cells they pass, no less and hardly more."""

from __future__ import annotations

from itertools import product

import numpy as np

from model.pose import Array
from model.scene import load_scene
from planner.collision.self_collision_regions import CELLS, open_along
from planner.collision.world import build_robot, build_world, self_edge_free
from tests.configs import CONFIGS, GACHON

LIMITS = np.array([[-0.2, -0.3, 0.1], [0.3, 0.3, 0.6]])


def passed(start: Array, end: Array, grown: float) -> list[tuple[int, ...]]:
    """Cells, grown on all sides, that a move meets, by its shares within their slabs."""
    size = (LIMITS[1] - LIMITS[0]) / CELLS
    numbers = np.array(list(product(range(CELLS), repeat=3)))
    low = LIMITS[0] + numbers * size - grown
    with np.errstate(divide="ignore", invalid="ignore"):
        both = [(side - start) / (end - start) for side in (low, low + size + 2 * grown)]
        shares = np.sort(both, axis=0)
    still = start == end
    inside = (low <= start) & (start <= low + size + 2 * grown)
    enter = np.where(still, np.where(inside, 0.0, np.inf), shares[0]).max(axis=1)
    leave = np.where(still, np.where(inside, 1.0, -np.inf), shares[1]).min(axis=1)
    return [tuple(n) for n in numbers[np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)]]


def test_a_move_meets_the_cells_of_its_slabs() -> None:
    rng = np.random.default_rng(0)
    for trial in range(20):
        start, end = rng.uniform(*LIMITS, (2, 3))
        still = rng.random(3) < 0.2
        end[still] = start[still]
        if trial % 5 == 0:  # along borders of cells, and to the walls
            share = rng.integers(CELLS + 1) / CELLS
            start[0] = LIMITS[0, 0] + (LIMITS[1, 0] - LIMITS[0, 0]) * share
            end[1] = LIMITS[trial % 2, 1]
        certain, possible = passed(start, end, -1e-9), set(passed(start, end, 1e-9))
        masks = np.zeros((CELLS, CELLS, CELLS, 2), dtype=np.uint64)
        for bit, cell in enumerate(certain[:: max(1, len(certain) // 60)]):
            masks[cell][1] = np.uint64(1 << (bit % 64))
        wanted = int(np.bitwise_or.reduce(masks[..., 1], axis=None))
        assert int(open_along(masks, LIMITS, tuple(start), tuple(end), 1)) == wanted
        assert int(open_along(masks, LIMITS, tuple(start), tuple(end), 0)) == 0
        masks[...] = np.uint64(1)
        for cell in possible:
            masks[cell] = 0
        assert int(open_along(masks, LIMITS, tuple(start), tuple(end), 1)) == 0


def test_what_cells_leave_out_changes_no_answer() -> None:
    scene = load_scene(CONFIGS / "environment_1.yaml")
    world = build_world(GACHON, scene, np.eye(3), 0.01)
    robot = build_robot(GACHON, world, 0.014)
    everything = np.bitwise_or.reduce(robot.open_cells, axis=(0, 1, 2))
    assert everything.any()
    assert np.mean(robot.open_cells == 0) > 0.05
    asking = robot._replace(open_cells=np.broadcast_to(everything, robot.open_cells.shape).copy())
    rng = np.random.default_rng(1)
    starts = rng.uniform(*world.limits, (400, 3))
    ends = np.clip(starts + rng.normal(size=(400, 3)) * 0.05, *world.limits)
    edges = list(zip(starts, ends, strict=True))
    free = [self_edge_free(world, robot, *edge) for edge in edges]
    assert free == [self_edge_free(world, asking, *edge) for edge in edges]
    assert 0.02 < np.mean(free) < 0.98
