"""Where the tree grows next: adaptive sampling, and the goal bias it is compared with.

Points have n coordinates and are written into an array that the caller owns.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from planner.kernels.jit import kernel
from planner.rrt.tree import Tree, squared_distance
from planner.rrt.variants import FAILURE_RATES, FOCUSES

Array = NDArray[np.float64]

_TRIES = 100


@kernel
def goal_bias(random: Generator, goal: Array, lower: Array, upper: Array, point: Array) -> None:
    """The goal with probability 0.5, else a point of the whole space (paper, section 5.2)."""
    if random.random() < 0.5:
        point[:] = goal
    else:
        _in_bounds(random, lower, upper, point)


@kernel
def forward(
    random: Generator,
    start: Array,
    goal: Array,
    focus: Array,
    lower: Array,
    upper: Array,
    by_volume: bool,
    point: Array,
) -> None:
    """SamplingForward, Eqs. 10 and 11; a point outside the bounds is clipped to them.

    The cone's tip is the goal, its axis points to the start; ``focus``, shape (n,), is x_c.
    """
    n = len(point)
    radius, axis_length, cosine = 0.0, 0.0, 0.0
    for k in range(n):
        to_focus, to_start = focus[k] - goal[k], start[k] - goal[k]
        radius += to_focus * to_focus
        axis_length += to_start * to_start
        cosine += to_focus * to_start
    radius, axis_length = math.sqrt(radius), math.sqrt(axis_length)
    product = radius * axis_length
    opening = math.acos(min(1.0, max(-1.0, cosine / product))) if product > 0.0 else 0.0
    if by_volume:
        radius *= random.random() ** (1.0 / n)
        direction_in_volume(random, opening, point)
    else:
        radius *= random.random()
        direction_by_angles(random, opening, point)
    _turn_first_axis(start, goal, axis_length, point)
    for k in range(n):
        point[k] = min(max(goal[k] + radius * point[k], lower[k]), upper[k])


@kernel
def backward(
    random: Generator, tree: Tree, focus: Array, lower: Array, upper: Array, point: Array
) -> None:
    """SamplingBackward, Eq. 12: outside the ball about the mean of all nodes through x_c.

    Where that ball leaves no room in the bounds, the farthest of 100 points from its centre.
    """
    centre = tree.total / tree.size[0]
    tried = np.empty((1, len(point)))
    radius, farthest = 0.0, -1.0
    for k in range(len(point)):
        radius += (focus[k] - centre[k]) ** 2
    for _ in range(_TRIES):
        _in_bounds(random, lower, upper, tried[0])
        away = squared_distance(tried, 0, centre)
        if away > farthest:
            farthest = away
            point[:] = tried[0]
        if away > radius:
            return


@kernel
def near_path(random: Generator, path: Array, spread: float, lower: Array, upper: Array) -> Array:
    """A sample near a path, shape (k, n), k ≥ 2, where new nodes can make it cheaper."""
    k = random.integers(0, len(path) - 1)
    share = random.random()
    point = path[k] + share * (path[k + 1] - path[k])
    for axis in range(len(point)):
        off = point[axis] + random.normal(0.0, spread)
        point[axis] = min(max(off, lower[axis]), upper[axis])
    return point  # type: ignore[no-any-return]


@kernel
def direction_by_angles(random: Generator, opening: float, point: Array) -> None:
    """A unit vector about the first axis with its angles uniform in their ranges (Eq. 10).

    The last line of Eq. 10 must end in a sine, or the vector is not a unit vector.
    """
    n, sines = len(point), 1.0
    for k in range(n - 1):
        if k == 0:
            angle = random.uniform(-opening, opening)
        elif k == n - 2:
            angle = random.uniform(0.0, 2.0 * math.pi)
        else:
            angle = random.uniform(0.0, math.pi)
        point[k] = sines * math.cos(angle)
        sines *= math.sin(angle)
    point[n - 1] = sines


@kernel
def direction_in_volume(random: Generator, opening: float, point: Array) -> None:
    """A unit vector about the first axis, uniform on the part of the sphere that a cone cuts."""
    n = len(point)
    widest = math.sin(min(opening, math.pi / 2.0))
    angle = 0.0
    while opening > 0.0:
        angle = random.uniform(0.0, opening)
        if random.random() <= (math.sin(angle) / widest) ** (n - 2):
            break
    size = 0.0
    while size == 0.0:
        for k in range(1, n):
            point[k] = random.normal(0.0, 1.0)
            size += point[k] * point[k]
    scale = math.sin(angle) / math.sqrt(size)
    for k in range(1, n):
        point[k] *= scale
    point[0] = math.cos(angle)


@kernel
def _turn_first_axis(start: Array, goal: Array, length: float, point: Array) -> None:
    """Maps the first axis to the direction from goal to start, by a Householder reflection."""
    if length == 0.0:
        return
    mirror = (start - goal) / length
    mirror[0] -= 1.0
    size, along = 0.0, 0.0
    for k in range(len(point)):
        size += mirror[k] * mirror[k]
        along += mirror[k] * point[k]
    if size < 1e-24:
        return
    for k in range(len(point)):
        point[k] -= 2.0 * along / size * mirror[k]


@kernel
def _in_bounds(random: Generator, lower: Array, upper: Array, point: Array) -> None:
    for k in range(len(point)):
        point[k] = random.uniform(lower[k], upper[k])


# Outcomes of expansions: the failure rate e_r and the node x_c, in every reading of the text.


Integers = NDArray[np.int64]

_STREAK, _SEARCHES, _FAILURES, _FOCUS, _LATEST = range(5)

_BY_STREAK = FAILURE_RATES.index("k/(k+1)")
_BY_STREAK_AND_TWO = FAILURE_RATES.index("k/(k+2)")
_BY_TREE = FAILURE_RATES.index("tree")
_LAST_FAILED = FOCUSES.index("last-failed")
_MOST_FAILED = FOCUSES.index("most-failed")


class Tallies(NamedTuple):
    """Counts of expansions.

    Attributes:
        nodes: Searches and failures of each node, shape (capacity, 2).
        whole: Failures since the last success; searches and failures of the tree; the node x_c; the
            node expanded last, shape (5,).
    """

    nodes: Integers
    whole: Integers


def new_tallies(capacity: int) -> Tallies:
    """No expansions yet; x_c is the root, so the cone is the line from goal to start."""
    return Tallies(np.zeros((capacity, 2), dtype=np.int64), np.zeros(5, dtype=np.int64))


@kernel
def record_outcome(tallies: Tallies, node: int, success: bool, focus: int) -> None:
    """Counts an expansion of ``node``; ``focus`` is the index of the reading of x_c."""
    nodes, whole = tallies.nodes, tallies.whole
    nodes[node, 0] += 1
    whole[_SEARCHES] += 1
    whole[_LATEST] = node
    if success:
        whole[_STREAK] = 0
    else:
        nodes[node, 1] += 1
        whole[_STREAK] += 1
        whole[_FAILURES] += 1
        if focus == _LAST_FAILED or (
            focus == _MOST_FAILED and nodes[node, 1] >= nodes[whole[_FOCUS], 1]
        ):
            whole[_FOCUS] = node
    if focus != _LAST_FAILED and focus != _MOST_FAILED:
        _keep_highest(tallies, node)


@kernel
def _keep_highest(tallies: Tallies, node: int) -> None:
    """After ``node`` was expanded: the node with the highest rate; of equals, most failures."""
    nodes, whole = tallies.nodes, tallies.whole
    if whole[_FOCUS] != node:
        if nodes[node, 1] > 0 and _not_below(nodes, node, whole[_FOCUS]):
            whole[_FOCUS] = node
        return
    best = node
    for other in range(len(nodes)):
        if nodes[other, 1] > 0 and other != node and _not_below(nodes, other, best):
            best = other
    whole[_FOCUS] = best


@kernel
def _not_below(nodes: Integers, one: int, other: int) -> bool:
    """Whether one node's rate is above the other's, or equal with no fewer failures."""
    left, right = nodes[one, 1] * nodes[other, 0], nodes[other, 1] * nodes[one, 0]
    if left != right or nodes[other, 0] == 0:
        return left > right or nodes[other, 0] == 0  # type: ignore[no-any-return]
    return nodes[one, 1] >= nodes[other, 1]  # type: ignore[no-any-return]


@kernel
def failure_rate(tallies: Tallies, reading: int) -> float:
    """The rate e_r; ``reading`` is the index of its reading."""
    whole = tallies.whole
    if reading == _BY_STREAK:
        return whole[_STREAK] / (whole[_STREAK] + 1.0)  # type: ignore[no-any-return]
    if reading == _BY_STREAK_AND_TWO:
        return whole[_STREAK] / (whole[_STREAK] + 2.0)  # type: ignore[no-any-return]
    searches, failures = whole[_SEARCHES], whole[_FAILURES]
    if reading != _BY_TREE:
        searches, failures = tallies.nodes[whole[_LATEST], 0], tallies.nodes[whole[_LATEST], 1]
    return failures / searches if searches > 0 else 0.0


@kernel
def focus_node(tallies: Tallies) -> int:
    """The node x_c."""
    return tallies.whole[_FOCUS]  # type: ignore[no-any-return]
