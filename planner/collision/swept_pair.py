"""One body against one piece of an obstacle along a translation, in closed form where one exists.

A cable with a point exit sweeps the triangle of its exit and its two anchor positions. The platform
sweeps the hull of its two positions. In the platform's frame the obstacle moves instead: a box
parallel to the platform becomes a segment against a larger box, a ball a segment and a capsule a
parallelogram against the platform. All else is the distance of two hulls.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.kernels.gjk import hulls_apart, hulls_distance
from planner.kernels.jit import kernel, leaf
from planner.kernels.primitives import (
    Vector,
    minus,
    plus,
    rotated,
    row,
    segment_box_squared,
    triangle_box_apart,
    triangle_box_squared,
    triangle_point_squared,
    triangle_segment_squared,
)
from planner.kernels.scene_arrays import (
    BOX,
    MESH,
    ROUND,
    World,
    ball,
    box_half,
    box_sum,
    centre,
    disc,
    disc_axis,
    half_size,
    in_frame,
)

Points = NDArray[np.float64]


@leaf
def box_apart(
    pieces: Points,
    cables: Points,
    bodies: Points,
    piece: int,
    body: int,
    start: Vector,
    end: Vector,
) -> bool:
    """`cable_apart` for a cable with a point exit and a box; the arrays are those of the world."""
    arm = (cables[body, 9], cables[body, 10], cables[body, 11])
    return triangle_box_apart(
        _in_box(pieces, piece, row(cables, body)),
        _in_box(pieces, piece, plus(start, arm)),
        _in_box(pieces, piece, plus(end, arm)),
        (pieces[piece, 12], pieces[piece, 13], pieces[piece, 14]),
        bodies[body, 0],
    )


@leaf
def _in_box(pieces: Points, piece: int, point: Vector) -> Vector:
    away = minus(point, (pieces[piece, 9], pieces[piece, 10], pieces[piece, 11]))
    return (
        pieces[piece, 0] * away[0] + pieces[piece, 1] * away[1] + pieces[piece, 2] * away[2],
        pieces[piece, 3] * away[0] + pieces[piece, 4] * away[1] + pieces[piece, 5] * away[2],
        pieces[piece, 6] * away[0] + pieces[piece, 7] * away[1] + pieces[piece, 8] * away[2],
    )


@leaf
def cable_apart(
    world: World, piece: int, exit: Vector, b: Vector, c: Vector, needed: float
) -> bool:
    """Whether the triangle of an exit and two anchors is ``needed`` [m] from a piece's surface."""
    kind = world.spans[piece, 0]
    if kind == BOX:
        origin = centre(world, piece)
        return triangle_box_apart(
            in_frame(world, piece, minus(exit, origin)),
            in_frame(world, piece, minus(b, origin)),
            in_frame(world, piece, minus(c, origin)),
            box_half(world, piece),
            needed + ball(world, piece),
        )
    if kind == ROUND:
        return cable_squared(world, piece, exit, b, c) >= (needed + ball(world, piece)) ** 2
    return _triangle_apart(world, piece, exit, b, c, needed)


@leaf
def platform_apart(world: World, piece: int, start: Vector, end: Vector, needed: float) -> bool:
    """Whether the platform stays ``needed`` [m] from a piece's surface between two positions."""
    if world.spans[piece, 0] == ROUND or world.pieces[piece, 15] > 0.0:
        return platform_squared(world, piece, start, end) >= (needed + ball(world, piece)) ** 2
    return _platform_hull_apart(world, piece, start, end, needed)


@leaf
def cable_distance(
    world: World, piece: int, exit: Vector, b: Vector, c: Vector, enough: float
) -> float:
    """Distance of the triangle to the piece's surface, [m]; 0 or less where they touch.

    Where it is ``enough`` or more, any value from ``enough`` may be returned.
    """
    kind = world.spans[piece, 0]
    if kind in (BOX, ROUND):
        return math.sqrt(cable_squared(world, piece, exit, b, c)) - ball(world, piece)
    return _triangle_distance(world, piece, exit, b, c, enough)


@leaf
def platform_distance(world: World, piece: int, start: Vector, end: Vector, enough: float) -> float:
    """Distance of the platform's path to the piece's surface, [m]; 0 or less where they touch.

    Where it is ``enough`` or more, any value from ``enough`` may be returned.
    """
    if world.spans[piece, 0] == ROUND or world.pieces[piece, 15] > 0.0:
        return math.sqrt(platform_squared(world, piece, start, end)) - ball(world, piece)
    return _platform_hull_distance(world, piece, start, end, enough)


@leaf
def cable_squared(world: World, piece: int, exit: Vector, b: Vector, c: Vector) -> float:
    """Squared distance of a triangle to a box, or to the axis of a round piece, [m²]."""
    if world.spans[piece, 0] == BOX:
        origin = centre(world, piece)
        return triangle_box_squared(
            in_frame(world, piece, minus(exit, origin)),
            in_frame(world, piece, minus(b, origin)),
            in_frame(world, piece, minus(c, origin)),
            box_half(world, piece),
        )
    first = world.spans[piece, 2]
    if world.spans[piece, 3] - first == 1:
        return triangle_point_squared(exit, b, c, row(world.points, first))
    ends = row(world.points, first), row(world.points, first + 1)
    return triangle_segment_squared(exit, b, c, ends[0], ends[1])


