"""Brightness model of the pixels on both sides of an edge.

Near a blurred edge are the square's two neighbouring edges, the modules inside it, and whatever is
beyond the white border: all within reach of the blur if modules are small or the blur is wide.

Brightness of paper and ink is linear along the edge, with the blurred step between; where the blur
reaches them, modules inside and surroundings outside are added.
"""

from __future__ import annotations

import math

import numpy as np

from model.jit import compiled
from model.pose import Array
from tracking.camera_model import Image

# Geometry of a tag's square in the image: frames of its edges, positions of its modules.


@compiled
def edge_frame(quad: Array, edge: int) -> tuple[float, float, float, float, float]:
    """Start (x, y), unit direction (x, y) and length of an edge; (y, -x) points outward."""
    x, y = quad[edge, 0], quad[edge, 1]
    after = (edge + 1) % 4
    dx, dy = quad[after, 0] - x, quad[after, 1] - y
    length = max(math.hypot(dx, dy), 1e-6)
    return x, y, dx / length, dy / length, length


@compiled
def bow(shape: Array, share: float) -> float:
    """Distance of an edge's curve outside its chord, at a share of its length, [px]."""
    return float(share * (1.0 - share) * (shape[0] + share * shape[1]))


@compiled
def plane_of(quad: Array, edge: int, plane: Array) -> None:
    """Writes the homography from square coordinates to pixels, shape (8,).

    Coordinates are (a, b): a from 0 to 1 along the edge, b from 0 at the edge to 1 at the opposite.
    """
    x0, y0 = quad[edge, 0], quad[edge, 1]
    x1, y1 = quad[(edge + 1) % 4, 0], quad[(edge + 1) % 4, 1]
    x2, y2 = quad[(edge + 2) % 4, 0], quad[(edge + 2) % 4, 1]
    x3, y3 = quad[(edge + 3) % 4, 0], quad[(edge + 3) % 4, 1]
    ax, ay, bx, by = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    sx, sy = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    area = ax * by - bx * ay
    along, across = (sx * by - bx * sy) / area, (ax * sy - sx * ay) / area
    plane[0], plane[1], plane[2] = x1 - x0 + along * x1, x3 - x0 + across * x3, x0
    plane[3], plane[4], plane[5] = y1 - y0 + along * y1, y3 - y0 + across * y3, y0
    plane[6], plane[7] = along, across


@compiled
def beside(quad: Array, edge: int, plane: Array, a: float, b: float) -> tuple[float, float]:
    """Distances of a point (a, b) of the square along and outside an edge, [px]."""
    depth = plane[6] * a + plane[7] * b + 1.0
    x0, y0, ax, ay, _ = edge_frame(quad, edge)
    dx = (plane[0] * a + plane[1] * b + plane[2]) / depth - x0
    dy = (plane[3] * a + plane[4] * b + plane[5]) / depth - y0
    return dx * ax + dy * ay, dx * ay - dy * ax


# Properties of one edge, as columns of an array.
#
# Positions on an edge are given by q, from -1 at the first pixel read to 1 at the last one.


OFFSET = 0
"""Offset of the edge outward from its expected position, at q = 0, [px]."""
TILT = 1
"""Change of the offset from q = 0 to q = 1, [px]."""
SPREAD = 2
"""Standard deviation of the blur across the edge, pixels included, [px]."""
BOXED = 3
"""Shape of the blur: 0 Gaussian (lens), 1 box (motion, or one pixel along the grid)."""
MIDDLE = 4
"""Distance of q = 0 from the edge's first corner, [px]."""
HALF = 5
"""Half of the length read: from q = 0 to q = 1, [px]."""
OFFSET_VARIANCE = 6
COVARIANCE = 7
TILT_VARIANCE = 8
SHARE = 9
"""Share of the edge that fits the model."""
HIDDEN = 10
"""Share of the step from ink to paper above the pixels' saturation."""
COLUMNS = 11


# Brightness profile across a blurred edge.


#: Beyond this many standard deviations a blurred edge is flat.
FLAT = 4.5
_STEPS = 64  # of the table per standard deviation
_ROOT_3 = math.sqrt(3.0)


def _bell_table() -> Array:
    """Integral and density of the Gaussian at the table's steps, shape (n, 2)."""
    x = np.arange(-FLAT * _STEPS, FLAT * _STEPS + 1.0) / _STEPS
    share = [0.5 + 0.5 * math.erf(v / math.sqrt(2.0)) for v in x.tolist()]
    return np.column_stack([share, np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)])


_BELL = _bell_table()


