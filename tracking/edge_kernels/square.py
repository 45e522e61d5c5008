"""A tag's square in the picture: its edges' frames, and where its modules lie beside an edge."""

from __future__ import annotations

import math

from cdpr.compiled import compiled
from cdpr.poses import Array


@compiled
def edge_frame(quad: Array, edge: int) -> tuple[float, float, float, float, float]:
    """Start (x, y), unit direction (x, y) and length of an edge; outward is (y, -x) of it."""
    x, y = quad[edge, 0], quad[edge, 1]
    after = (edge + 1) % 4
    dx, dy = quad[after, 0] - x, quad[after, 1] - y
    length = max(math.hypot(dx, dy), 1e-6)
    return x, y, dx / length, dy / length, length


@compiled
def bow(shape: Array, share: float) -> float:
    """How far the curve of an edge lies outside of its chord, at a share of its length, [px]."""
    return float(share * (1.0 - share) * (shape[0] + share * shape[1]))


@compiled
def plane_of(quad: Array, edge: int, plane: Array) -> None:
    """Writes the map of places in the square to pixels, shape (8,).

    Places are (a, b) with a from 0 to 1 along the edge, b from 0 at the edge to 1 at the opposite.
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
    """A place of the square, as distances along and outside of an edge, [px]."""
    depth = plane[6] * a + plane[7] * b + 1.0
    x0, y0, ax, ay, _ = edge_frame(quad, edge)
    dx = (plane[0] * a + plane[1] * b + plane[2]) / depth - x0
    dy = (plane[3] * a + plane[4] * b + plane[5]) / depth - y0
    return dx * ax + dy * ay, dx * ay - dy * ax
