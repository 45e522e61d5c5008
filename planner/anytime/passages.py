"""A first path through narrow passages: a roadmap whose components begin in the gaps themselves.

Samples of the whole workspace miss a gap of a thousandth of its volume. Under translation, though,
every obstacle keeps a body behind planes (`planner.collision.separating_planes`). A point too near
to something is therefore projected onto one of its planes, then onto one of whatever is too near
there, until it is free: it then lies at the side of a gap, if there is one nearby. From there,
straight segments along the planes it touches lead out at both mouths. Each sample starts a
component of the roadmap; straight edges join neighbouring components until start and goal are in
one. The two trees of `planner.anytime.connect` belong to the components of start and goal.

Nearly all functions are inlined: passing a problem takes as long as several edge tests.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.anytime.connect import Trees
from planner.anytime.problem import PathProblem, edge_allowed
from planner.collision.edges import row_of
from planner.kernels.jit import inlined, leaf
from planner.kernels.primitives import (
    RandomState,
    Vector,
    along,
    below,
    cross,
    direction,
    dot,
    minus,
    norm,
    uniform,
)
from planner.kernels.scene_arrays import World

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

ROADMAP_NODES = 1024
"""Room for nodes; a full roadmap is restarted."""
_IN_GAPS, _NEAR_NODES = 0.8, 0.15
"""Shares of the samples: in gaps, and near a node; the rest are uniform in the workspace."""
_DRAWN, _OTHER_PLANE = 24, 0.3
"""Most projections of a point, and the share of them onto another plane than the nearest."""
_ROOM = 1e-7
"""Added to a projection, [m]: more than round-off, less than any gap worth finding."""
_FROM_TREES = 200
"""Most nodes of each tree with which the roadmap begins."""
_BISECTIONS = 4
_NEAREST, _FARTHEST = 5e-5, 0.2
"""Distances of samples near a node, [m]."""
_START, _GOAL = 0, 1
_ANY_OTHER = -1
"""In place of a component: any but the node's own."""

NODES_MADE, TESTS_MADE = 0, 1
"""Indices of `Roadmap.made`."""


class Roadmap(NamedTuple):
    """Nodes that straight edges join to components; kernels change it in place.

    Attributes:
        nodes: The first two are start and goal, shape (ROADMAP_NODES, 3), [m].
        above: Parent of each node, -1 for the root of a component, shape (ROADMAP_NODES,).
        parts: Component of each node, shape (ROADMAP_NODES,).
        made: Numbers of nodes and of edge tests so far, shape (2,); zeros at first.
    """

    nodes: Array
    above: Integers
    parts: Integers
    made: Integers


@leaf
def through_passages(
    problem: PathProblem,
    ends: Array,
    state: RandomState,
    roadmap: Roadmap,
    trees: Trees,
    samples: int,
    path: Array,
) -> int:
    """Adds samples to a roadmap until it joins start and goal; called again it continues.

    Args:
        ends: Start and goal, shape (2, 3), [m].
        state: Of the random numbers; stepped.
        roadmap: Extended.
        trees: Of start and goal.
        samples: Most samples to draw.
        path: From start to goal, shape (k, 3), written.

    Returns:
        The number of vertices of the path; 0 where none was found yet.
    """
    made, parts = roadmap.made, roadmap.parts
    for _ in range(samples):
        if made[NODES_MADE] == 0 or made[NODES_MADE] + 3 > len(roadmap.nodes):
            _begin(ends, roadmap)
            _add_trees(roadmap, trees)
        node, touched, other = made[NODES_MADE], -1, -1
        choice = uniform(state)
        if _IN_GAPS <= choice < _IN_GAPS + _NEAR_NODES:
            near = below(state, made[NODES_MADE])
            size = _NEAREST * math.exp(uniform(state) * math.log(_FARTHEST / _NEAREST))
            _add_segment(problem, roadmap, near, direction(state), size)
        else:
            at = _anywhere(problem.world, state)
            if choice < _IN_GAPS:
                at, touched, other = _out_of_obstacles(problem.world, state, at)
            if not _allowed(problem, roadmap, at, at):
                continue
            _add(roadmap, at, -1)
        while node < made[NODES_MADE] and parts[_START] != parts[_GOAL]:
            _join(problem, roadmap, node)
            if touched >= 0 and parts[_START] != parts[_GOAL]:
                _add_segments(problem, state, roadmap, node, touched, other)
                touched = -1
            node += 1
        if parts[_START] == parts[_GOAL]:
            count = _path(roadmap, path)
            made[NODES_MADE] = 0
            if count > 0:
                return count
    return 0


