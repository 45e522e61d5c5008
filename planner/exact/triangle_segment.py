"""The distance of a triangle to a segment, in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.segment_pair import segment_pair_squared
from planner.exact.triangle_point import face_point_squared, triangle_point_definition
from planner.exact.vectors import Vector, along, cross, dot, minus


@kernel
def triangle_segment_squared(a: Vector, b: Vector, c: Vector, start: Vector, end: Vector) -> float:
    """Squared distance of the triangle a, b, c to a segment, [m²]; 0 where they cross.

    The nearest points lie on an edge and the segment, or on the face and an end, or are one.
    """
    normal = cross(minus(b, a), minus(c, a))
    first, last = dot(normal, minus(start, a)), dot(normal, minus(end, a))
    if first != last and min(first, last) <= 0.0 <= max(first, last):
        crossing = along(start, minus(end, start), first / (first - last))
        if face_point_squared(a, b, c, crossing) < np.inf:
            return 0.0
    return min(
        min(
            segment_pair_squared(a, b, start, end),
            segment_pair_squared(b, c, start, end),
            segment_pair_squared(c, a, start, end),
        ),
        min(face_point_squared(a, b, c, start), face_point_squared(a, b, c, end)),
    )


def triangle_segment_definition(
    corners: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> float:
    """The same distance, [m]: the least of a convex function of the place on the segment.

    Args:
        corners: Of the triangle, shape (3, 3), [m].
        start: Of the segment, shape (3,), [m].
        end: Likewise.
    """
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    low, high = 0.0, 1.0
    for _ in range(120):
        left, right = high - golden * (high - low), low + golden * (high - low)
        at_left, at_right = (
            triangle_point_definition(corners, start + s * (end - start)) for s in (left, right)
        )
        if at_left < at_right:
            high = right
        else:
            low = left
    middle = start + (low + high) / 2.0 * (end - start)
    ends = (triangle_point_definition(corners, p) for p in (start, middle, end))
    return min(ends)