@compiled
def blurred_step(x: float, boxed: float) -> tuple[float, float, float]:
    """Share of the step at ``x`` standard deviations past the edge, to 1e-10.

    A mixture of steps blurred by a Gaussian and by a box of equal deviation. As it is symmetric, no
    symmetric blur biases an edge fitted with it.

    Returns:
        The share (0 dark, 1 bright), its derivative by ``x`` (to 1e-7), and by ``boxed``.
    """
    if x <= -FLAT:
        return 0.0, 0.0, 0.0
    if x >= FLAT:
        return 1.0, 0.0, 0.0
    step = int((x + FLAT) * _STEPS + 0.5)
    near = step / _STEPS - FLAT
    d, height = x - near, _BELL[step, 1]
    half, bend = 0.5 * d * d, near * near - 1.0
    bell = _BELL[step, 0] + height * (d - half * near + half * d * bend / 3.0)  # Taylor's series
    bell_slope = height * (1.0 - near * d + bend * half)
    box, box_slope = 0.0, 0.0
    if x >= _ROOT_3:
        box = 1.0
    elif x > -_ROOT_3:
        box, box_slope = 0.5 + x / (2.0 * _ROOT_3), 0.5 / _ROOT_3
    more = box - bell
    return bell + boxed * more, bell_slope + boxed * (box_slope - bell_slope), more


#: Rows of the pixel array; from `MODULES` on, the share of each module along the edge.
ALONG, ACROSS, VALUE, INK, WITHIN, BEYOND, MODULES = range(7)