@leaf
def platform_squared(world: World, piece: int, start: Vector, end: Vector) -> float:
    """Squared distance of the platform's path to a parallel box or a round piece's axis, [m²]."""
    if world.spans[piece, 0] == BOX:
        origin = centre(world, piece)
        return segment_box_squared(
            in_frame(world, piece, minus(start, origin)),
            in_frame(world, piece, minus(end, origin)),
            box_sum(world, piece),
        )
    first = world.spans[piece, 2]
    last = world.spans[piece, 3] - 1
    half = half_size(world)
    a, b = _seen(world, first, start), _seen(world, first, end)
    if first == last:
        return segment_box_squared(a, b, half)
    c, d = _seen(world, last, end), _seen(world, last, start)
    return min(triangle_box_squared(a, b, c, half), triangle_box_squared(a, c, d, half))


@leaf
def _seen(world: World, point: int, position: Vector) -> Vector:
    """A point of the world in the frame of the platform at a position."""
    away, turn = minus(row(world.points, point), position), world.platform
    return (
        turn[0, 0] * away[0] + turn[1, 0] * away[1] + turn[2, 0] * away[2],
        turn[0, 1] * away[0] + turn[1, 1] * away[1] + turn[2, 1] * away[2],
        turn[0, 2] * away[0] + turn[1, 2] * away[1] + turn[2, 2] * away[2],
    )


@kernel
def _triangle_apart(
    world: World, piece: int, exit: Vector, b: Vector, c: Vector, needed: float
) -> bool:
    return points_apart(world, piece, _triangle(exit, b, c), needed)


@kernel
def _triangle_distance(
    world: World, piece: int, exit: Vector, b: Vector, c: Vector, enough: float
) -> float:
    return points_distance(world, piece, _triangle(exit, b, c), enough)


@kernel
def _platform_hull_apart(
    world: World, piece: int, start: Vector, end: Vector, needed: float
) -> bool:
    return points_apart(world, piece, platform_points(world, start, end), needed)


@kernel
def _platform_hull_distance(
    world: World, piece: int, start: Vector, end: Vector, enough: float
) -> float:
    return points_distance(world, piece, platform_points(world, start, end), enough)


@kernel
def _triangle(a: Vector, b: Vector, c: Vector) -> Points:
    swept = np.empty((3, 3))
    swept[0], swept[1], swept[2] = a, b, c
    return swept


@kernel
def platform_points(world: World, start: Vector, end: Vector) -> Points:
    """The corners of the platform at two positions, shape (16, 3), [m]."""
    swept = np.empty((16, 3))
    put_corners(world, world.platform[:3], start, swept[:8])
    put_corners(world, world.platform[:3], end, swept[8:])
    return swept


@kernel
def put_corners(world: World, rotation: Points, position: Vector, corners: Points) -> None:
    """Writes the corners of the platform at a pose into an array, shape (8, 3), [m]."""
    half = half_size(world)
    for corner in range(8):
        offset = (
            half[0] if corner & 1 else -half[0],
            half[1] if corner & 2 else -half[1],
            half[2] if corner & 4 else -half[2],
        )
        corners[corner] = plus(position, rotated(rotation, offset))


@kernel
def points_apart(world: World, piece: int, swept: Points, needed: float) -> bool:
    """Whether the hull of points is ``needed`` [m] from a piece's surface."""
    axis = disc_axis(world, piece)
    target = world.points[world.spans[piece, 2] : world.spans[piece, 3]]
    grown = needed + ball(world, piece)
    if hulls_apart(swept, target, axis, disc(world, piece), grown):
        return True
    if world.spans[piece, 0] != MESH:
        return False
    for t in range(world.spans[piece, 4], world.spans[piece, 5]):
        triangle = world.triangles[t]
        if _boxed_apart(swept, triangle, needed):
            continue
        if not hulls_apart(swept, triangle, axis, 0.0, needed):
            return False
    return True


@kernel
def points_distance(world: World, piece: int, swept: Points, enough: float) -> float:
    """Distance of the hull of points to a piece's surface, [m]; see `cable_distance`."""
    axis = disc_axis(world, piece)
    target = world.points[world.spans[piece, 2] : world.spans[piece, 3]]
    grown = ball(world, piece)
    if world.spans[piece, 0] != MESH:
        return _settled(swept, target, axis, disc(world, piece), enough + grown) - grown
    low, _ = hulls_distance(swept, target, axis, 0.0, enough)
    if low >= enough:
        return low
    least = enough
    for t in range(world.spans[piece, 4], world.spans[piece, 5]):
        triangle = world.triangles[t]
        if not _boxed_apart(swept, triangle, least):
            least = min(least, _settled(swept, triangle, axis, 0.0, least))
    return least


@kernel
def _settled(swept: Points, target: Points, axis: Vector, disc: float, enough: float) -> float:
    """The distance of two hulls, or where it is ``enough`` or more, a value from ``enough``."""
    low, _ = hulls_distance(swept, target, axis, disc, enough)
    if low >= enough:
        return low
    return hulls_distance(swept, target, axis, disc, np.inf)[0]


@kernel
def _boxed_apart(first: Points, second: Points, needed: float) -> bool:
    """Whether the axis-aligned bounding boxes of two sets of points prove them apart."""
    for axis in range(3):
        low, high = first[0, axis], first[0, axis]
        for i in range(1, len(first)):
            low, high = min(low, first[i, axis]), max(high, first[i, axis])
        other_low, other_high = second[0, axis], second[0, axis]
        for i in range(1, len(second)):
            other_low = min(other_low, second[i, axis])
            other_high = max(other_high, second[i, axis])
        if other_low - high >= needed or low - other_high >= needed:
            return True
    return False
