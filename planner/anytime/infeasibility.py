"""A proof that no path exists: cells of the workspace that are forbidden as a whole.

Under translation, the positions at which a cable, or the platform, is too near to one convex piece
form a convex set: a shadow, or a Minkowski sum. A cell with all corners in one such set lies in it.
What a flood fill from the start does not reach through the other cells, not even across their edges
and corners, cannot be reached at all.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model.clearance import PLATFORM, cable_name
from model.errors import NoSolution
from model.rig import Rig
from model.scene import Scene
from planner.anytime.problem import PathProblem
from planner.anytime.state import BEST, ROUNDS, AnytimeSearch
from planner.collision.edges import edge_clearance, row_of
from planner.collision.swept_pair import cable_apart, platform_apart
from planner.edge_checks import REASONS, edge_problem
from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, plus
from planner.kernels.scene_arrays import MESH, World, arm, outlet
from planner.settings import OptimalSettings

Array = NDArray[np.float64]
Masks = NDArray[np.uint64]

FINENESSES: Final = (8, 16, 32)
"""Cells along each axis, coarse to fine; finer grids would take longer than a search."""
_WORD = 64


def is_separated(world: World, start: Array, goal: Array) -> bool:
    """Whether it is proved that no path joins two free positions, shape (3,), [m].

    The proof uses obstacle clearance and workspace only; False proves nothing.
    """
    pairs = len(world.spans) * len(world.bodies)
    words = (pairs + _WORD - 1) // _WORD
    return words > 0 and any(
        not flood_reaches(world, np.stack([start, goal]), cells, words) for cells in FINENESSES
    )


@kernel
def flood_reaches(world: World, ends: Array, cells: int, words: int) -> bool:
    """Whether a flood fill from the first of two positions, (2, 3), [m], reaches the second.

    Args:
        cells: Along each axis.
        words: Number of 64-bit words, one bit for each pair of body and piece.
    """
    corners = cells + 1
    masks = np.zeros((corners * corners * corners, words), dtype=np.uint64)
    known = np.zeros(corners * corners * corners, dtype=np.bool_)
    seen = np.zeros(cells * cells * cells, dtype=np.bool_)
    waiting = np.empty(cells * cells * cells, dtype=np.int64)
    first, target = _cell(world, row_of(ends[0]), cells), _cell(world, row_of(ends[1]), cells)
    waiting[0], count, seen[first] = first, 1, True
    while count > 0:
        count -= 1
        cell = waiting[count]
        if cell == target:
            return True
        x, y, z = cell // (cells * cells), cell // cells % cells, cell % cells
        for i in range(max(x - 1, 0), min(x + 2, cells)):
            for j in range(max(y - 1, 0), min(y + 2, cells)):
                for k in range(max(z - 1, 0), min(z + 2, cells)):
                    other = (i * cells + j) * cells + k
                    if seen[other]:
                        continue
                    seen[other] = True
                    if other == target or not _forbidden(world, masks, known, i, j, k, cells):
                        waiting[count] = other
                        count += 1
    return False


@kernel
def _cell(world: World, at: Vector, cells: int) -> int:
    number = 0
    for axis in range(3):
        low, high = world.limits[0, axis], world.limits[1, axis]
        share = (at[axis] - low) / (high - low) if high > low else 0.0
        number = number * cells + min(max(int(share * cells), 0), cells - 1)
    return number


@kernel
def _forbidden(
    world: World, masks: Masks, known: NDArray[np.bool_], i: int, j: int, k: int, cells: int
) -> bool:
    """Whether one pair is too near at all corners of a cell."""
    corners = cells + 1
    for corner in range(8):
        a, b, c = i + (corner & 1), j + ((corner >> 1) & 1), k + ((corner >> 2) & 1)
        number = (a * corners + b) * corners + c
        if not known[number]:
            known[number] = True
            _mark(world, masks[number], (a / cells, b / cells, c / cells))
    for word in range(masks.shape[1]):
        shared = masks[(i * corners + j) * corners + k, word]
        for corner in range(1, 8):
            a, b, c = i + (corner & 1), j + ((corner >> 1) & 1), k + ((corner >> 2) & 1)
            shared &= masks[(a * corners + b) * corners + c, word]
        if shared != np.uint64(0):
            return True
    return False


@kernel
def _mark(world: World, mask: Masks, shares: Vector) -> None:
    """Sets the bits of the pairs that are too near at a position of the workspace."""
    low, high = world.limits[0], world.limits[1]
    at = (
        low[0] + shares[0] * (high[0] - low[0]),
        low[1] + shares[1] * (high[1] - low[1]),
        low[2] + shares[2] * (high[2] - low[2]),
    )
    bodies = len(world.bodies)
    for piece in range(len(world.spans)):
        if world.spans[piece, 0] == MESH:
            continue
        for body in range(bodies):
            needed = world.bodies[body, 0]
            if body == bodies - 1:
                near = not platform_apart(world, piece, at, at, needed)
            elif world.pulley > 0.0:  # with a moving exit point the shadow is not convex
                near = False
            else:
                anchor = plus(at, arm(world, body))
                near = not cable_apart(world, piece, outlet(world, body), anchor, anchor, needed)
            if near:
                pair = piece * bodies + body
                mask[pair // _WORD] |= np.uint64(1) << np.uint64(pair % _WORD)


# The error text where no path was found: none exists, or none was found in the time given.


_TRIED = 300


def no_path(
    rig: Rig, scene: Scene, problem: PathProblem, search: AnytimeSearch, settings: OptimalSettings
) -> NoSolution:
    """The error for a search that ended without a path.

    Args:
        scene: Obstacles, start and goal.
        settings: Objective, seed and budget.
    """
    values: dict[str, float | str] = {
        "rounds": float(search.totals[ROUNDS]),
        "seed": float(settings.seed),
    }
    where = f"scene {scene.name}"
    if search.costs[BEST] < np.inf:
        found = search.points[BEST, : search.counts[BEST, 0]]
        length = float(np.linalg.norm(np.diff(found, axis=0), axis=1).sum())
        straight = float(np.linalg.norm(search.ends[1] - search.ends[0]))
        return settings.too_long(where, length, straight, values)
    gap = float(search.trees.gap[0])
    values["best_distance_mm"] = gap * 1e3
    if is_separated(problem.world, search.ends[0], search.ends[1]):
        return NoSolution(
            "there is no path without rotation: the obstacles separate start and goal",
            where=where,
            why=f"proved by workspace cells that a cable or the platform excludes as a whole, at"
            f" {scene.obstacle_clearance * 1e3:g} mm clearance and 0.05 mm reserve;"
            f" {_blocking_pairs(rig, scene, problem, search)}",
            next_step=f"{_rotate(scene)}, reduce the clearance, or move the goal or an obstacle",
            values={**values, "proved": "yes"},
        )
    return NoSolution(
        settings.not_found(int(search.totals[ROUNDS]), gap),
        where=where,
        why=f"it is not proved that no path exists; {_blocking_pairs(rig, scene, problem, search)}",
        next_step=f"{settings.longer}, reduce the clearance, try another seed, or move the"
        " goal or an obstacle",
        values=values,
    )


def _rotate(scene: Scene) -> str:
    """The remedy that the proof, at the orientation of the start, leaves open."""
    limits = "" if scene.rotation_limits else "add rotation_limits to the scene and "
    return f"{limits}plan with `free_rotation=True`"


def _blocking_pairs(rig: Rig, scene: Scene, problem: PathProblem, search: AnytimeSearch) -> str:
    """The limits and pairs that most often forbid edges from start and goal, from trials."""
    random = np.random.default_rng(0)
    low, high = problem.world.limits
    reasons: Counter[str] = Counter()
    pairs: Counter[str] = Counter()
    for k in range(_TRIED):
        start, end = search.ends[k % 2], random.uniform(low, high)
        args = (problem.world, problem.robot, problem.load, problem.holding)
        reason = REASONS[edge_problem(*args, start, end)]
        reasons[reason] += 1
        if reason == "obstacle clearance":
            _, body, obstacle = edge_clearance(problem.world, start, end)
            name = PLATFORM if body == rig.cable_count else cable_name(body)
            pairs[f"{name} – {scene.obstacles[obstacle].name}"] += 1
    del reasons[""]
    if not reasons:
        return "no edge from start or goal was refused"
    listed = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
    text = f"of {_TRIED} edges tried from start and goal were refused for: {listed}"
    if pairs:
        named = ", ".join(f"{pair} ({count})" for pair, count in pairs.most_common(3))
        text += f"; most often blocking: {named}"
    return text
