"""What compiled code is built from: vectors of three floats as tuples, and random numbers.

Compiled code keeps such tuples in registers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.kernels.jit import kernel, leaf

Vector = tuple[float, float, float]


@kernel
def dot(a: Vector, b: Vector) -> float:
    """The scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def minus(a: Vector, b: Vector) -> Vector:
    """The difference a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def plus(a: Vector, b: Vector) -> Vector:
    """The sum a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def along(start: Vector, direction: Vector, share: float) -> Vector:
    """The point ``start + share * direction``."""
    return (
        start[0] + share * direction[0],
        start[1] + share * direction[1],
        start[2] + share * direction[2],
    )


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """The vector product."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@kernel
def norm(a: Vector) -> float:
    """The length."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@leaf
def row(array: NDArray[np.float64], index: int) -> Vector:
    """A row of an array, shape (k, 3)."""
    return (array[index, 0], array[index, 1], array[index, 2])


@leaf
def rotated(matrix: NDArray[np.float64], a: Vector) -> Vector:
    """The product of a matrix, shape (3, 3), and a vector."""
    return (
        matrix[0, 0] * a[0] + matrix[0, 1] * a[1] + matrix[0, 2] * a[2],
        matrix[1, 0] * a[0] + matrix[1, 1] * a[1] + matrix[1, 2] * a[2],
        matrix[2, 0] * a[0] + matrix[2, 1] * a[1] + matrix[2, 2] * a[2],
    )


# The distance of a segment to a box about the origin, in closed form.
#
# Along the segment, half the squared distance is convex and its slope piecewise linear, with bends
# where the segment crosses the planes of the faces. The bends bracket the zero of the slope, which
# one division then gives.


@kernel
def segment_box_squared(start: Vector, end: Vector, half: Vector) -> float:
    """Squared distance of a segment to the box |x| ≤ half, [m²]; 0 where they touch."""
    between = segment_box_between(start, end, half)
    return dot(between, between)


@kernel
def segment_box_between(start: Vector, end: Vector, half: Vector) -> Vector:
    """From the nearest point of the box |x| ≤ half to that of a segment, [m]; 0 where they touch.

    A plane normal to it separates the two.
    """
    delta = minus(end, start)
    low_slope = _slope(start, delta, half, 0.0)
    if low_slope >= 0.0:
        return _excess(start, half)
    high_slope = _slope(start, delta, half, 1.0)
    if high_slope <= 0.0:
        return _excess(end, half)
    low, high = 0.0, 1.0
    for axis in range(3):
        if delta[axis] != 0.0:
            for face in (-half[axis], half[axis]):
                bend = (face - start[axis]) / delta[axis]
                if low < bend < high:
                    slope = _slope(start, delta, half, bend)
                    if slope < 0.0:
                        low, low_slope = bend, slope
                    else:
                        high, high_slope = bend, slope
    share = low - low_slope * (high - low) / (high_slope - low_slope)
    return _excess(along(start, delta, share), half)


@kernel
def _slope(start: Vector, delta: Vector, half: Vector, share: float) -> float:
    return dot(delta, _excess(along(start, delta, share), half))


@kernel
def _excess(point: Vector, half: Vector) -> Vector:
    """The vector from the nearest point of the box."""
    return (
        point[0] - min(max(point[0], -half[0]), half[0]),
        point[1] - min(max(point[1], -half[1]), half[1]),
        point[2] - min(max(point[2], -half[2]), half[2]),
    )


# The distance of two segments, in closed form.


@kernel
def segment_pair_squared(p: Vector, q: Vector, r: Vector, s: Vector) -> float:
    """Squared distance of the segments p q and r s, [m²]."""
    between = segment_pair_between(p, q, r, s)
    return dot(between, between)


