"""The pixels on both sides of an edge, and what the rest of the square does to each of them.

Beside a blurred edge lie the square's two neighbouring edges, the modules within it, and what is
beyond the white around it: all in reach of the blur when modules are small or the blur is wide.
"""

from __future__ import annotations

import math

from cdpr.compiled import compiled
from cdpr.poses import Array
from tracking.edge_kernels.columns import HALF, MIDDLE
from tracking.edge_kernels.rise import rise
from tracking.edge_kernels.square import beside, bow, edge_frame
from tracking.picture import Image

#: Rows of what is known of each pixel; rows from `MODULES` on: share of each module along the edge.
PLACE, ACROSS, VALUE, INK, WITHIN, BEYOND, MODULES = range(7)


@compiled
def read_band(
    image: Image,
    quad: Array,
    edge: int,
    shape: Array,
    span: tuple[float, float],
    reach: float,
    pixels: Array,
) -> int:
    """Reads the pixels that lie within ``reach`` of an edge and within a span along it.

    Args:
        image: Grey.
        quad: Corners, shape (4, 2), [px].
        edge: Which edge of it.
        shape: Of the edge's bow.
        span: Along the edge, [px].
        reach: On both sides, [px].
        pixels: Rows `PLACE`, `ACROSS` and `VALUE` are written, shape (k, n).

    Returns:
        How many there are; no more than ``pixels`` holds, then evenly spread along the edge.
    """
    height, width = image.shape
    x0, y0, ax, ay, length = edge_frame(quad, edge)
    first, last = span
    every = 1 + int((last - first) * 2.0 * reach / (0.9 * pixels.shape[1]))
    middle, half = 0.5 * (first + last), 0.5 * (last - first)
    low = y0 + min(first * ay, last * ay) - reach * abs(ax)
    high = y0 + max(first * ay, last * ay) + reach * abs(ax)
    count = 0
    for row in range(max(0, math.ceil(low)), min(height - 1, math.floor(high)) + 1):
        dy = row - y0
        left, right = _within(ax, dy * ay, first, last)
        other_left, other_right = _within(ay, -dy * ax, -reach, reach)
        left, right = x0 + max(left, other_left), x0 + min(right, other_right)
        left, right = max(left, 0.0), min(right, width - 1.0)
        for column in range(math.ceil(left), math.floor(right) + 1):
            dx = column - x0
            s = dx * ax + dy * ay
            if (every > 1 and int(s) % every) or count >= pixels.shape[1]:
                continue
            pixels[PLACE, count] = (s - middle) / half
            pixels[ACROSS, count] = dx * ay - dy * ax - bow(shape, s / length)
            pixels[VALUE, count] = image[row, column]
            count += 1
    return count


@compiled
def _within(factor: float, start: float, low: float, high: float) -> tuple[float, float]:
    """Where ``factor * x + start`` lies between two limits."""
    if abs(factor) < 1e-9:
        return (-1e9, 1e9) if low <= start <= high else (1e9, -1e9)
    one, other = (low - start) / factor, (high - start) / factor
    return min(one, other), max(one, other)


@compiled
def tell_ink(
    quad: Array, edge: int, pixels: Array, count: int, found: Array, spread: float
) -> None:
    """Writes the share of ink that the blurred neighbouring edges leave beside an edge.

    Args:
        quad: Corners, shape (4, 2), [px].
        edge: Which edge of it.
        pixels: Row `INK` is written.
        count: Of the pixels.
        found: Of the edge; tells the span that was read.
        spread: Of the neighbouring edges' blur, [px].
    """
    _, _, ax, ay, length = edge_frame(quad, edge)
    _, _, bx, by, _ = edge_frame(quad, (edge + 3) % 4)
    _, _, cx, cy, _ = edge_frame(quad, (edge + 1) % 4)
    for n in range(count):
        s, u = found[MIDDLE] + found[HALF] * pixels[PLACE, n], pixels[ACROSS, n]
        dx, dy = s * ax + u * ay, s * ay - u * ax
        before = dy * bx - dx * by
        after = (dy - length * ay) * cx - (dx - length * ax) * cy
        pixels[INK, n] = rise(before / spread, 0.5)[0] * rise(after / spread, 0.5)[0]


@compiled
def tell_modules(
    quad: Array,
    edge: int,
    plane: Array,
    modules: int,
    pixels: Array,
    count: int,
    found: Array,
    spread: float,
) -> None:
    """Writes what lies a module inside and a module outside of an edge.

    Args:
        quad: Corners, shape (4, 2), [px].
        edge: Which edge of it.
        plane: From places in the square to pixels.
        modules: Along the side of the square.
        pixels: Rows `WITHIN`, `BEYOND` and those from `MODULES` on are written.
        count: Of the pixels.
        found: Of the edge; tells the span that was read.
        spread: Of the neighbouring edges' blur, [px].
    """
    module = 1.0 / modules
    s0, u0 = beside(quad, edge, plane, module, module)
    s1, u1 = beside(quad, edge, plane, 1.0 - module, module)
    s2, u2 = beside(quad, edge, plane, 0.0, -module)
    s3, u3 = beside(quad, edge, plane, 1.0, -module)
    for n in range(count):
        s, u = found[MIDDLE] + found[HALF] * pixels[PLACE, n], pixels[ACROSS, n]
        pixels[WITHIN, n] = u - u0 - (u1 - u0) * (s - s0) / (s1 - s0)
        pixels[BEYOND, n] = u - u2 - (u3 - u2) * (s - s2) / (s3 - s2)
    for k in range(modules - 1):
        # The modules' sides are seen a little within the square.
        side, _ = beside(quad, edge, plane, (k + 1) * module, 1.25 * module)
        for n in range(count):
            s = found[MIDDLE] + found[HALF] * pixels[PLACE, n]
            share = rise((s - side) / spread, 0.5)[0]
            if k < modules - 2:
                pixels[MODULES + k, n] = share
            if k > 0:
                pixels[MODULES + k - 1, n] -= share
