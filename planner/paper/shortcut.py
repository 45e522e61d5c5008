"""Algorithm 3 as meant, compiled: from each kept node to the farthest that can be reached.

As printed it takes shortcuts that are NOT free. A shortcut keeps everything that edges keep. Under
the kinematic cost a straight line can cost more than the way it replaces, so a shortcut must not be
dearer; under the length it never is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.checks import FREE
from planner.exact.compiled import kernel
from planner.paper.cost_field import CostField, edge_cost
from planner.paper.limits import Limits, problem

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_ROUND_OFF = 1e-12


@kernel
def shortcut(path: Array, limits: Limits, field: CostField, dearer: float) -> tuple[Integers, int]:
    """The nodes of a path that Algorithm 3 keeps, the first and the last among them.

    Args:
        path: Free from node to node, shape (k, 3), [m].
        limits: What edges must keep.
        field: What they cost.
        dearer: Share by which a shortcut may cost more than what it replaces, to save corners.

    Returns:
        Numbers of nodes, shape (j,), and how many edges were checked.
    """
    last, checks = len(path) - 1, 0
    along = np.zeros(len(path))
    for k in range(last):
        along[k + 1] = along[k] + edge_cost(field, path[k], path[k + 1])
    kept = np.zeros(len(path), dtype=np.int64)
    count, i = 1, 0
    while i < last:
        j = last
        while j > i + 1:
            most = (1.0 + dearer) * (along[j] - along[i]) + _ROUND_OFF
            if edge_cost(field, path[i], path[j]) <= most:
                checks += 1
                if problem(limits, path[i], path[j]) == FREE:
                    break
            j -= 1
        kept[count] = j
        count += 1
        i = j
    return kept[:count], checks
