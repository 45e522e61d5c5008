"""Edges to a few tenths of a pixel: a robust line through the steepest points of profiles.

White modules inside the border and cables across the white around it do not move the steepest
point, but would disturb a fit that starts pixels away from the edge.
"""

from __future__ import annotations

import math

import numpy as np

from model.jit import compiled
from model.pose import Array
from tracking.camera_model import Image
from tracking.edges.fit import ranked
from tracking.edges.sampling import (
    BOXED,
    HALF,
    MIDDLE,
    OFFSET,
    OFFSET_VARIANCE,
    SHARE,
    SPREAD,
    TILT,
    TILT_VARIANCE,
    bow,
    edge_frame,
)

PROFILES, TAPS = 16, 17
#: Smallest usable rise over two taps, [grey levels].
LEAST_RISE = 1.25


@compiled
def locate_edges(image: Image, quads: Array, bows: Array, widths: Array, found: Array) -> None:
    """Locates the edges of tags.

    Args:
        quads: Corners, shape (t, 4, 2), [px].
        bows: Of the edges, shape (t, 4, 2), [px].
        widths: Of a module across each edge, shape (t, 4), [px].
        found: Written, shape (t, 4, `COLUMNS`); a share of 0 where there is no edge.
    """
    for tag in range(len(quads)):
        for edge in range(4):
            found[tag, edge, :] = 0.0
            _find(image, quads[tag], edge, bows[tag, edge], widths[tag, edge], found[tag, edge])


@compiled
def _find(image: Image, quad: Array, edge: int, shape: Array, width: float, found: Array) -> None:
    x0, y0, ax, ay, length = edge_frame(quad, edge)
    half = min(max(0.95 * width, 1.5), 6.0)
    margin = min(2.0 + half, 0.3 * length)
    middle, reach = 0.5 * length, 0.5 * length - margin
    positions, offsets, slopes = np.empty(PROFILES), np.empty(PROFILES), np.empty(PROFILES)
    contrasts, values = np.empty(PROFILES), np.empty(TAPS)
    step = 2.0 * half / TAPS
    for n in range(PROFILES):
        positions[n] = (2.0 * n + 1.0) / PROFILES - 1.0
        s = middle + positions[n] * reach
        # The shift distributes the taps of an edge along the grid over its pixels.
        first = bow(shape, s / length) - half + step * ((n * 0.381966) % 1.0)
        for k in range(TAPS):
            u = first + k * step
            values[k] = _brightness(image, x0 + s * ax + u * ay, y0 + s * ay - u * ax)
        slopes[n], offsets[n], contrasts[n] = _steepest(values)
        offsets[n] = first + offsets[n] * step - bow(shape, s / length)
    usual = ranked(slopes.copy(), PROFILES, PROFILES // 2)
    contrast = ranked(contrasts, PROFILES, PROFILES // 2)
    weights = np.empty(PROFILES)
    for n in range(PROFILES):
        good = slopes[n] > 0.4 * usual and slopes[n] > LEAST_RISE
        weights[n] = 1.0 if good else 0.0
    found[MIDDLE], found[HALF], found[BOXED] = middle, reach, 0.5
    # A Gaussian blur rises by the whole step over 2.5 deviations at its steepest slope; reading
    # between pixels and over two taps blurs, too.
    spread = contrast / max(usual, 1.0) * 2.0 * step / 2.5
    found[SPREAD] = math.sqrt(max(spread * spread - step * step / 3.0 - 1.0 / 6.0, 0.1))
    _fit_line(positions, offsets, weights, found)


@compiled
def _steepest(values: Array) -> tuple[float, float, float]:
    """Largest rise over two taps, its position in taps, and the whole contrast."""
    low = high = values[0]
    best, position = -1e9, 0.0
    for k in range(TAPS):
        low, high = min(low, values[k]), max(high, values[k])
        if k >= 2 and values[k] - values[k - 2] > best:
            best, position = values[k] - values[k - 2], k - 1.0
    return best, position, high - low


@compiled
def _brightness(image: Image, x: float, y: float) -> float:
    """Brightness between pixels, bilinear."""
    height, width = image.shape
    x, y = min(max(x, 0.0), width - 1.001), min(max(y, 0.0), height - 1.001)
    column, row = int(x), int(y)
    right, down = x - column, y - row
    top = image[row, column] * (1.0 - right) + image[row, column + 1] * right
    bottom = image[row + 1, column] * (1.0 - right) + image[row + 1, column + 1] * right
    return float(top * (1.0 - down) + bottom * down)


@compiled
def _fit_line(positions: Array, offsets: Array, good: Array, found: Array) -> None:
    """Robust line fit to the good points (Tukey's weights)."""
    weights, errors = good.copy(), np.empty(PROFILES)
    sizes = np.empty(PROFILES)
    height = slope = mean = square = total = 0.0
    for _ in range(5):
        total = mean = height = square = slope = 0.0
        for n in range(PROFILES):
            total += weights[n]
            mean += weights[n] * positions[n]
            height += weights[n] * offsets[n]
        total = max(total, 1e-9)
        mean, height = mean / total, height / total
        for n in range(PROFILES):
            square += weights[n] * (positions[n] - mean) ** 2
            slope += weights[n] * (positions[n] - mean) * offsets[n]
        square = max(square, 1e-9)
        slope /= square
        count = 0
        for n in range(PROFILES):
            errors[n] = offsets[n] - height - slope * (positions[n] - mean)
            if good[n] > 0.0:
                sizes[count] = abs(errors[n])
                count += 1
        if count < 3:
            return
        reach = 4.0 * (1.4826 * ranked(sizes, count, (count - 1) // 2) + 0.005)
        for n in range(PROFILES):
            weights[n] = good[n] * max(1.0 - (errors[n] / reach) ** 2, 0.0) ** 2
    inside, scatter = 0, 0.0
    for n in range(PROFILES):
        if weights[n] > 0.1:
            inside += 1
            scatter += errors[n] ** 2
    variance = scatter / max(inside - 2, 1)
    found[OFFSET], found[TILT] = height - slope * mean, slope
    found[OFFSET_VARIANCE] = variance / total
    found[TILT_VARIANCE] = variance / square
    found[SHARE] = inside / PROFILES if math.sqrt(variance) < 0.6 else 0.0
