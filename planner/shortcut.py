"""Beyond Algorithm 3: the cheapest way through points of a path, and its corners drawn tight.

Everything that edges keep is kept, and no step makes a path dearer.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from model.pose import Array
from planner.costs import Cost

IsFree = Callable[[Array, Array], bool]


def cheapest_through(path: Array, is_free: IsFree, cost: Cost, spacing: float) -> Array:
    """The cheapest way from start to end through points spread over a path.

    Unlike Algorithm 3 it does not jump as far as it can but as well as it can (a shortest-path
    search over all pairs of points).

    Args:
        path: Free from node to node, shape (k, n).
        is_free: Whether an edge is allowed.
        cost: Of edges.
        spacing: Distance of the points spread over the edges, [m].
    """
    points = _spread(path, spacing)
    best = np.append(0.0, np.full(len(points) - 1, np.inf))
    parent = np.zeros(len(points), dtype=np.int64)
    for j in range(1, len(points)):
        totals = best[:j] + cost.edges(points[:j], points[j])
        for i in np.argsort(totals, kind="stable").tolist():
            if i == j - 1 or is_free(points[i], points[j]):
                best[j], parent[j] = totals[i], i
                break
    way = [len(points) - 1]
    while way[-1] != 0:
        way.append(int(parent[way[-1]]))
    return points[way[::-1]]


def drawn_tight(
    path: Array, is_free: IsFree, cost: Cost, steps: tuple[float, ...] = (0.02, 0.01, 0.005, 0.002)
) -> Array:
    """Moves corners, one coordinate direction at a time, while the path gets cheaper.

    Args:
        path: Free from node to node, shape (k, n).
        is_free: Whether an edge is allowed.
        cost: Of edges.
        steps: Sizes of the moves tried, largest first, [m].
    """
    tight = path.copy()
    for step in steps:
        for _ in range(10):
            moved = [_move_corner(tight, k, step, is_free, cost) for k in range(1, len(tight) - 1)]
            if not any(moved):
                break
    return tight


def _move_corner(path: Array, k: int, step: float, is_free: IsFree, cost: Cost) -> bool:
    """Tries moves of one corner in place: along its bisector and along the axes."""
    before, corner, after = path[k - 1], path[k].copy(), path[k + 1]
    now = cost.edge(before, corner) + cost.edge(corner, after)
    inward = (before + after) / 2.0 - corner
    size = float(np.linalg.norm(inward))
    ways = np.concatenate([np.eye(len(corner)), -np.eye(len(corner))])
    if size > 0.0:
        ways = np.concatenate([inward[None, :] / size, ways])
    tried = corner + step * ways
    totals = cost.edges(tried, before) + cost.edges(tried, after)
    for i in np.argsort(totals, kind="stable").tolist():
        if totals[i] >= now * (1.0 - 1e-6):
            return False
        if is_free(before, tried[i]) and is_free(tried[i], after):
            path[k] = tried[i]
            return True
    return False


def _spread(path: Array, spacing: float) -> Array:
    points = [path[:1]]
    for start, end in pairwise(path):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing)))
        shares = np.arange(1, count) / count
        points += [start + shares[:, None] * (end - start), end[None, :]]
    return np.concatenate(points)
