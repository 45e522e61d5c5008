"""Exact distances of straight segments to each other and to boxes, many at once."""

from __future__ import annotations

import numpy as np

from model.pose import Array


def segment_pair_points(
    start_a: Array, end_a: Array, start_b: Array, end_b: Array
) -> tuple[Array, Array]:
    """The nearest points of pairs of segments, shape (..., 3) each, [m].

    The nearest points are either inside both segments, where the joining line is perpendicular to
    both, or at an end of one of them; all five cases are tried and the nearest is taken, so that
    parallel and crossing segments need no tolerance.

    Args:
        start_a: Shape (..., 3), [m]; the others likewise.
        end_a: Other end of the first segment.
        start_b: Start of the second segment.
        end_b: Other end of the second segment.
    """
    along_a, along_b, gap = end_a - start_a, end_b - start_b, start_a - start_b
    aa, bb = _dot(along_a, along_a), _dot(along_b, along_b)
    ab, ag, bg = _dot(along_a, along_b), _dot(along_a, gap), _dot(along_b, gap)
    determinant = aa * bb - ab * ab
    inner = _clamped_ratio(ab * bg - bb * ag, determinant)
    zero, one = np.zeros_like(aa), np.ones_like(aa)
    # Each case: a point of the first segment, and the point of the second nearest to it; then two
    # ends of the second, and the point of the first nearest to them.
    a = np.stack([inner, zero, one, _clamped_ratio(-ag, aa), _clamped_ratio(ab - ag, aa)])
    to_inner, to_start, to_end = (_clamped_ratio(ab * s + bg, bb) for s in (inner, zero, one))
    b = np.stack([to_inner, to_start, to_end, zero, one])
    points_a = start_a + a[..., None] * along_a
    points_b = start_b + b[..., None] * along_b
    between = points_a - points_b
    best = np.argmin(_dot(between, between), axis=0)[None, ..., None]
    return np.take_along_axis(points_a, best, 0)[0], np.take_along_axis(points_b, best, 0)[0]


def segment_pair_distance(start_a: Array, end_a: Array, start_b: Array, end_b: Array) -> Array:
    """The distances of pairs of segments, shape (...), [m]; see `segment_pair_points`."""
    point_a, point_b = segment_pair_points(start_a, end_a, start_b, end_b)
    distance: Array = np.linalg.norm(point_a - point_b, axis=-1)
    return distance


def segment_box_points(start: Array, end: Array, half_size: Array) -> tuple[Array, Array]:
    """The nearest points of segments and a box about the origin, shape (..., 3) each, [m].

    Along a segment the squared distance to the box is convex and made of parabolas that meet where
    the segment crosses the planes of the box's faces; each parabola is minimised exactly.

    Args:
        start: Frame of the box, shape (..., 3), [m].
        end: Likewise.
        half_size: Half extents of the box, shape (3,), [m].

    Returns:
        The points on the segments and in the box; the same point where they touch.
    """
    along = end - start
    safe = np.where(along == 0.0, 1.0, along)
    crossings = np.concatenate([(half_size - start) / safe, (-half_size - start) / safe], axis=-1)
    moving = np.concatenate([along, along], axis=-1) != 0.0
    crossings = np.clip(np.where(moving, crossings, 0.0), 0.0, 1.0)
    knots = np.sort(np.concatenate([crossings, _ends(start)], axis=-1), axis=-1)
    low, high = knots[..., :-1], knots[..., 1:]
    middle = start[..., None, :] + ((low + high) / 2.0)[..., None] * along[..., None, :]
    face = np.where(np.abs(middle) > half_size, np.sign(middle) * half_size, np.nan)
    outside = np.isfinite(face)
    offset = np.where(outside, start[..., None, :] - face, 0.0)
    slope = np.where(outside, along[..., None, :], 0.0)
    lowest = np.clip(_ratio(-_dot(offset, slope), _dot(slope, slope), low), low, high)
    tried = np.concatenate([lowest, _ends(start)], axis=-1)
    on_segment = start[..., None, :] + tried[..., None] * along[..., None, :]
    in_box = np.clip(on_segment, -half_size, half_size)
    between = on_segment - in_box
    best = np.argmin(_dot(between, between), axis=-1)[..., None, None]
    return (
        np.take_along_axis(on_segment, best, -2)[..., 0, :],
        np.take_along_axis(in_box, best, -2)[..., 0, :],
    )


def _ends(start: Array) -> Array:
    return np.broadcast_to([0.0, 1.0], (*start.shape[:-1], 2))


def _dot(a: Array, b: Array) -> Array:
    product: Array = np.einsum("...i,...i", a, b)
    return product


def _ratio(numerator: Array, denominator: Array, otherwise: Array) -> Array:
    divisor = np.where(denominator > 0.0, denominator, 1.0)
    ratio: Array = np.where(denominator > 0.0, numerator / divisor, otherwise)
    return ratio


def _clamped_ratio(numerator: Array, denominator: Array) -> Array:
    clamped: Array = np.clip(_ratio(numerator, denominator, np.zeros_like(numerator)), 0.0, 1.0)
    return clamped
