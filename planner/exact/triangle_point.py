"""The distance of a triangle to a point, in closed form; exact for triangles without area too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.vectors import Vector, along, dot, minus


@kernel
def triangle_point_squared(a: Vector, b: Vector, c: Vector, point: Vector) -> float:
    """Squared distance of the triangle a, b, c to a point, [m²]."""
    edges = min(
        segment_point_squared(a, b, point),
        segment_point_squared(b, c, point),
        segment_point_squared(c, a, point),
    )
    return min(edges, face_point_squared(a, b, c, point))


@kernel
def segment_point_squared(start: Vector, end: Vector, point: Vector) -> float:
    """Squared distance of a segment to a point, [m²]."""
    way, offset = minus(end, start), minus(point, start)
    length = dot(way, way)
    share = min(max(dot(way, offset) / length, 0.0), 1.0) if length > 0.0 else 0.0
    away = minus(offset, (share * way[0], share * way[1], share * way[2]))
    return dot(away, away)


@kernel
def face_point_squared(a: Vector, b: Vector, c: Vector, point: Vector) -> float:
    """Squared distance of a point to its foot on the triangle's face, [m²]; else infinity.

    The foot is a point of the triangle whatever round-off does to the shares, so that the value
    is never below the true distance.
    """
    side, other, offset = minus(b, a), minus(c, a), minus(point, a)
    aa, ab, bb = dot(side, side), dot(side, other), dot(other, other)
    determinant = aa * bb - ab * ab
    if determinant <= 0.0:
        return np.inf
    ao, bo = dot(side, offset), dot(other, offset)
    first = (bb * ao - ab * bo) / determinant
    second = (aa * bo - ab * ao) / determinant
    if first < 0.0 or second < 0.0 or first + second > 1.0:
        return np.inf
    away = minus(point, along(along(a, side, first), other, second))
    return dot(away, away)


def triangle_point_definition(corners: NDArray[np.float64], point: NDArray[np.float64]) -> float:
    """The same distance, [m]: the least over face, edges and corners, each where it applies.

    Args:
        corners: Shape (3, 3), [m].
        point: Shape (3,), [m].
    """
    found = [float(np.min(np.linalg.norm(corners - point, axis=1)))]
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        way = end - start
        if way @ way > 0.0:
            share = np.clip((point - start) @ way / (way @ way), 0.0, 1.0)
            found.append(float(np.linalg.norm(start + share * way - point)))
    sides = (corners[1:] - corners[0]).T
    shares = np.linalg.lstsq(sides, point - corners[0], rcond=None)[0]
    if np.all(shares >= 0.0) and shares.sum() <= 1.0:
        found.append(float(np.linalg.norm(corners[0] + sides @ shares - point)))
    return min(found)
