"""The distance of a triangle to a box about the origin, in closed form.

The nearest points are either on an edge of the triangle (three segments against the box), or the
triangle's is in its inside; then the box lies wholly on one side of the triangle's plane and its
nearest point is the corner nearest to that plane, or the plane cuts the box and, since no edge of
the triangle touches it, the cut lies wholly inside the triangle. In either case one point of the
box decides: the one where the diagonal that leaves the plane fastest comes nearest to the plane.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.segment_box import segment_box_definition, segment_box_squared
from planner.exact.triangle_point import face_point_squared, triangle_point_definition
from planner.exact.vectors import Vector, cross, dot, minus


@kernel
def triangle_box_squared(a: Vector, b: Vector, c: Vector, half: Vector) -> float:
    """Squared distance of the triangle a, b, c to the box |x| ≤ half, [m²]; 0 where they touch."""
    edges = min(
        segment_box_squared(a, b, half),
        segment_box_squared(b, c, half),
        segment_box_squared(c, a, half),
    )
    return min(edges, _face_box_squared(a, b, c, half))


@kernel
def triangle_box_apart(a: Vector, b: Vector, c: Vector, half: Vector, needed: float) -> bool:
    """Whether triangle and box are at least ``needed`` apart, [m].

    The side of c and a comes first: where a search asks for a way to somewhere, it is the cable at
    its end, which most often is the one in the way.
    """
    squared = needed * needed
    return (
        segment_box_squared(c, a, half) >= squared
        and segment_box_squared(b, c, half) >= squared
        and segment_box_squared(a, b, half) >= squared
        and _face_box_squared(a, b, c, half) >= squared
    )


@kernel
def _face_box_squared(a: Vector, b: Vector, c: Vector, half: Vector) -> float:
    """Squared distance of the triangle's inside to the box, where it is the least; else more."""
    normal = cross(minus(b, a), minus(c, a))
    reach = abs(normal[0]) * half[0] + abs(normal[1]) * half[1] + abs(normal[2]) * half[2]
    if reach == 0.0:
        return np.inf
    share = min(max(dot(normal, a) / reach, -1.0), 1.0)
    corner = (
        share * half[0] if normal[0] >= 0.0 else -share * half[0],
        share * half[1] if normal[1] >= 0.0 else -share * half[1],
        share * half[2] if normal[2] >= 0.0 else -share * half[2],
    )
    return face_point_squared(a, b, c, corner)


def triangle_box_definition(corners: NDArray[np.float64], half: NDArray[np.float64]) -> float:
    """The same distance, [m], by trying every pair of features.

    Args:
        corners: Box frame, shape (3, 3), [m].
        half: Half extents of the box, shape (3,), [m].
    """
    sides = list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    found = [segment_box_definition(start, end, half) for start, end in sides]
    vertices = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    found += [triangle_point_definition(corners, vertex) for vertex in vertices]
    if any(_crosses(corners, *edge) for edge in _box_edges(vertices)):
        return 0.0
    return min(found)


def _box_edges(
    vertices: NDArray[np.float64],
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    signs = np.sign(vertices)
    return [
        (vertices[i], vertices[j])
        for i in range(8)
        for j in range(i)
        if np.count_nonzero(signs[i] != signs[j]) == 1
    ]


def _crosses(
    corners: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> bool:
    """Whether a segment passes through a triangle that is not in one plane with it."""
    matrix = np.column_stack([start - end, corners[1] - corners[0], corners[2] - corners[0]])
    if abs(np.linalg.det(matrix)) < 1e-300:
        return False
    share, first, second = np.linalg.solve(matrix, start - corners[0])
    return bool(0.0 <= share <= 1.0 and first >= 0.0 and second >= 0.0 and first + second <= 1.0)