@kernel
def segment_pair_between(p: Vector, q: Vector, r: Vector, s: Vector) -> Vector:
    """From the nearest point of the segment p q to that of the segment r s, [m].

    The nearest points are an end of one and the point of the other nearest to it, or interior to
    both; all cases are tried, so parallel segments need no tolerance.
    """
    first, second, gap = minus(q, p), minus(s, r), minus(p, r)
    best = _to_segment(p, r, s)
    best = _shorter(best, _to_segment(q, r, s))
    best = _shorter(best, _back(_to_segment(r, p, q)))
    best = _shorter(best, _back(_to_segment(s, p, q)))
    aa, bb, ab = dot(first, first), dot(second, second), dot(first, second)
    determinant = aa * bb - ab * ab
    if determinant > 0.0:
        share = (ab * dot(second, gap) - bb * dot(first, gap)) / determinant
        if 0.0 < share < 1.0:
            best = _shorter(best, _to_segment(along(p, first, share), r, s))
    return best


@kernel
def _to_segment(point: Vector, start: Vector, end: Vector) -> Vector:
    """From a point to the nearest point of a segment."""
    delta, offset = minus(end, start), minus(point, start)
    length = dot(delta, delta)
    share = min(max(dot(delta, offset) / length, 0.0), 1.0) if length > 0.0 else 0.0
    return minus((share * delta[0], share * delta[1], share * delta[2]), offset)


@kernel
def _shorter(a: Vector, b: Vector) -> Vector:
    return a if dot(a, a) <= dot(b, b) else b


@kernel
def _back(a: Vector) -> Vector:
    return (-a[0], -a[1], -a[2])


# The distance of a triangle to a point, in closed form; exact for degenerate triangles too.


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
    delta, offset = minus(end, start), minus(point, start)
    length = dot(delta, delta)
    share = min(max(dot(delta, offset) / length, 0.0), 1.0) if length > 0.0 else 0.0
    away = minus(offset, (share * delta[0], share * delta[1], share * delta[2]))
    return dot(away, away)


@kernel
def face_point_squared(a: Vector, b: Vector, c: Vector, point: Vector) -> float:
    """Squared distance of a point to its foot on the triangle's face, [m²]; else infinity.

    Whatever round-off does to the shares, the foot is a point of the triangle, so the value is
    never below the true distance.
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


# The distance of a triangle to a box about the origin, in closed form.
#
# The nearest point of the triangle is on an edge (three segments against the box) or in its
# interior. In the interior, either the box lies wholly on one side of the triangle's plane, and its
# nearest point is the corner nearest to that plane; or the plane cuts the box and, since no edge of
# the triangle touches it, the cut lies wholly inside the triangle. In either case one point of the
# box decides: the point nearest to the plane on the diagonal most inclined to it.


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

    The side of c and a comes first: when a search tests an edge, it is the cable at the far end,
    which is most often the one that touches.
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
    """Squared distance of the triangle's interior to the box if that is the least; else more."""
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


# The distance of a triangle to a segment, in closed form.


@kernel
def triangle_segment_squared(a: Vector, b: Vector, c: Vector, start: Vector, end: Vector) -> float:
    """Squared distance of the triangle a, b, c to a segment, [m²]; 0 where they cross.

    The nearest points lie on an edge and the segment, or on the face and an end, or coincide.
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


# Random numbers for compiled searches: one word of state, the same on every machine.
# Source: Steele, Lea & Flood, "Fast splittable pseudorandom number generators", 2014 (SplitMix64).

RandomState = NDArray[np.uint64]

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_UNIT = 2.0**-53


def seeded(seed: int) -> RandomState:
    """The state for a seed, shape (1,); kernels advance it in place."""
    return np.array([seed % 2**64], dtype=np.uint64)


@leaf
def uniform(state: RandomState) -> float:
    """A number in [0, 1)."""
    state[0] += _GAMMA
    mixed = state[0]
    mixed = (mixed ^ (mixed >> np.uint64(30))) * _FIRST
    mixed = (mixed ^ (mixed >> np.uint64(27))) * _SECOND
    mixed = mixed ^ (mixed >> np.uint64(31))
    return float(mixed >> np.uint64(11)) * _UNIT


@leaf
def below(state: RandomState, count: int) -> int:
    """A whole number in 0 … count - 1."""
    return int(uniform(state) * count)


@leaf
def direction(state: RandomState) -> Vector:
    """A unit vector, uniform on the sphere."""
    height = 2.0 * uniform(state) - 1.0
    turn = 2.0 * math.pi * uniform(state)
    radius = math.sqrt(max(0.0, 1.0 - height * height))
    return (radius * math.cos(turn), radius * math.sin(turn), height)
