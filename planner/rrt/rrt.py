"""Algorithm 1 compiled: the tree grows from the start until the goal is a node of it, or longer.

It stops at the first path and never rewires children, as in the paper, or does both as RRT*.
The cost of an edge is its length, or the integral of the kinematic cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from model.rig import Rig
from model.scene import Scene
from planner.collision.self_collision_regions import Robot
from planner.costs import KinematicCost, margin_reserve
from planner.edge_checks import FREE, REASONS, ExactChecks, edge_problem
from planner.kernels.jit import kernel
from planner.kernels.scene_arrays import World
from planner.rrt.sampling import (
    Tallies,
    backward,
    failure_rate,
    focus_node,
    forward,
    goal_bias,
    near_path,
    record_outcome,
)
from planner.rrt.tree import Tree, add, move, nearest, nodes_to, squared_distance, within
from planner.wrench.capacity import LoadArrays
from planner.wrench.translation import Holding

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Costs and limits of edges.

_SAMPLING = 0.010


class CostField(NamedTuple):
    """A cost per metre over positions.

    Attributes:
        lower: First point of the lattice, shape (3,), [m].
        spacing: Between its points, shape (3,), [m].
        values: Cost per metre at its points, shape (i, j, k); empty for a constant cost of 1.
    """

    lower: Array
    spacing: Array
    values: Array


def length_field() -> CostField:
    """The cost that is the length."""
    return CostField(np.zeros(3), np.ones(3), np.zeros((0, 0, 0)))


def kinematic_field(cost: KinematicCost) -> CostField:
    """The cost that is the line integral of c = γ_d + γ_f."""
    lattice = cost.lattice
    values = np.ascontiguousarray(cost.values.reshape(lattice.shape))
    return CostField(np.array(lattice.lower), np.array(lattice.spacing), values)


@kernel
def edge_cost(field: CostField, start: Array, end: Array) -> float:
    """Cost of a straight edge between positions, shape (3,): trapezoids of at most 10 mm."""
    dx, dy, dz = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if field.values.size == 0:
        return length
    parts = max(1, math.ceil(length / _SAMPLING))
    total = 0.0
    for k in range(parts + 1):
        share = k / parts
        value = _at(field, start[0] + share * dx, start[1] + share * dy, start[2] + share * dz)
        total += value / 2.0 if k in (0, parts) else value
    return length * total / parts


@kernel
def _at(field: CostField, x: float, y: float, z: float) -> float:
    """The cost per metre, trilinear between lattice points and constant outside."""
    values = field.values
    i, u = _cell(x, field.lower[0], field.spacing[0], values.shape[0])
    j, v = _cell(y, field.lower[1], field.spacing[1], values.shape[1])
    k, w = _cell(z, field.lower[2], field.spacing[2], values.shape[2])
    low = (values[i, j, k] * (1.0 - w) + values[i, j, k + 1] * w) * (1.0 - v)
    low += (values[i, j + 1, k] * (1.0 - w) + values[i, j + 1, k + 1] * w) * v
    high = (values[i + 1, j, k] * (1.0 - w) + values[i + 1, j, k + 1] * w) * (1.0 - v)
    high += (values[i + 1, j + 1, k] * (1.0 - w) + values[i + 1, j + 1, k + 1] * w) * v
    return low * (1.0 - u) + high * u  # type: ignore[no-any-return]


@kernel
def _cell(at: float, lower: float, spacing: float, points: int) -> tuple[int, float]:
    scaled = (at - lower) / spacing
    cell = min(max(math.floor(scaled), 0), points - 2)
    return cell, min(max(scaled - cell, 0.0), 1.0)


# All limits of an edge, as one argument of compiled functions.


class EdgeLimits(NamedTuple):
    """Limits of edges of one rig at one orientation in one scene; see `ExactChecks`."""

    world: World
    robot: Robot
    load: LoadArrays
    holding: Holding


def exact_checks(rig: Rig, scene: Scene, rotation: Array, reserve: float) -> ExactChecks:
    """The checks of ``scene`` with ``reserve`` [m] on top of its clearances.

    Args:
        scene: Obstacles, clearances and load.
        rotation: Constant orientation, shape (3, 3).
        reserve: [m].
    """
    return ExactChecks(
        rig,
        scene,
        rotation,
        obstacle_clearance=scene.obstacle_clearance + reserve,
        self_clearance=scene.self_clearance + reserve,
        margin_reserve=margin_reserve(rig, scene.load, turns=False),
    )


def limits_of(checks: ExactChecks) -> EdgeLimits:
    """The same checks for compiled functions."""
    return EdgeLimits(checks.world, checks.robot, checks.load, checks.holding)


@kernel
def problem(limits: EdgeLimits, start: Array, end: Array) -> int:
    """Why the straight edge between two positions, shape (3,), is refused; 0 if it is not."""
    return edge_problem(limits.world, limits.robot, limits.load, limits.holding, start, end)


# The tree.

ITERATIONS, LAST, CHECKS, REACHED, REFUSALS = range(5)
NOT_REACHED = -1
KEPT_REFUSALS = 1024

_GAIN = 1e-12
"""Least gain of a rewired edge, so that round-off rewires nothing."""


class Task(NamedTuple):
    """The task of a search; points have shape (n,)."""

    start: Array
    goal: Array
    lower: Array
    upper: Array
    limits: EdgeLimits
    field: CostField


class Rules(NamedTuple):
    """The settings of a search as numbers; see `PlannerSettings` and `AlgorithmVariant`."""

    adaptive: bool
    rate: int
    focus: int
    by_volume: bool
    full_step: bool
    spacing: float
    sight: bool
    rewire: bool
    step: float
    neighbour_radius: float
    goal_radius: float
    improving: int


class Search(NamedTuple):
    """A search that can be continued.

    Attributes:
        tree: All nodes.
        tallies: Outcomes of expansions.
        counts: By name: iterations, their limit, edges checked, the goal's node or -1, edges
            refused; shape (5,).
        reasons: Edges refused by reason (`planner.rrt.rrt`), shape (5,).
        refused: The latest of them, both ends, shape (KEPT_REFUSALS, 2, n).
        closest: Smallest distance of a node to the goal, shape (1,).
        found: Scratch space for neighbours, shape (capacity,).
    """

    tree: Tree
    tallies: Tallies
    counts: Integers
    reasons: Integers
    refused: Array
    closest: Array
    found: Integers


def new_search(tree: Tree, tallies: Tallies, goal: Array, most: int) -> Search:
    """A search that has not begun, of at most ``most`` iterations."""
    counts = np.array([0, most, 0, NOT_REACHED, 0], dtype=np.int64)
    return Search(
        tree=tree,
        tallies=tallies,
        counts=counts,
        reasons=np.zeros(len(REASONS), dtype=np.int64),
        refused=np.empty((KEPT_REFUSALS, 2, len(goal))),
        closest=np.array([float(np.linalg.norm(tree.points[0] - goal))]),
        found=np.empty(len(tree.points), dtype=np.int64),
    )


@kernel
def try_straight(search: Search, task: Task) -> None:
    """Joins the goal to the root if the straight line is allowed."""
    if _free(search, task.limits, task.start, task.goal):
        cost = edge_cost(task.field, task.start, task.goal)
        search.counts[REACHED] = add(search.tree, task.goal, 0, cost)
        search.counts[LAST] = 0
        search.closest[0] = 0.0


@kernel
def extend_tree(
    search: Search, task: Task, rules: Rules, random: Generator, iterations: int
) -> None:
    """Does further iterations, fewer if the search ends earlier."""
    counts, tree = search.counts, search.tree
    wanted = np.empty(len(task.goal))
    for _ in range(iterations):
        if counts[ITERATIONS] >= counts[LAST]:
            return
        counts[ITERATIONS] += 1
        if counts[REACHED] == NOT_REACHED:
            draw(search, task, rules, random, wanted)
        else:
            nodes = nodes_to(tree, counts[REACHED])
            path = np.empty((len(nodes), len(wanted)))
            for k in range(len(nodes)):
                path[k] = tree.points[nodes[k]]
            spread = rules.neighbour_radius
            wanted = near_path(random, path, spread, task.lower, task.upper)
        node = _grow(search, task, rules, wanted)
        if node >= 0:
            away = math.sqrt(squared_distance(tree.points, node, task.goal))
            search.closest[0] = min(search.closest[0], away)
            if away <= rules.goal_radius or rules.sight:
                _join_goal(search, task, rules, node)


@kernel
def draw(search: Search, task: Task, rules: Rules, random: Generator, wanted: Array) -> None:
    """Writes the point to grow to: Algorithm 2, or the goal bias."""
    if not rules.adaptive:
        goal_bias(random, task.goal, task.lower, task.upper, wanted)
        return
    focus = search.tree.points[focus_node(search.tallies)]
    if random.random() > failure_rate(search.tallies, rules.rate):
        forward(
            random,
            task.start,
            task.goal,
            focus,
            task.lower,
            task.upper,
            rules.by_volume,
            wanted,
        )
    else:
        backward(random, search.tree, focus, task.lower, task.upper, wanted)


@kernel
def _grow(search: Search, task: Task, rules: Rules, wanted: Array) -> int:
    """One expansion (lines 5 to 18); the new node, or -1 when it failed."""
    tree = search.tree
    near = nearest(tree, wanted)
    length = math.sqrt(squared_distance(tree.points, near, wanted))
    if length < 1e-9:  # drawn on a node: no direction to grow in
        record_outcome(search.tallies, near, False, rules.focus)
        return -1
    step = rules.step if rules.full_step else min(rules.step, length)
    new = tree.points[near] + (wanted - tree.points[near]) * (step / length)
    if _crowded(tree, new, rules.spacing) or not _free(search, task.limits, tree.points[near], new):
        record_outcome(search.tallies, near, False, rules.focus)
        return -1
    record_outcome(search.tallies, near, True, rules.focus)
    count = within(tree, new, rules.neighbour_radius, search.found)
    costs = np.empty(count)
    for k in range(count):
        costs[k] = edge_cost(task.field, tree.points[search.found[k]], new)
    parent, cost = _best_parent(search, task, near, new, costs)
    node = add(tree, new, parent, cost)
    if rules.rewire:
        _rewire(search, task.limits, node, costs)
    return node


@kernel
def _crowded(tree: Tree, new: Array, spacing: float) -> bool:
    """Whether a new point is nearer to a node than the spacing."""
    if spacing == 0.0:
        return False
    return math.sqrt(squared_distance(tree.points, nearest(tree, new), new)) < spacing


@kernel
def _best_parent(
    search: Search, task: Task, near: int, new: Array, costs: Array
) -> tuple[int, float]:
    """Lines 10 to 17: the neighbour with the least cost-to-come whose edge is allowed."""
    tree, found = search.tree, search.found
    bound = tree.costs[near] + edge_cost(task.field, tree.points[near], new)
    totals = np.empty(len(costs))
    for k in range(len(costs)):
        totals[k] = tree.costs[found[k]] + costs[k]
    for _ in range(len(costs)):
        k = int(np.argmin(totals))
        if totals[k] >= bound:
            break
        if _free(search, task.limits, tree.points[found[k]], new):
            return found[k], totals[k]
        totals[k] = np.inf
    return near, bound


@kernel
def _rewire(search: Search, limits: EdgeLimits, node: int, costs: Array) -> None:
    """RRT*: neighbours that are cheaper through the new node become its children."""
    tree = search.tree
    for k in range(len(costs)):
        neighbour = search.found[k]
        through = tree.costs[node] + costs[k]
        if through < tree.costs[neighbour] - _GAIN and _free(
            search, limits, tree.points[node], tree.points[neighbour]
        ):
            move(tree, neighbour, node, through)


@kernel
def _join_goal(search: Search, task: Task, rules: Rules, node: int) -> None:
    """Adds the goal as a child of a node, or gives it a better parent, if the edge is allowed."""
    tree, counts = search.tree, search.counts
    reached = counts[REACHED]
    total = tree.costs[node] + edge_cost(task.field, tree.points[node], task.goal)
    if reached != NOT_REACHED and total >= tree.costs[reached]:
        return
    if not _free(search, task.limits, tree.points[node], task.goal):
        return
    if reached != NOT_REACHED:
        move(tree, reached, node, total)
        return
    counts[REACHED] = add(tree, task.goal, node, total)
    search.closest[0] = 0.0
    on = rules.improving if rules.rewire else 0
    counts[LAST] = min(counts[ITERATIONS] + on, counts[LAST])


@kernel
def _free(search: Search, limits: EdgeLimits, start: Array, end: Array) -> bool:
    """Whether an edge is allowed; counts it, and records it if refused."""
    counts = search.counts
    counts[CHECKS] += 1
    reason = problem(limits, start, end)
    if reason == FREE:
        return True
    search.reasons[reason] += 1
    slot = counts[REFUSALS] % KEPT_REFUSALS
    search.refused[slot, 0] = start
    search.refused[slot, 1] = end
    counts[REFUSALS] += 1
    return False
