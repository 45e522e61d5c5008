"""The distance of a segment to a box about the origin, in closed form.

Along the segment half the squared distance is convex, and its slope is piecewise linear with bends
where the segment crosses the planes of the faces. The bends are used to shut in the zero of the
slope, between two of which it is then found by one division.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel
from planner.exact.vectors import Vector, along, dot, minus


@kernel
def segment_box_squared(start: Vector, end: Vector, half: Vector) -> float:
    """Squared distance of a segment to the box |x| ≤ half, [m²]; 0 where they touch."""
    way = minus(end, start)
    low_slope = _slope(start, way, half, 0.0)
    if low_slope >= 0.0:
        return point_box_squared(start, half)
    high_slope = _slope(start, way, half, 1.0)
    if high_slope <= 0.0:
        return point_box_squared(end, half)
    low, high = 0.0, 1.0
    for axis in range(3):
        if way[axis] != 0.0:
            for face in (-half[axis], half[axis]):
                bend = (face - start[axis]) / way[axis]
                if low < bend < high:
                    slope = _slope(start, way, half, bend)
                    if slope < 0.0:
                        low, low_slope = bend, slope
                    else:
                        high, high_slope = bend, slope
    share = low - low_slope * (high - low) / (high_slope - low_slope)
    return point_box_squared(along(start, way, share), half)


@kernel
def point_box_squared(point: Vector, half: Vector) -> float:
    """Squared distance of a point to the box |x| ≤ half, [m²]."""
    away = _excess(point, half)
    return dot(away, away)


@kernel
def _slope(start: Vector, way: Vector, half: Vector, share: float) -> float:
    return dot(way, _excess(along(start, way, share), half))


@kernel
def _excess(point: Vector, half: Vector) -> Vector:
    """The vector from the nearest point of the box."""
    return (
        point[0] - min(max(point[0], -half[0]), half[0]),
        point[1] - min(max(point[1], -half[1]), half[1]),
        point[2] - min(max(point[2], -half[2]), half[2]),
    )


def segment_box_definition(
    start: NDArray[np.float64], end: NDArray[np.float64], half: NDArray[np.float64]
) -> float:
    """The same distance, [m], by trying each of the 27 regions about the box.

    Args:
        start: Box frame, shape (3,), [m].
        end: Likewise.
        half: Half extents of the box, shape (3,), [m].
    """
    way = end - start
    shares = [0.0, 1.0]
    for region in np.ndindex(3, 3, 3):
        side = np.array(region) - 1
        slope = np.where(side != 0, way, 0.0)
        offset = np.where(side != 0, start - side * half, 0.0)
        if slope @ slope > 0.0:
            shares.append(float(np.clip(-(offset @ slope) / (slope @ slope), 0.0, 1.0)))
    points = start + np.array(shares)[:, None] * way
    return float(np.min(np.linalg.norm(points - np.clip(points, -half, half), axis=1)))