@leaf
def _begin(ends: Array, roadmap: Roadmap) -> None:
    roadmap.made[NODES_MADE] = 0
    _add(roadmap, row_of(ends[0]), -1)
    _add(roadmap, row_of(ends[1]), -1)


@leaf
def _add_trees(roadmap: Roadmap, trees: Trees) -> None:
    """Adds the nodes of both trees to the components of start and goal."""
    for tree in range(2):
        first = roadmap.made[NODES_MADE]
        for i in range(1, min(trees.counts[tree], _FROM_TREES)):
            parent = trees.parents[tree, i]  # precedes its child, so it is already added
            below_it = tree if parent == 0 else first + parent - 1
            _add(roadmap, row_of(trees.nodes[tree, i]), below_it)


@inlined
def _allowed(problem: PathProblem, roadmap: Roadmap, start: Vector, end: Vector) -> bool:
    roadmap.made[TESTS_MADE] += 1
    return edge_allowed(problem, start, end)


@leaf
def _add(roadmap: Roadmap, at: Vector, parent: int) -> None:
    """Adds a node below another, or as a component of its own."""
    nodes, parts, new = roadmap.nodes, roadmap.parts, roadmap.made[NODES_MADE]
    nodes[new, 0], nodes[new, 1], nodes[new, 2] = at
    roadmap.above[new] = parent
    parts[new] = parts[parent] if parent >= 0 else new
    roadmap.made[NODES_MADE] = new + 1


@inlined
def _anywhere(world: World, state: RandomState) -> Vector:
    low, high = world.limits[0], world.limits[1]
    return (
        low[0] + uniform(state) * (high[0] - low[0]),
        low[1] + uniform(state) * (high[1] - low[1]),
        low[2] + uniform(state) * (high[2] - low[2]),
    )


@inlined
def _out_of_obstacles(world: World, state: RandomState, at: Vector) -> tuple[Vector, int, int]:
    """A point projected out of obstacles, and the last two planes it was projected onto.

    Planes are indices of `World.planes`, -1 for none. The point may still be too near to something.
    """
    touched, other = -1, -1
    for _ in range(_DRAWN):
        plane, room = _worst(world, state, at)
        if plane < 0:
            break
        if plane != touched:
            touched, other = plane, touched
        normal = (world.planes[plane, 0], world.planes[plane, 1], world.planes[plane, 2])
        at = along(at, normal, room - _ROOM)
    low, high = world.limits[0], world.limits[1]
    at = (
        min(max(at[0], low[0]), high[0]),
        min(max(at[1], low[1]), high[1]),
        min(max(at[2], low[2]), high[2]),
    )
    return at, touched, other


@inlined
def _worst(world: World, state: RandomState, at: Vector) -> tuple[int, float]:
    """A plane of the pair with the least room at a position, and that room, [m].

    -1 where all pairs are separated.
    """
    worst, least, found = -1, 0.0, -1
    for pair in range(len(world.pairs)):
        first, last = world.pairs[pair, 2], world.pairs[pair, 3]
        best, nearest = -math.inf, -1
        for k in range(first, last):
            room = _room(world, k, at)
            if room > best:
                best, nearest = room, k
                if room >= least:
                    break
        if nearest >= 0 and best < least:
            worst, least, found = nearest, best, pair
    if worst >= 0 and uniform(state) < _OTHER_PLANE:
        first, last = world.pairs[found, 2], world.pairs[found, 3]
        worst = first + below(state, last - first)
        least = _room(world, worst, at)
    return worst, least


@inlined
def _room(world: World, k: int, at: Vector) -> float:
    normal = (world.planes[k, 0], world.planes[k, 1], world.planes[k, 2])
    return world.planes[k, 3] - dot(normal, at)  # type: ignore[no-any-return]


