"""Edges to thousandths of a pixel: the blurred step that fits the pixels beside each best.

Levenberg and Marquardt's steps, over parts of an edge: a part in which a cable or a smudge crosses
the edge fits much worse than the usual one and counts no more.
"""

from __future__ import annotations

import math

import numpy as np

from model.jit import compiled
from model.pose import Array
from tracking.camera_model import Image
from tracking.edges.sampling import (
    ACROSS,
    ALIKE,
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
    tell_ink,
    tell_modules,
)


@compiled
def ranked(values: Array, count: int, rank: int) -> float:
    """The value that would stand at ``rank`` if the first ``count`` were sorted; reorders them."""
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


# Parts of an edge: a cable or a smudge that crosses it spoils some of them and not the others.

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


# Small symmetric systems of linear equations.


@compiled
def factored(matrix: Array, size: int) -> bool:
    """Cholesky's factor of a matrix, in place of its lower half; False if it is not positive."""
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
    """Solves with a factor, in place of the right-hand side."""
    for i in range(size):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


# What is known of an edge before a pixel is seen; it settles what the pixels leave open.

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
def add_prior(
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


#: Pixels are read this far from an edge: deviations of its blur plus a number of pixels, but not
#: beyond this share of a module.
REACH_SPREADS, REACH, REACH_MODULES = 2.2, 1.5, 0.95
#: And so far from its corners: pixels, and deviations of the neighbouring edges' blur.
CLEAR, CLEAR_SPREADS = 0.5, 1.5
#: An edge is crowded when the next module is this many deviations of the blur from what is read.
CROWDED = 2.6
#: Most pixels that are read beside an edge.
MOST_PIXELS = 6000
#: Length of a part of an edge [px], and how many parts there are at most.
PART, MOST_PARTS = 2.0, 64
#: What the model leaves undescribed, as a share of the contrast, and what rounding to whole grey
#: levels leaves, [grey levels²].
UNTOLD, ROUNDING = 0.02, 1.0 / 12.0
MOST_STEPS = 14
#: A pixel alone blurs by about this, [px].
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
        image: Grey.
        quads: Corners to some tenths of a pixel, shape (t, 4, 2), [px].
        bows: Of the edges, shape (t, 4, 2), [px].
        widths: Of a module across each edge, shape (t, 4), [px].
        modules: Along the side of a tag's square.
        before: What is known of the edges, shape (t, 4, `COLUMNS`); only their blur is used.
        found: Is written, shape (t, 4, `COLUMNS`); a share of 0 where there is no edge.
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
    tell_ink(quad, edge, pixels, count, found, spread_along)
    if crowded:
        plane = np.empty(8)
        plane_of(quad, edge, plane)
        tell_modules(quad, edge, plane, modules, pixels, count, found, spread_along)
    parameters = np.zeros(INNER + modules - 2 if crowded else BEYOND_PAPER)
    if _begin(pixels, count, reach, found, parameters):
        _improve(pixels, count, parameters, 1.3 * width, found)


@compiled
def _span(quad: Array, edge: int, reach: float, clear: float) -> tuple[float, float]:
    """The part of an edge beside which no pixel lies nearer than ``clear`` to a neighbour."""
    _, _, ax, ay, length = edge_frame(quad, edge)
    _, _, bx, by, _ = edge_frame(quad, (edge + 3) % 4)
    _, _, cx, cy, _ = edge_frame(quad, (edge + 1) % 4)
    first, last = abs(ax * bx + ay * by), abs(ax * cx + ay * cy)  # cosines at both corners
    first *= reach / math.sqrt(max(1.0 - first * first, 1e-4))
    last *= reach / math.sqrt(max(1.0 - last * last, 1e-4))
    return min(clear + first, 0.35 * length), length - min(clear + last, 0.35 * length)


@compiled
def _begin(pixels: Array, count: int, reach: float, found: Array, parameters: Array) -> bool:
    """Writes the parameters to begin with; False if there is no step from ink to paper."""
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
    """Improves the parameters as long as that helps, and writes what came out."""
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
            # Before the first steps all parts fit badly, and some by chance less so.
            untold = UNTOLD * (4 >> turn) * (trial[BRIGHT] - trial[DARK])
            weigh(squares, counts, ROUNDING + untold * untold, weights)
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
        # Too sharp a step sees no pixels, so it could not widen again.
        trial[SPREAD] = max(trial[SPREAD], 0.6 * best[SPREAD], LEAST_SPREAD)
        trial[SPREAD] = min(trial[SPREAD], max(most_spread, 0.6))
        trial[BOXED] = min(max(trial[BOXED], -0.3), 1.3)
        settled = damping < 0.1 and max(abs(step[OFFSET]), abs(step[TILT])) < SETTLED
    if best[BRIGHT] - best[DARK] > LEAST_CONTRAST:
        compare(pixels, count, best, normals, gradients, squares, counts)
        _write(best, best_normal, best_variance, weights, gradients, found)


#: Errors are taken to be alike over this many parts of an edge.
LAGS = 3
#: That errors are independent weighs as much as this many parts that show otherwise.
INDEPENDENT = 8.0


@compiled
def _correlated(column: Array, gradients: Array, weights: Array) -> float:
    """A variance by what each part of the edge pulls, neighbouring parts together.

    Errors that are alike in neighbouring parts (JPEG, enlarging, sharpening) are fewer independent
    samples than there are pixels.

    Args:
        column: Of the inverse of the normal matrix, times a factor; the result has its square.
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
    """Writes the edge and how sure it is."""
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
    found[ALIKE] = 1.0
    if used > 2 * LAGS:
        wider *= used / (used - LAGS - 1.0)  # the fit has taken off what all parts share
        wider = max(1.0, (INDEPENDENT + used * wider) / (INDEPENDENT + used))
        found[OFFSET_VARIANCE] *= wider
        found[COVARIANCE] *= wider
        found[TILT_VARIANCE] *= wider
        found[ALIKE] = wider
