"""The distance of two convex hulls, one of them grown by a disc, with a plane as the proof.

Source: Gilbert, Johnson & Keerthi, "A fast procedure for computing the distance between complex
objects", 1988. Every step has a plane whose room between the hulls is a lower bound of the
distance, and a point of each hull whose distance is an upper bound. "Apart" always rests on a
plane; where round-off ends the search before either bound decides, the answer is "not apart".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.kernels.jit import kernel
from planner.kernels.primitives import Vector, dot, minus, norm, row

_STEPS = 200
_NO_GAIN = 1e-15
_ROUND_OFF = 1e-14
"""Sine of the angle below which a direction is the disc's axis, its part across it round-off."""

Points = NDArray[np.float64]


@kernel
def hulls_apart(first: Points, second: Points, axis: Vector, disc: float, needed: float) -> bool:
    """Whether two hulls are at least ``needed`` apart.

    Args:
        first: Points of the first hull, shape (k ≥ 1, 3), [m].
        second: Points of the second hull, shape (l ≥ 1, 3), [m].
        axis: Unit normal of the disc that the second is grown by.
        disc: Its radius, [m]; 0 for none.
        needed: Above 0, [m].
    """
    low, _ = hulls_distance(first, second, axis, disc, needed)
    return low >= needed


@kernel
def hulls_distance(
    first: Points, second: Points, axis: Vector, disc: float, enough: float
) -> tuple[float, float]:
    """Bounds of the distance of two hulls, [m]: room at a plane, and distance of two points.

    Args:
        first: Points of the first hull, shape (k ≥ 1, 3), [m].
        second: Points of the second hull, shape (l ≥ 1, 3), [m].
        axis: Unit normal of the disc that the second is grown by.
        disc: Its radius, [m]; 0 for none.
        enough: The search ends when either bound shows on which side of this the distance is;
            infinite for the distance itself, where the bounds meet up to round-off.
    """
    corners = np.empty((4, 3))
    count = 0
    between = minus(_centre(second), _centre(first))
    if norm(between) == 0.0:
        between = (0.0, 0.0, 1.0)
    length, low, high = norm(between), 0.0, np.inf
    for _ in range(_STEPS):
        normal = (between[0] / length, between[1] / length, between[2] / length)
        corner = minus(
            _nearest_along(second, axis, disc, normal),
            _farthest_along(first, normal),
        )
        low = max(low, dot(corner, normal))
        if low >= enough or low >= high:
            break
        corners[count] = corner
        count += 1
        between, count = nearest_of_simplex(corners, count)
        length = norm(between)
        if length >= high * (1.0 - _NO_GAIN):
            break
        high = length
        if count == 4 or length == 0.0:
            return 0.0, 0.0
        if math.isfinite(enough) and high < enough:
            break
    return low, high


@kernel
def _centre(points: Points) -> Vector:
    x, y, z = 0.0, 0.0, 0.0
    for i in range(len(points)):
        x, y, z = x + points[i, 0], y + points[i, 1], z + points[i, 2]
    return (x / len(points), y / len(points), z / len(points))


@kernel
def _farthest_along(points: Points, direction: Vector) -> Vector:
    best, found = -np.inf, 0
    for i in range(len(points)):
        reach = (
            points[i, 0] * direction[0] + points[i, 1] * direction[1] + points[i, 2] * direction[2]
        )
        if reach > best:
            best, found = reach, i
    return row(points, found)


@kernel
def _nearest_along(points: Points, axis: Vector, disc: float, direction: Vector) -> Vector:
    """The point of the grown hull that reaches least far along a direction."""
    best, found = np.inf, 0
    for i in range(len(points)):
        reach = (
            points[i, 0] * direction[0] + points[i, 1] * direction[1] + points[i, 2] * direction[2]
        )
        if reach < best:
            best, found = reach, i
    point = row(points, found)
    if disc == 0.0:
        return point
    across = _perpendicular(_perpendicular(direction, axis), axis)
    size = norm(across)
    if size <= _ROUND_OFF:
        return point
    shift = disc / size
    return (
        point[0] - shift * across[0],
        point[1] - shift * across[1],
        point[2] - shift * across[2],
    )


@kernel
def _perpendicular(direction: Vector, axis: Vector) -> Vector:
    part = dot(direction, axis)
    return (
        direction[0] - part * axis[0],
        direction[1] - part * axis[1],
        direction[2] - part * axis[2],
    )


