"""How bright the pixels beside an edge should be, and how far they are from it.

Paper and ink are straight functions of the place along the edge; between them lies the blurred
step, and beside it, where the blur reaches so far, the modules inside and what is outside.
"""

from __future__ import annotations

import numpy as np

from model.jit import compiled
from model.pose import Array
from tracking.edges.sampling import (
    ACROSS,
    BEYOND,
    BOXED,
    INK,
    MODULES,
    OFFSET,
    PLACE,
    SPREAD,
    TILT,
    VALUE,
    WITHIN,
    rise,
)

#: Parameters are the first columns of an edge; ink and paper at its middle and how they change
#: along it; and of a crowded edge what the paper's surroundings and each module inside add.
DARK, DARK_SLOPE, BRIGHT, BRIGHT_SLOPE, BEYOND_PAPER, INNER = 4, 5, 6, 7, 8, 9


WHITE = 254.5
"""Pixels from here on are clipped, [grey levels]."""


@compiled
def compare(
    pixels: Array,
    count: int,
    parameters: Array,
    normals: Array,
    gradients: Array,
    squares: Array,
    counts: Array,
) -> None:
    """Sums errors and their changes with the parameters, for each part of an edge on its own.

    Args:
        pixels: What is known of them, rows of `tracking.edges.sampling`.
        count: Of the pixels.
        parameters: Shape (p,), 8 or, of a crowded edge, more.
        normals: Is written, lower halves, shape (b, p, p).
        gradients: Is written, shape (b, p).
        squares: Sums of squared errors, is written, shape (b,).
        counts: Of pixels, is written, shape (b,).
    """
    parts, size = len(counts), len(parameters)
    normals[:, :, :] = 0.0
    gradients[:, :] = 0.0
    squares[:] = 0.0
    counts[:] = 0.0
    change = np.empty(size)
    for n in range(count):
        error = _error(pixels, n, parameters, change)
        part = min(max(int(0.5 * (pixels[PLACE, n] + 1.0) * parts), 0), parts - 1)
        squares[part] += error * error
        counts[part] += 1.0
        normal, gradient = normals[part], gradients[part]
        for i in range(size):
            if change[i] != 0.0:
                gradient[i] += change[i] * error
                for j in range(i + 1):
                    normal[i, j] += change[i] * change[j]


@compiled
def _error(pixels: Array, n: int, parameters: Array, change: Array) -> float:
    """What a pixel is brighter than it should be; writes how that would change."""
    q, ink, spread = pixels[PLACE, n], pixels[INK, n], parameters[SPREAD]
    dark = parameters[DARK] + parameters[DARK_SLOPE] * q
    bright = parameters[BRIGHT] + parameters[BRIGHT_SLOPE] * q
    shift = parameters[OFFSET] + parameters[TILT] * q
    x = (pixels[ACROSS, n] - shift) / spread
    share, slope, kind = rise(x, parameters[BOXED])
    black = (1.0 - share) * ink
    step = (bright - dark) * ink
    change[OFFSET], change[TILT] = -step * slope / spread, -step * slope / spread * q
    change[SPREAD], change[BOXED] = -step * slope * x / spread, step * kind
    change[DARK], change[DARK_SLOPE] = black, black * q
    change[BRIGHT], change[BRIGHT_SLOPE] = 1.0 - black, (1.0 - black) * q
    value = bright - (bright - dark) * black
    if len(parameters) > BEYOND_PAPER:
        value += _surroundings(pixels, n, shift, parameters, change)
    if pixels[VALUE, n] >= WHITE and value >= WHITE:  # clipped: it is that bright or brighter
        change[:] = 0.0
        return 0.0
    return float(pixels[VALUE, n] - value)


@compiled
def _surroundings(pixels: Array, n: int, shift: float, parameters: Array, change: Array) -> float:
    """Brightness that reaches a pixel from beyond the paper and from the modules inside."""
    spread, boxed = parameters[SPREAD], parameters[BOXED]
    x = pixels[BEYOND, n] / spread
    share, slope, kind = rise(x, boxed)
    beyond = parameters[BEYOND_PAPER]
    value = beyond * share
    change[BEYOND_PAPER] = share
    change[SPREAD] -= beyond * slope * x / spread
    change[BOXED] += beyond * kind
    x = (pixels[WITHIN, n] - shift) / spread
    share, slope, kind = rise(x, boxed)
    modules = 0.0
    for k in range(len(parameters) - INNER):
        part = pixels[MODULES + k, n]
        modules += parameters[INNER + k] * part
        change[INNER + k] = (1.0 - share) * part
    change[SPREAD] += modules * slope * x / spread
    change[BOXED] -= modules * kind
    return float(value + modules * (1.0 - share))
