"""The distance of two segments, in closed form; its definition is `cdpr.segments`."""

from __future__ import annotations

from planner.exact.compiled import kernel
from planner.exact.vectors import Vector, along, dot, minus


@kernel
def segment_pair_squared(p: Vector, q: Vector, r: Vector, s: Vector) -> float:
    """Squared distance of the segments p q and r s, [m²]."""
    between = segment_pair_between(p, q, r, s)
    return dot(between, between)


@kernel
def segment_pair_between(p: Vector, q: Vector, r: Vector, s: Vector) -> Vector:
    """From the nearest point of the segment p q to that of the segment r s, [m].

    The nearest points are an end of one and the point of the other nearest to it, or they are
    inside both; all cases are tried, so that parallel segments need no tolerance.
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
    way, offset = minus(end, start), minus(point, start)
    length = dot(way, way)
    share = min(max(dot(way, offset) / length, 0.0), 1.0) if length > 0.0 else 0.0
    return minus((share * way[0], share * way[1], share * way[2]), offset)


@kernel
def _shorter(a: Vector, b: Vector) -> Vector:
    return a if dot(a, a) <= dot(b, b) else b


@kernel
def _back(a: Vector) -> Vector:
    return (-a[0], -a[1], -a[2])
