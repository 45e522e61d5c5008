"""Edges to thousandths of a pixel: the best fit of a blurred step to the pixels near each edge.

Levenberg–Marquardt over parts of an edge: a part crossed by a cable or a smudge fits much worse
than the others and is rejected.
"""

from __future__ import annotations

import math

import numpy as np

from model.jit import compiled
from model.pose import Array
from tracking.camera_model import Image
from tracking.edges.sampling import (
    ACROSS,
    BEYOND_PAPER,
    BOXED,
    BRIGHT,
    BRIGHT_SLOPE,
    COVARIANCE,
    DARK,
    DARK_SLOPE,
    HALF,
    HIDDEN,
    INK,
    INNER,
    MIDDLE,
    MODULES,
    OFFSET,
    OFFSET_VARIANCE,
    SHARE,
    SPREAD,
    TILT,
    TILT_VARIANCE,
    VALUE,
    WHITE,
    compare,
    edge_frame,
    plane_of,
    sample_edge,
    write_ink,
    write_modules,
)


@compiled
def ranked(values: Array, count: int, rank: int) -> float:
    """The value of a rank among the first ``count`` (quickselect); reorders them."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return float(values[rank])


# Parts of an edge: a cable or a smudge across it spoils only some of them.

#: Parts whose mean square exceeds the typical one by this factor are rejected.
FOREIGN = 9.0


@compiled
def weigh(squares: Array, counts: Array, allowed: float, weights: Array) -> None:
    """Writes weights of parts: 0 for those that fit far worse than most."""
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
    """Writes the weighted sums over the parts; returns those of pixels and of squares."""
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


# Small symmetric systems of linear equations.


@compiled
def factored(matrix: Array, size: int) -> bool:
    """Cholesky factorization in place, lower half; False if not positive definite."""
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            if i > j:
                matrix[i, j] = rest / matrix[j, j]
            elif rest > 0.0:
                matrix[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@compiled
def solved(factor: Array, vector: Array, size: int) -> None:
    """Solves with a Cholesky factor, in place of the right-hand side."""
    for i in range(size):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


# Prior of an edge, for what the pixels do not determine.

#: Mean and deviation of the blur's shape.
KIND, KIND_DEVIATION = 0.5, 0.3
#: Relative deviation of the blur's spread from the earlier estimate.
SPREAD_DEVIATION = 0.5
#: Deviations of the brightness change from the middle to the end of an edge, of the whiteness of
#: modules inside (and its mean), and of the surroundings, as shares of the contrast.
SLOPE_DEVIATION = 0.3
MODULE, MODULE_DEVIATION = 0.4, 0.5
BEYOND_DEVIATION = 0.25


@compiled
def add_prior(
    parameters: Array, usual_spread: float, variance: float, normal: Array, gradient: Array
) -> float:
    """Adds the prior; returns its share of the cost."""
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
    """Adds a normal prior of a parameter."""
    weight = variance / (deviation * deviation)
    error = usual - parameters[k]
    normal[k, k] += weight
    gradient[k] += weight * error
    return float(weight * error * error)


#: Pixels are read up to this distance from an edge: deviations of its blur plus pixels, but at
#: most this share of a module.
REACH_SPREADS, REACH, REACH_MODULES = 2.2, 1.5, 0.95
#: Distance kept from its corners: pixels, and deviations of the neighbouring edges' blur.
CLEAR, CLEAR_SPREADS = 0.5, 1.5
#: An edge is crowded if the next module is within this many deviations of the pixels read.
CROWDED = 2.6
#: Maximum number of pixels read per edge.
MOST_PIXELS = 6000
#: Length of a part of an edge, [px], and maximum number of parts.
PART, MOST_PARTS = 2.0, 64
#: Model error as a share of the contrast, and variance of rounding to grey levels,
#: [grey levels²].
UNMODELLED, ROUNDING = 0.02, 1.0 / 12.0
MOST_STEPS = 14
#: Blur of an ideal pixel, approximately, [px].
LEAST_SPREAD = 0.25
#: Smallest step of brightness that counts as an edge, [grey levels].
LEAST_CONTRAST = 3.0
#: A step smaller than this ends the fit, [px].
SETTLED = 1e-3


@compiled
def fit_edges(
    image: Image,
    quads: Array,
    bows: Array,
    widths: Array,
    modules: int,
    before: Array,
    found: Array,
) -> None:
    """Fits the edges of tags.

    Args:
        quads: Corners to some tenths of a pixel, shape (t, 4, 2), [px].
        bows: Of the edges, shape (t, 4, 2), [px].
        widths: Of a module across each edge, shape (t, 4), [px].
        modules: Along the side of a tag's square.
        before: Earlier estimate of the edges, shape (t, 4, `COLUMNS`); only their blur is used.
        found: Written, shape (t, 4, `COLUMNS`); a share of 0 where there is no edge.
    """
    for tag in range(len(quads)):
        for edge in range(4):
            found[tag, edge, :] = before[tag, edge]
            found[tag, edge, SHARE] = 0.0
            beside = (before[tag, (edge + 1) % 4, SPREAD], before[tag, (edge + 3) % 4, SPREAD])
            _fit(
                image,
                quads[tag],
                edge,
                bows[tag, edge],
                widths[tag, edge],
                modules,
                0.5 * (beside[0] + beside[1]),
                found[tag, edge],
            )


@compiled
def _fit(
    image: Image,
    quad: Array,
    edge: int,
    shape: Array,
    width: float,
    modules: int,
    spread_along: float,
    found: Array,
) -> None:
    spread = found[SPREAD]
    reach = max(min(REACH_SPREADS * spread + REACH, REACH_MODULES * width), 1.2)
    span = _span(quad, edge, reach, CLEAR + CLEAR_SPREADS * spread_along)
    found[MIDDLE], found[HALF] = 0.5 * (span[0] + span[1]), 0.5 * (span[1] - span[0])
    room = min(int((span[1] - span[0] + 2.0) * (2.0 * reach + 2.0)), MOST_PIXELS)
    crowded = width - reach < CROWDED * spread
    pixels = np.zeros((MODULES + (modules - 2 if crowded else 0), room))
    count = sample_edge(image, quad, edge, shape, span, reach, pixels)
    write_ink(quad, edge, pixels, count, found, spread_along)
    if crowded:
        plane = np.empty(8)
        plane_of(quad, edge, plane)
        write_modules(quad, edge, plane, modules, pixels, count, found, spread_along)
    parameters = np.zeros(INNER + modules - 2 if crowded else BEYOND_PAPER)
    if _begin(pixels, count, reach, found, parameters):
        _improve(pixels, count, parameters, 1.3 * width, found)


@compiled
def _span(quad: Array, edge: int, reach: float, clear: float) -> tuple[float, float]:
    """The part of an edge whose pixels are at least ``clear`` from the neighbouring edges."""
    _, _, ax, ay, length = edge_frame(quad, edge)
    _, _, bx, by, _ = edge_frame(quad, (edge + 3) % 4)
    _, _, cx, cy, _ = edge_frame(quad, (edge + 1) % 4)
    first, last = abs(ax * bx + ay * by), abs(ax * cx + ay * cy)  # cosines at both corners
    first *= reach / math.sqrt(max(1.0 - first * first, 1e-4))
    last *= reach / math.sqrt(max(1.0 - last * last, 1e-4))
    return min(clear + first, 0.35 * length), length - min(clear + last, 0.35 * length)


@compiled
def _begin(pixels: Array, count: int, reach: float, found: Array, parameters: Array) -> bool:
    """Writes the initial parameters; False if there is no step from ink to paper."""
    dark, bright = np.empty(count), np.empty(count)
    inside = outside = 0
    for n in range(count):
        if pixels[ACROSS, n] > 0.4 * reach:
            bright[outside] = pixels[VALUE, n]
            outside += 1
        elif pixels[ACROSS, n] < -0.4 * reach and pixels[INK, n] > 0.9:
            dark[inside] = pixels[VALUE, n]
            inside += 1
    if inside < 3 or outside < 3:
        return False
    parameters[SPREAD], parameters[BOXED] = found[SPREAD], found[BOXED]
    parameters[DARK] = ranked(dark, inside, inside // 3)
    parameters[BRIGHT] = ranked(bright, outside, 2 * outside // 3)
    contrast = parameters[BRIGHT] - parameters[DARK]
    parameters[INNER:] = MODULE * contrast
    return bool(contrast > LEAST_CONTRAST)


@compiled
def _improve(pixels: Array, count: int, best: Array, most_spread: float, found: Array) -> None:
    """Refines the parameters until convergence and writes the result."""
    size, usual_spread = len(best), best[SPREAD]
    parts = min(max(4, int(2.0 * found[HALF] / PART)), MOST_PARTS)
    normals, gradients = np.empty((parts, size, size)), np.empty((parts, size))
    squares, counts, weights = np.empty(parts), np.empty(parts), np.ones(parts)
    normal, gradient = np.empty((size, size)), np.empty(size)
    best_normal, best_gradient = np.zeros((size, size)), np.zeros(size)
    factor, step, trial = np.empty((size, size)), np.empty(size), best.copy()
    best_cost, best_variance, damping, settled = 1e300, 1.0, 1e-3, False
    for turn in range(MOST_STEPS):
        compare(pixels, count, trial, normals, gradients, squares, counts)
        if turn < 3:
            # Initially all parts fit badly, some less so by chance.
            unmodelled = UNMODELLED * (4 >> turn) * (trial[BRIGHT] - trial[DARK])
            weigh(squares, counts, ROUNDING + unmodelled * unmodelled, weights)
            best_cost = 1e300
        total, cost = weighted_sum(normals, gradients, squares, counts, weights, normal, gradient)
        if total < 14.0:
            return
        variance = max(cost / max(total - size, total / 3.0), ROUNDING)
        cost += add_prior(trial, usual_spread, variance, normal, gradient)
        if cost <= best_cost * (1.0 + 1e-9):
            best[:], best_normal[:, :], best_gradient[:] = trial, normal, gradient
            best_cost, best_variance, damping = cost, variance, max(0.1 * damping, 1e-7)
        else:
            damping *= 10.0
        if settled:
            break
        for i in range(size):
            factor[i, :] = best_normal[i]
            factor[i, i] += damping * best_normal[i, i] + 1e-9
        step[:] = best_gradient
        if not factored(factor, size):
            return
        solved(factor, step, size)
        share = min(1.0, 0.5 / max(abs(step[OFFSET]), 1e-9))
        trial[:] = best + share * step
        # Too sharp a step is insensitive to pixels and could not widen again.
        trial[SPREAD] = max(trial[SPREAD], 0.6 * best[SPREAD], LEAST_SPREAD)
        trial[SPREAD] = min(trial[SPREAD], max(most_spread, 0.6))
        trial[BOXED] = min(max(trial[BOXED], -0.3), 1.3)
        settled = damping < 0.1 and max(abs(step[OFFSET]), abs(step[TILT])) < SETTLED
    if best[BRIGHT] - best[DARK] > LEAST_CONTRAST:
        compare(pixels, count, best, normals, gradients, squares, counts)
        _write(best, best_normal, best_variance, weights, gradients, found)


#: Errors are assumed correlated over this many parts of an edge.
LAGS = 3
#: Prior weight of independent errors, in parts.
INDEPENDENT = 8.0


@compiled
def _correlated(column: Array, gradients: Array, weights: Array) -> float:
    """Variance from the contribution of each part of an edge, with correlation between parts.

    Errors correlated over neighbouring parts (JPEG, scaling, sharpening) are fewer independent
    samples than pixels.

    Args:
        column: Of the inverse normal matrix, times a factor; the result has its square.
        gradients: Of the parts, shape (b, p).
        weights: Of the parts, shape (b,).

    Source: Newey & West, Econometrica 55(3), 1987.
    """
    parts = len(weights)
    pulls = np.zeros(parts)
    for k in range(parts):
        for i in range(len(column)):
            pulls[k] += weights[k] * column[i] * gradients[k, i]
    total = 0.0
    for apart in range(LAGS + 1):
        share = (1.0 if apart == 0 else 2.0) * (1.0 - apart / (LAGS + 1.0))
        for k in range(parts - apart):
            total += share * pulls[k] * pulls[k + apart]
    return total


@compiled
def _write(
    best: Array, normal: Array, variance: float, weights: Array, gradients: Array, found: Array
) -> None:
    """Writes the edge and its covariance."""
    size = len(best)
    column = np.empty(size)
    wider = 0.0
    for i in range(size):
        normal[i, i] += 1e-9
    if not factored(normal, size):
        return
    for k in range(2):
        column[:] = 0.0
        column[k] = variance
        solved(normal, column, size)
        if k == OFFSET:
            found[OFFSET_VARIANCE], found[COVARIANCE] = column[OFFSET], column[TILT]
        else:
            found[TILT_VARIANCE] = column[TILT]
        wider += 0.5 * _correlated(column, gradients, weights) / (variance * column[k] * variance)
    found[OFFSET], found[TILT] = best[OFFSET], best[TILT]
    found[SPREAD], found[BOXED] = best[SPREAD], best[BOXED]
    found[HIDDEN] = max(best[BRIGHT] - WHITE, 0.0) / (best[BRIGHT] - best[DARK])
    used = 0
    for weight in weights:
        used += 1 if weight > 0.1 else 0
    found[SHARE] = used / len(weights)
    if used > 2 * LAGS:
        wider *= used / (used - LAGS - 1.0)  # the fit absorbs what all parts have in common
        wider = max(1.0, (INDEPENDENT + used * wider) / (INDEPENDENT + used))
        found[OFFSET_VARIANCE] *= wider
        found[COVARIANCE] *= wider
        found[TILT_VARIANCE] *= wider
