"""Parts of an edge: a cable or a smudge that crosses it spoils some of them and not the others."""

from __future__ import annotations

import numpy as np

from cdpr.compiled import compiled
from cdpr.poses import Array
from tracking.edge_kernels.ranked import ranked

#: Parts that fit this much worse than the usual one (in squares) do not count.
FOREIGN = 9.0


@compiled
def weigh(squares: Array, counts: Array, allowed: float, weights: Array) -> None:
    """Writes weights of parts: 0 for those that fit far worse than two thirds of them do."""
    parts = len(weights)
    means = np.empty(parts)
    for k in range(parts):
        means[k] = squares[k] / max(counts[k], 1.0)
    limit = FOREIGN * (allowed + ranked(means.copy(), parts, int(0.35 * (parts - 1))))
    for k in range(parts):
        share = means[k] / limit
        weights[k] = (1.0 - share * share) ** 2 if share < 1.0 and counts[k] > 0.0 else 0.0


@compiled
def weighted_sum(
    normals: Array,
    gradients: Array,
    squares: Array,
    counts: Array,
    weights: Array,
    normal: Array,
    gradient: Array,
) -> tuple[float, float]:
    """Writes the weighted sums over the parts; returns those of pixels and of squared errors."""
    size = len(gradient)
    normal[:, :] = 0.0
    gradient[:] = 0.0
    total = cost = 0.0
    for k in range(len(weights)):
        if weights[k] > 0.0:
            total += weights[k] * counts[k]
            cost += weights[k] * squares[k]
            for i in range(size):
                gradient[i] += weights[k] * gradients[k, i]
                for j in range(i + 1):
                    normal[i, j] += weights[k] * normals[k, i, j]
    return total, cost