@kernel
def nearest_of_simplex(corners: Points, count: int) -> tuple[Vector, int]:
    """The point of a simplex nearest to the origin; its supporting corners are moved first.

    Args:
        corners: Shape (4, 3), [m]; the first ``count`` are used. Changed in place.
        count: 1 to 4.

    Returns:
        The point, and the number of its supporting corners; 4 with the origin in a tetrahedron.
    """
    best, best_point = np.inf, (0.0, 0.0, 0.0)
    kept = (0, -1, -1)
    if count == 4 and _origin_inside(corners):
        return best_point, 4
    for i in range(count):
        point = row(corners, i)
        squared = dot(point, point)
        if squared < best:
            best, best_point, kept = squared, point, (i, -1, -1)
    for i in range(count):
        for j in range(i):
            share = _share_of_edge(row(corners, i), row(corners, j))
            if 0.0 < share < 1.0:
                point = _mixed(row(corners, i), row(corners, j), share)
                squared = dot(point, point)
                if squared < best:
                    best, best_point, kept = squared, point, (i, j, -1)
    for skipped in range(count if count == 4 else 1):
        if count < 3:
            break
        i, j, k = _others(skipped) if count == 4 else (0, 1, 2)
        inside, point = _foot_on_face(row(corners, i), row(corners, j), row(corners, k))
        if inside:
            squared = dot(point, point)
            if squared < best:
                best, best_point, kept = squared, point, (i, j, k)
    return best_point, _keep(corners, kept)


@kernel
def _others(skipped: int) -> tuple[int, int, int]:
    if skipped == 0:
        return (1, 2, 3)
    if skipped == 1:
        return (0, 2, 3)
    if skipped == 2:
        return (0, 1, 3)
    return (0, 1, 2)


@kernel
def _keep(corners: Points, kept: tuple[int, int, int]) -> int:
    first = row(corners, kept[0])
    second = row(corners, max(kept[1], 0))
    third = row(corners, max(kept[2], 0))
    corners[0], corners[1], corners[2] = first, second, third
    return 3 if kept[2] >= 0 else (2 if kept[1] >= 0 else 1)


@kernel
def _share_of_edge(start: Vector, end: Vector) -> float:
    delta = minus(end, start)
    length = dot(delta, delta)
    return -dot(start, delta) / length if length > 0.0 else -1.0


@kernel
def _mixed(start: Vector, end: Vector, share: float) -> Vector:
    rest = 1.0 - share
    return (
        rest * start[0] + share * end[0],
        rest * start[1] + share * end[1],
        rest * start[2] + share * end[2],
    )


@kernel
def _foot_on_face(a: Vector, b: Vector, c: Vector) -> tuple[bool, Vector]:
    """The foot of the perpendicular from the origin to a triangle, if inside it."""
    side, other = minus(b, a), minus(c, a)
    normal = (
        side[1] * other[2] - side[2] * other[1],
        side[2] * other[0] - side[0] * other[2],
        side[0] * other[1] - side[1] * other[0],
    )
    squared = dot(normal, normal)
    if squared == 0.0:
        return False, a
    u = _volume(normal, b, c) / squared
    v = _volume(normal, c, a) / squared
    w = _volume(normal, a, b) / squared
    whole = u + v + w
    if u < 0.0 or v < 0.0 or w < 0.0 or whole == 0.0:
        return False, a
    # As a convex combination, this is a point of the triangle however thin it is.
    return True, (
        (u * a[0] + v * b[0] + w * c[0]) / whole,
        (u * a[1] + v * b[1] + w * c[1]) / whole,
        (u * a[2] + v * b[2] + w * c[2]) / whole,
    )


@kernel
def _volume(a: Vector, b: Vector, c: Vector) -> float:
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@kernel
def _origin_inside(corners: Points) -> bool:
    """Whether the origin is strictly inside the tetrahedron, up to round-off."""
    a, b, c, d = row(corners, 0), row(corners, 1), row(corners, 2), row(corners, 3)
    whole = _volume(minus(b, a), minus(c, a), minus(d, a))
    if whole == 0.0:
        return False
    return (
        _volume(b, c, d) / whole > 0.0
        and -_volume(a, c, d) / whole > 0.0
        and _volume(a, b, d) / whole > 0.0
        and -_volume(a, b, c) / whole > 0.0
    )
