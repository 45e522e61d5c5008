"""The feasible tensions of a robot with two cables more than freedoms: a convex polygon.

Plain floats, not arrays: with at most two lines a cable the polygon has few corners, and an
array operation costs more than the whole clip of one line.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from math import hypot

Point = tuple[float, float]
HalfPlane = tuple[float, float, float]
"""(a, b, c) for the side ``a x + b y + c >= 0``."""

SMALLEST_AREA = 1e-12
"""Area by squared extent, under which a polygon is taken as a segment or a point."""


def square(reach: float) -> list[Point]:
    """Return the square |x|, |y| <= reach, counter-clockwise."""
    return [(-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)]


def clipped(polygon: list[Point], half_planes: Iterable[HalfPlane]) -> list[Point]:
    """Return what of the convex polygon lies in every half-plane; empty if nothing does."""
    for a, b, c in half_planes:
        sides = [a * x + b * y + c for x, y in polygon]
        if min(sides) >= 0.0:
            continue
        if max(sides) < 0.0:
            return []
        polygon = _cut(polygon, sides)
    return polygon


def _cut(polygon: list[Point], sides: list[float]) -> list[Point]:
    kept: list[Point] = []
    x0, y0 = polygon[-1]
    side0 = sides[-1]
    for (x1, y1), side1 in zip(polygon, sides, strict=True):
        if (side0 < 0.0) != (side1 < 0.0) and side0 != 0.0 and side1 != 0.0:
            part = side0 / (side0 - side1)
            kept.append((x0 + part * (x1 - x0), y0 + part * (y1 - y0)))
        if side1 >= 0.0:
            kept.append((x1, y1))
        x0, y0, side0 = x1, y1, side1
    return kept


def area_centroid(polygon: list[Point]) -> Point:
    """Return the centroid of the area; of a polygon without area, the middle of its length."""
    x0, y0 = polygon[0]
    doubled_area = sum_x = sum_y = extent = 0.0
    for (x1, y1), (x2, y2) in pairwise(polygon[1:]):
        ux, uy, vx, vy = x1 - x0, y1 - y0, x2 - x0, y2 - y0
        cross = ux * vy - uy * vx
        doubled_area += cross
        sum_x += cross * (ux + vx)
        sum_y += cross * (uy + vy)
        extent = max(extent, ux * ux + uy * uy, vx * vx + vy * vy)
    if doubled_area <= SMALLEST_AREA * extent:
        return _middle_of_length(polygon)
    return x0 + sum_x / (3.0 * doubled_area), y0 + sum_y / (3.0 * doubled_area)


def _middle_of_length(polygon: list[Point]) -> Point:
    """Return the middle between the two corners farthest apart."""
    pairs = ((p, q) for i, p in enumerate(polygon) for q in polygon[i:])
    (x1, y1), (x2, y2) = max(pairs, key=lambda pair: _distance(*pair))
    return (x1 + x2) / 2.0, (y1 + y2) / 2.0


def corner_mean(polygon: list[Point]) -> Point:
    """Return the mean of the corners, corners that coincide counted once."""
    extent = max(_distance(polygon[0], point) for point in polygon)
    corners: list[Point] = []
    for point in polygon:
        if all(_distance(point, other) > SMALLEST_AREA * extent for other in corners):
            corners.append(point)
    return sum(x for x, _ in corners) / len(corners), sum(y for _, y in corners) / len(corners)


def nearest_on_boundary(polygon: list[Point], target: Point) -> Point:
    """Return the point on the edges of the polygon nearest to the target."""
    x, y = target
    best, best_distance = polygon[0], _distance(polygon[0], target)
    x0, y0 = polygon[-1]
    for x1, y1 in polygon:
        ux, uy = x1 - x0, y1 - y0
        squared_length = ux * ux + uy * uy
        part = ((x - x0) * ux + (y - y0) * uy) / squared_length if squared_length else 0.0
        part = min(1.0, max(0.0, part))
        point = (x0 + part * ux, y0 + part * uy)
        distance = _distance(point, target)
        if distance < best_distance:
            best, best_distance = point, distance
        x0, y0 = x1, y1
    return best


def _distance(p: Point, q: Point) -> float:
    return hypot(p[0] - q[0], p[1] - q[1])