@inlined
def _add_segments(
    problem: PathProblem,
    state: RandomState,
    roadmap: Roadmap,
    node: int,
    touched: int,
    other: int,
) -> None:
    """Adds the ends of the straight segment through a node along the planes it touches."""
    planes = problem.world.planes
    normal = row_of(planes[touched, :3])
    second = direction(state)
    if other >= 0 and uniform(state) < 0.7:
        second = row_of(planes[other, :3])
    tangent = cross(normal, second)
    size = norm(tangent)
    if size < 1e-6:
        tangent = cross(normal, direction(state))
        size = norm(tangent)
    if size < 1e-6:
        return
    reach = norm(minus(row_of(problem.world.limits[1]), row_of(problem.world.limits[0])))
    for sign in (-1.0, 1.0):
        one = (sign * tangent[0] / size, sign * tangent[1] / size, sign * tangent[2] / size)
        _add_segment(problem, roadmap, node, one, reach)


@inlined
def _add_segment(
    problem: PathProblem, roadmap: Roadmap, node: int, heading: Vector, reach: float
) -> None:
    """Adds the farthest point allowed from a node along a unit vector, at most ``reach`` away."""
    start = row_of(roadmap.nodes[node])
    reach = min(reach, _to_the_wall(problem.world, start, heading))
    low, high, share = 0.0, 1.0, 1.0
    for _ in range(_BISECTIONS):
        if _allowed(problem, roadmap, start, along(start, heading, share * reach)):
            low = share
        else:
            high = share
        if low == 1.0:
            break
        share = (low + high) / 2.0
    if low * reach > _NEAREST:
        _add(roadmap, along(start, heading, low * reach), node)


@inlined
def _to_the_wall(world: World, start: Vector, heading: Vector) -> float:
    """Distance from a point along a unit vector to the wall of the workspace, [m]."""
    least = math.inf
    for axis in range(3):
        if heading[axis] > 0.0:
            least = min(least, (world.limits[1, axis] - start[axis]) / heading[axis])
        elif heading[axis] < 0.0:
            least = min(least, (world.limits[0, axis] - start[axis]) / heading[axis])
    return max(least, 0.0)


@inlined
def _join(problem: PathProblem, roadmap: Roadmap, node: int) -> None:
    """Joins a node to the components of start and goal, and to the nearest node of any other."""
    parts = roadmap.parts
    for k in range(3):
        part = parts[_START] if k == 0 else (parts[_GOAL] if k == 1 else _ANY_OTHER)
        if part != parts[node]:
            _try_to_join(problem, roadmap, node, part)


@inlined
def _try_to_join(problem: PathProblem, roadmap: Roadmap, node: int, part: int) -> None:
    """Tries an edge to the nearest node of a component, or of any but the node's own."""
    nodes, parts = roadmap.nodes, roadmap.parts
    own, best, least = parts[node], -1, math.inf
    x, y, z = nodes[node, 0], nodes[node, 1], nodes[node, 2]
    for i in range(roadmap.made[NODES_MADE]):
        if parts[i] == own or part not in (_ANY_OTHER, parts[i]):
            continue
        squared = (nodes[i, 0] - x) ** 2 + (nodes[i, 1] - y) ** 2 + (nodes[i, 2] - z) ** 2
        if squared < least:
            best, least = i, squared
    if best >= 0 and _allowed(problem, roadmap, row_of(nodes[best]), row_of(nodes[node])):
        _merge(roadmap.above, parts, roadmap.made, best, node)


@leaf
def _merge(above: Integers, parts: Integers, made: Integers, one: int, two: int) -> None:
    """Attaches the whole component of the second node below the first."""
    _make_root(above, two)
    above[two] = one
    old, kept = parts[two], parts[one]
    for i in range(made[NODES_MADE]):
        if parts[i] == old:
            parts[i] = kept


@leaf
def _make_root(above: Integers, node: int) -> None:
    """Reverses the path from a node to its root, making the node the root."""
    before, at = -1, node
    while at >= 0:
        after = above[at]
        above[at] = before
        before, at = at, after


@leaf
def _path(roadmap: Roadmap, path: Array) -> int:
    """Writes the path from start to goal, both in one component; 0 if it does not fit."""
    _make_root(roadmap.above, _GOAL)
    count, node = 0, _START
    while node >= 0:
        if count == len(path):
            return 0
        path[count, 0], path[count, 1], path[count, 2] = row_of(roadmap.nodes[node])
        count, node = count + 1, roadmap.above[node]
    return count
