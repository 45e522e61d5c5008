"""Distances of segments, triangles, boxes and hulls by their definitions, which need no cases."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Points = NDArray[np.float64]


def segment_box_definition(start: Points, end: Points, half: Points) -> float:
    """The distance, [m], by trying each of the 27 regions about the box.

    Args:
        start: Box frame, shape (3,), [m].
        end: Box frame, shape (3,), [m].
        half: Half extents of the box, shape (3,), [m].
    """
    delta = end - start
    sides = np.array(list(np.ndindex(3, 3, 3))) - 1
    slopes = np.where(sides != 0, delta, 0.0)
    offsets = np.where(sides != 0, start - sides * half, 0.0)
    squares, falls = np.sum(slopes**2, axis=1), -np.sum(offsets * slopes, axis=1)
    within = np.clip(falls[squares > 0.0] / squares[squares > 0.0], 0.0, 1.0)
    points = start + np.array([0.0, 1.0, *within])[:, None] * delta
    return float(np.min(np.linalg.norm(points - np.clip(points, -half, half), axis=1)))


def triangle_point_definition(corners: Points, point: Points) -> float:
    """The distance, [m]: the least over face, edges and corners, each where it applies.

    Args:
        corners: Shape (3, 3), [m].
        point: Shape (3,), [m].
    """
    found = [float(np.min(np.linalg.norm(corners - point, axis=1)))]
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        delta = end - start
        if delta @ delta > 0.0:
            share = np.clip((point - start) @ delta / (delta @ delta), 0.0, 1.0)
            found.append(float(np.linalg.norm(start + share * delta - point)))
    sides = (corners[1:] - corners[0]).T
    shares = np.linalg.lstsq(sides, point - corners[0], rcond=None)[0]
    if np.all(shares >= 0.0) and shares.sum() <= 1.0:
        found.append(float(np.linalg.norm(corners[0] + sides @ shares - point)))
    return min(found)


def triangle_box_definition(corners: Points, half: Points) -> float:
    """The distance, [m], by trying every pair of features.

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
    vertices: Points,
) -> list[tuple[Points, Points]]:
    signs = np.sign(vertices)
    return [
        (vertices[i], vertices[j])
        for i in range(8)
        for j in range(i)
        if np.count_nonzero(signs[i] != signs[j]) == 1
    ]


def _crosses(corners: Points, start: Points, end: Points) -> bool:
    """Whether a segment passes through a triangle that is not coplanar with it."""
    matrix = np.column_stack([start - end, corners[1] - corners[0], corners[2] - corners[0]])
    if abs(np.linalg.det(matrix)) < 1e-300:
        return False
    share, first, second = np.linalg.solve(matrix, start - corners[0])
    return bool(0.0 <= share <= 1.0 and first >= 0.0 and second >= 0.0 and first + second <= 1.0)


def triangle_segment_definition(corners: Points, start: Points, end: Points) -> float:
    """The distance, [m]: the minimum of a convex function of position along the segment.

    Args:
        corners: Of the triangle, shape (3, 3), [m].
        start: Of the segment, shape (3,), [m].
        end: Of the segment, shape (3,), [m].
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


def hulls_definition(first: Points, second: Points) -> float:
    """The distance of two hulls of points, [m], as a quadratic program over their weights.

    Args:
        first: Shape (k, 3), [m].
        second: Shape (l, 3), [m].
    """
    # Weights u, v ≥ 0, each set summing to 1, with the smallest ‖uᵀ first − vᵀ second‖: the two
    # sums are rows of a least-squares problem, weighted so heavily that they hold to round-off.
    scale = 1e4 * max(1.0, float(np.abs(first).max()), float(np.abs(second).max()))
    count = len(first)
    matrix = np.zeros((5, count + len(second)))
    matrix[:3, :count], matrix[:3, count:] = first.T, -second.T
    matrix[3, :count], matrix[4, count:] = scale, scale
    weights = nnls(matrix, np.array([0.0, 0.0, 0.0, scale, scale]))[0]
    u, v = weights[:count], weights[count:]
    return float(np.linalg.norm(u @ first / u.sum() - v @ second / v.sum()))
