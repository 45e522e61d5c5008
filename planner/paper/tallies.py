"""How expansions went: the failure rate e_r and the node x_c, in every reading of the text."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.paper.readings import FAILURE_RATES, FOCUSES

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
    """No expansions yet; x_c is the root, with which the cone is the line from goal to start."""
    return Tallies(np.zeros((capacity, 2), dtype=np.int64), np.zeros(5, dtype=np.int64))


@kernel
def tell(tallies: Tallies, node: int, success: bool, focus: int) -> None:
    """Counts an expansion of ``node``; ``focus`` is the number of the reading of x_c."""
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
    """The rate e_r; ``reading`` is the number of its reading."""
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
