"""What is known of an edge before a pixel is seen; it settles what the pixels leave open."""

from __future__ import annotations

from cdpr.compiled import compiled
from cdpr.poses import Array
from tracking.edge_kernels.columns import BOXED, SPREAD
from tracking.edge_kernels.model import BEYOND_PAPER, BRIGHT, BRIGHT_SLOPE, DARK, DARK_SLOPE

#: The blur's kind and how far from it blurs are.
KIND, KIND_DEVIATION = 0.5, 0.3
#: How far the spread of the blur is from what was found before, as a share of it.
SPREAD_DEVIATION = 0.5
#: How far brightness changes from the middle of an edge to its end, how white modules inside are
#: and what lies beyond the paper is less white than it, as shares of the contrast.
SLOPE_DEVIATION = 0.3
MODULE, MODULE_DEVIATION = 0.4, 0.5
BEYOND_DEVIATION = 0.25


@compiled
def believe(
    parameters: Array, usual_spread: float, variance: float, normal: Array, gradient: Array
) -> float:
    """Adds what is known before a pixel is seen; returns its share of the cost."""
    contrast = max(parameters[BRIGHT] - parameters[DARK], 1.0)
    spread_deviation = SPREAD_DEVIATION * usual_spread
    cost = _expect(SPREAD, usual_spread, spread_deviation, parameters, variance, normal, gradient)
    cost += _expect(BOXED, KIND, KIND_DEVIATION, parameters, variance, normal, gradient)
    for slope in (DARK_SLOPE, BRIGHT_SLOPE):
        cost += _expect(
            slope, 0.0, SLOPE_DEVIATION * contrast, parameters, variance, normal, gradient
        )
    for k in range(BEYOND_PAPER, len(parameters)):
        usual, deviation = MODULE, MODULE_DEVIATION
        if k == BEYOND_PAPER:
            usual, deviation = 0.0, BEYOND_DEVIATION
        cost += _expect(
            k, usual * contrast, deviation * contrast, parameters, variance, normal, gradient
        )
    return float(cost)


@compiled
def _expect(
    k: int,
    usual: float,
    deviation: float,
    parameters: Array,
    variance: float,
    normal: Array,
    gradient: Array,
) -> float:
    """Adds that a parameter is ``usual``, give or take a deviation."""
    weight = variance / (deviation * deviation)
    error = usual - parameters[k]
    normal[k, k] += weight
    gradient[k] += weight * error
    return float(weight * error * error)