@compiled
def sample_edge(
    image: Image,
    quad: Array,
    edge: int,
    shape: Array,
    span: tuple[float, float],
    reach: float,
    pixels: Array,
) -> int:
    """Reads the pixels within ``reach`` of an edge and within a span along it.

    Args:
        quad: Corners, shape (4, 2), [px].
        edge: Index of the edge.
        shape: Coefficients of the edge's bow.
        span: Along the edge, [px].
        reach: On both sides, [px].
        pixels: Rows `ALONG`, `ACROSS` and `VALUE` are written, shape (k, n).

    Returns:
        Number of pixels; limited by the size of ``pixels``, then evenly spread along the edge.
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
            pixels[ALONG, count] = (s - middle) / half
            pixels[ACROSS, count] = dx * ay - dy * ax - bow(shape, s / length)
            pixels[VALUE, count] = image[row, column]
            count += 1
    return count


@compiled
def _within(factor: float, start: float, low: float, high: float) -> tuple[float, float]:
    """Interval of x in which ``factor * x + start`` is between two limits."""
    if abs(factor) < 1e-9:
        return (-1e9, 1e9) if low <= start <= high else (1e9, -1e9)
    one, other = (low - start) / factor, (high - start) / factor
    return min(one, other), max(one, other)


@compiled
def write_ink(
    quad: Array, edge: int, pixels: Array, count: int, found: Array, spread: float
) -> None:
    """Writes the share of ink that the blurred neighbouring edges leave near an edge.

    Args:
        quad: Corners, shape (4, 2), [px].
        edge: Index of the edge.
        pixels: Row `INK` is written.
        found: Columns of the edge, with the span read.
        spread: Of the neighbouring edges' blur, [px].
    """
    _, _, ax, ay, length = edge_frame(quad, edge)
    _, _, bx, by, _ = edge_frame(quad, (edge + 3) % 4)
    _, _, cx, cy, _ = edge_frame(quad, (edge + 1) % 4)
    for n in range(count):
        s, u = found[MIDDLE] + found[HALF] * pixels[ALONG, n], pixels[ACROSS, n]
        dx, dy = s * ax + u * ay, s * ay - u * ax
        before = dy * bx - dx * by
        after = (dy - length * ay) * cx - (dx - length * ax) * cy
        ink = blurred_step(before / spread, 0.5)[0]
        pixels[INK, n] = ink * blurred_step(after / spread, 0.5)[0]


@compiled
def write_modules(
    quad: Array,
    edge: int,
    plane: Array,
    modules: int,
    pixels: Array,
    count: int,
    found: Array,
    spread: float,
) -> None:
    """Writes the shares of modules inside and surroundings outside an edge.

    Args:
        quad: Corners, shape (4, 2), [px].
        edge: Index of the edge.
        plane: Homography from square coordinates to pixels.
        modules: Along the side of the square.
        pixels: Rows `WITHIN`, `BEYOND` and those from `MODULES` on are written.
        found: Columns of the edge, with the span read.
        spread: Of the neighbouring edges' blur, [px].
    """
    module = 1.0 / modules
    s0, u0 = beside(quad, edge, plane, module, module)
    s1, u1 = beside(quad, edge, plane, 1.0 - module, module)
    s2, u2 = beside(quad, edge, plane, 0.0, -module)
    s3, u3 = beside(quad, edge, plane, 1.0, -module)
    for n in range(count):
        s, u = found[MIDDLE] + found[HALF] * pixels[ALONG, n], pixels[ACROSS, n]
        pixels[WITHIN, n] = u - u0 - (u1 - u0) * (s - s0) / (s1 - s0)
        pixels[BEYOND, n] = u - u2 - (u3 - u2) * (s - s2) / (s3 - s2)
    for k in range(modules - 1):
        # Sides of modules are taken slightly inside the square.
        side, _ = beside(quad, edge, plane, (k + 1) * module, 1.25 * module)
        for n in range(count):
            s = found[MIDDLE] + found[HALF] * pixels[ALONG, n]
            share = blurred_step((s - side) / spread, 0.5)[0]
            if k < modules - 2:
                pixels[MODULES + k, n] = share
            if k > 0:
                pixels[MODULES + k - 1, n] -= share


# Residuals of the pixels near an edge.


#: Parameters are the first columns of an edge; ink and paper at its middle and their slopes along
#: it; and for a crowded edge the contributions of surroundings and of each module inside.
DARK, DARK_SLOPE, BRIGHT, BRIGHT_SLOPE, BEYOND_PAPER, INNER = 4, 5, 6, 7, 8, 9


WHITE = 254.5
"""Brighter pixels are clipped, [grey levels]."""


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
    """Sums residuals and their derivatives by the parameters, for each part of an edge.

    Args:
        pixels: Rows as in `tracking.edges.sampling`.
        count: Of the pixels.
        parameters: Shape (p,); 8, or more for a crowded edge.
        normals: Written, lower halves, shape (b, p, p).
        gradients: Written, shape (b, p).
        squares: Sums of squared residuals, written, shape (b,).
        counts: Numbers of pixels, written, shape (b,).
    """
    parts, size = len(counts), len(parameters)
    normals[:, :, :] = 0.0
    gradients[:, :] = 0.0
    squares[:] = 0.0
    counts[:] = 0.0
    change = np.empty(size)
    for n in range(count):
        error = _error(pixels, n, parameters, change)
        part = min(max(int(0.5 * (pixels[ALONG, n] + 1.0) * parts), 0), parts - 1)
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
    """Measured minus modelled brightness of a pixel; writes the model's derivatives."""
    q, ink, spread = pixels[ALONG, n], pixels[INK, n], parameters[SPREAD]
    dark = parameters[DARK] + parameters[DARK_SLOPE] * q
    bright = parameters[BRIGHT] + parameters[BRIGHT_SLOPE] * q
    shift = parameters[OFFSET] + parameters[TILT] * q
    x = (pixels[ACROSS, n] - shift) / spread
    share, slope, kind = blurred_step(x, parameters[BOXED])
    black = (1.0 - share) * ink
    step = (bright - dark) * ink
    change[OFFSET], change[TILT] = -step * slope / spread, -step * slope / spread * q
    change[SPREAD], change[BOXED] = -step * slope * x / spread, step * kind
    change[DARK], change[DARK_SLOPE] = black, black * q
    change[BRIGHT], change[BRIGHT_SLOPE] = 1.0 - black, (1.0 - black) * q
    value = bright - (bright - dark) * black
    if len(parameters) > BEYOND_PAPER:
        value += _surroundings(pixels, n, shift, parameters, change)
    if pixels[VALUE, n] >= WHITE and value >= WHITE:  # clipped: at least this bright
        change[:] = 0.0
        return 0.0
    return float(pixels[VALUE, n] - value)


@compiled
def _surroundings(pixels: Array, n: int, shift: float, parameters: Array, change: Array) -> float:
    """Contribution of the surroundings and of the modules inside to a pixel's brightness."""
    spread, boxed = parameters[SPREAD], parameters[BOXED]
    x = pixels[BEYOND, n] / spread
    share, slope, kind = blurred_step(x, boxed)
    beyond = parameters[BEYOND_PAPER]
    value = beyond * share
    change[BEYOND_PAPER] = share
    change[SPREAD] -= beyond * slope * x / spread
    change[BOXED] += beyond * kind
    x = (pixels[WITHIN, n] - shift) / spread
    share, slope, kind = blurred_step(x, boxed)
    modules = 0.0
    for k in range(len(parameters) - INNER):
        part = pixels[MODULES + k, n]
        modules += parameters[INNER + k] * part
        change[INNER + k] = (1.0 - share) * part
    change[SPREAD] += modules * slope * x / spread
    change[BOXED] -= modules * kind
    return float(value + modules * (1.0 - share))
