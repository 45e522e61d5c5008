"""Exact distances: of straight segments and boxes, many at once, and of two convex bodies.

Distances of segments are in closed form. Those of convex bodies come from FCL and are proved by a
separating plane: FCL is nearly always right to round-off, but about once in a thousand cases wrong
by millimetres to the unsafe side, so every distance is verified. FCL's two nearest points give a
direction, and along any direction the gap between the bodies' extents (their support functions, in
closed form) is at most the distance: a gap as large as FCL's distance proves it. Where the proof
fails, the distance is recomputed by a min-norm-point search (Wolfe) with the same proof as its
stopping rule.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import fcl
import numpy as np

from model.errors import Fault
from model.pose import Array, Pose
from model.shapes import (
    Box,
    Capsule,
    ConvexHull,
    Cylinder,
    Shape,
    Sphere,
    TriangleMesh,
    shape_points,
)


def segment_pair_points(
    start_a: Array, end_a: Array, start_b: Array, end_b: Array
) -> tuple[Array, Array]:
    """The nearest points of pairs of segments, shape (..., 3) each, [m].

    The nearest points are either interior to both segments, where the joining line is perpendicular
    to both, or an end of one of them; all five cases are tried, so parallel and crossing segments
    need no tolerance.

    Args:
        start_a: Start of the first segment.
        end_a: End of the first segment.
        start_b: Start of the second segment.
        end_b: End of the second segment.
    """
    along_a, along_b, gap = end_a - start_a, end_b - start_b, start_a - start_b
    aa, bb = _dot(along_a, along_a), _dot(along_b, along_b)
    ab, ag, bg = _dot(along_a, along_b), _dot(along_a, gap), _dot(along_b, gap)
    determinant = aa * bb - ab * ab
    inner = _clamped_ratio(ab * bg - bb * ag, determinant)
    zero, one = np.zeros_like(aa), np.ones_like(aa)
    # Each case: a point of the first segment, and the point of the second nearest to it; then two
    # ends of the second, and the point of the first nearest to them.
    a = np.array([inner, zero, one, _clamped_ratio(-ag, aa), _clamped_ratio(ab - ag, aa)])
    to_inner, to_start, to_end = (_clamped_ratio(ab * s + bg, bb) for s in (inner, zero, one))
    b = np.array([to_inner, to_start, to_end, zero, one])
    between = gap + a[..., None] * along_a - b[..., None] * along_b
    best = np.argmin(_dot(between, between), axis=0)
    return (
        start_a + np.choose(best, a)[..., None] * along_a,
        start_b + np.choose(best, b)[..., None] * along_b,
    )


def segment_box_points(start: Array, end: Array, half_size: Array) -> tuple[Array, Array]:
    """The nearest points of segments and a box about the origin, shape (..., 3) each, [m].

    Along a segment the squared distance to the box is convex and piecewise quadratic, with knots
    where the segment crosses the planes of the box's faces; each piece is minimised exactly.

    Args:
        start: Frame of the box, shape (..., 3), [m].
        end: Frame of the box, shape (..., 3), [m].
        half_size: Half extents of the box, shape (3,), [m].

    Returns:
        The points on the segments and in the box; the same point where they touch.
    """
    along = end - start
    safe = np.where(along == 0.0, 1.0, along)
    knots, tried = np.zeros((*start.shape[:-1], 8)), np.zeros((*start.shape[:-1], 9))
    for face, first in ((half_size, 0), (-half_size, 3)):
        knots[..., first : first + 3] = np.where(along != 0.0, (face - start) / safe, 0.0)
    knots = _clamped(knots, 0.0, 1.0)
    knots[..., 7] = tried[..., 8] = 1.0
    knots.sort(axis=-1)
    low, high = knots[..., :-1], knots[..., 1:]
    middle = start[..., None, :] + ((low + high) / 2.0)[..., None] * along[..., None, :]
    outside = np.abs(middle) > half_size
    offset = np.where(outside, start[..., None, :] - np.sign(middle) * half_size, 0.0)
    slope = np.where(outside, along[..., None, :], 0.0)
    lowest = _ratio(-_dot(offset, slope), _dot(slope, slope), low)
    tried[..., :7] = _clamped(lowest, low, high)
    on_segment = start[..., None, :] + tried[..., None] * along[..., None, :]
    between = on_segment - _clamped(on_segment, -half_size, half_size)
    best = np.argmin(_dot(between, between), axis=-1)
    nearest = start + np.take_along_axis(tried, best[..., None], -1) * along
    return nearest, _clamped(nearest, -half_size, half_size)


def _dot(a: Array, b: Array) -> Array:
    product: Array = np.einsum("...i,...i", a, b)
    return product


def _ratio(numerator: Array, denominator: Array, otherwise: Array) -> Array:
    divisor = np.where(denominator > 0.0, denominator, 1.0)
    ratio: Array = np.where(denominator > 0.0, numerator / divisor, otherwise)
    return ratio


def _clamped_ratio(numerator: Array, denominator: Array) -> Array:
    return _clamped(_ratio(numerator, denominator, np.zeros_like(numerator)), 0.0, 1.0)


def _clamped(values: Array, low: Array | float, high: Array | float) -> Array:
    """As np.clip, which takes several times as long for a few values."""
    clamped: Array = np.minimum(np.maximum(values, low), high)
    return clamped


# Convex bodies, and the distance of two of them with a separating plane as its proof.


#: A distance is proved when the separating plane's gap falls short of it by at most this, [m].
PROOF_TOLERANCE = 1e-7
#: Radius of the capsule or ball that represents a segment or point in FCL, [m]; far below the
#: proof's tolerance, and the proof is for the segment or point itself.
_THREAD = 1e-8
#: Sine of the angle below which a direction is a disc's axis, its part across it round-off.
_ROUND_OFF = 1e-14
_NOWHERE = fcl.Transform()
_REQUEST = fcl.DistanceRequest(enable_nearest_points=True)
_NONE = np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class ConvexBody:
    """A convex body in the world: the hull of points, grown by a disc or a ball.

    Attributes:
        points: Shape (k, 3), [m].
        radius: Radius of the ball by which the hull is grown, [m].
        disc_axis: Unit normal of the disc by which the hull is grown too, shape (3,); cylinders
            only.
        disc_radius: [m]; 0 for everything but cylinders.
        collision: FCL's object, without the growth by `radius` where `points` are one or two.
        faces: Normals of faces, shape (f, 3), candidates for separating directions.
        edges: Directions of edges, shape (e, 3), whose cross products are candidates too.
    """

    points: Array
    radius: float
    collision: Any
    faces: Array = field(default_factory=lambda: _NONE)
    edges: Array = field(default_factory=lambda: _NONE)
    disc_axis: Array = field(default_factory=lambda: np.zeros(3))
    disc_radius: float = 0.0

    def extent(self, directions: Array) -> Array:
        """Largest reach along directions (support function), shape (..., 3) → (...), [m].

        The directions need not be unit vectors; the reach is then scaled by their length.
        """
        reach: Array = np.max(directions @ self.points.T, axis=-1)
        if self.radius:
            reach = reach + self.radius * np.linalg.norm(directions, axis=-1)
        if self.disc_radius:
            reach = reach + self.disc_radius * np.linalg.norm(_across(directions, self), axis=-1)
        return reach

    def farthest(self, direction: Array) -> Array:
        """The point of the body, growth by `radius` left out, farthest along a direction."""
        point: Array = self.points[int(np.argmax(self.points @ direction))]
        if self.disc_radius:
            across = _across(_across(direction, self), self)
            size = float(np.linalg.norm(across))
            if size > _ROUND_OFF * float(np.linalg.norm(direction)):
                point = point + (self.disc_radius / size) * across
        return point


def _across(directions: Array, body: ConvexBody) -> Array:
    axis = body.disc_axis
    across: Array = directions - (directions @ axis)[..., None] * axis
    return across


@dataclass(frozen=True, slots=True, eq=False)
class Separation:
    """The distance of two convex bodies.

    Attributes:
        distance: [m]; where they overlap, minus a translation that separates them.
        first_point: On the first body, shape (3,), [m].
        second_point: On the second body, shape (3,), [m].
        normal: Unit vector from the first to the second body; the gap along it is the distance.
    """

    distance: float
    first_point: Array
    second_point: Array
    normal: Array


def convex_bodies(shape: Shape, pose: Pose) -> tuple[ConvexBody, ...]:
    """The convex bodies that make up a shape in the world; a mesh has one per triangle."""
    points = pose.apply(shape_points(shape))
    transform = fcl.Transform(np.array(pose.rotation), np.array(pose.position))
    match shape:
        case Box(half_size=half):
            return (box_body(half, pose),)
        case Sphere(radius=radius):
            collision = fcl.CollisionObject(fcl.Sphere(_THREAD), transform)
            return (ConvexBody(points, radius, collision),)
        case Capsule(radius=radius):
            body = segment_body(points[0], points[1])
            return (ConvexBody(points, radius, body.collision, edges=body.edges),)
        case Cylinder(radius=radius, length=length):
            collision = fcl.CollisionObject(fcl.Cylinder(radius, length), transform)
            axis = np.array(pose.rotation[:, 2])
            own = axis[None, :]
            return (ConvexBody(points, 0.0, collision, own, own, axis, radius),)
        case ConvexHull(triangles=triangles):
            return (polytope_body(points, triangles),)
        case TriangleMesh(triangles=triangles):
            return tuple(triangle_body(points[corners]) for corners in triangles)


def box_body(half_size: Array, pose: Pose) -> ConvexBody:
    """A box about the origin of ``pose`` (``world_from_box``); half_size shape (3,), [m]."""
    transform = fcl.Transform(np.array(pose.rotation), np.array(pose.position))
    collision = fcl.CollisionObject(fcl.Box(*(2.0 * half_size)), transform)
    axes = np.array(pose.rotation.T)
    return ConvexBody(pose.apply(shape_points(Box(half_size))), 0.0, collision, axes, axes)


def segment_body(start: Array, end: Array) -> ConvexBody:
    """The segment between two points of the world, shape (3,) each, [m]."""
    along = end - start
    length = float(np.linalg.norm(along))
    transform = fcl.Transform(_frame_along(along / length), (start + end) / 2.0)
    collision = fcl.CollisionObject(fcl.Capsule(_THREAD, length), transform)
    return ConvexBody(np.stack([start, end]), 0.0, collision, edges=along[None, :] / length)


def _frame_along(axis: Array) -> Array:
    """A rotation matrix whose z axis is ``axis``.

    Source: Duff et al., "Building an orthonormal basis, revisited", 2017.
    """
    x, y, z = axis.tolist()
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array(
        [
            [1.0 + sign * x * x * a, b, x],
            [sign * b, sign + y * y * a, y],
            [-sign * x, -y, z],
        ]
    )


def triangle_body(corners: Array) -> ConvexBody:
    """The triangle of three points of the world, shape (3, 3), [m]."""
    sides = np.array([[0, 1, 2], [0, 2, 1]])
    return _body_of_faces(corners, sides)


def polytope_body(points: Array, triangles: np.ndarray[Any, Any]) -> ConvexBody:
    """The convex body with the given surface; points shape (k, 3), [m], triangles (t, 3)."""
    return _body_of_faces(points, triangles)


def _body_of_faces(points: Array, triangles: np.ndarray[Any, Any]) -> ConvexBody:
    faces = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
    geometry = fcl.Convex(np.array(points), len(triangles), faces)
    collision = fcl.CollisionObject(geometry, fcl.Transform())
    corners = points[triangles]
    sides = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return ConvexBody(points, 0.0, collision, _unit(normals), _unit(sides))


def separation(first: ConvexBody, second: ConvexBody) -> Separation:
    """The proved distance of two convex bodies.

    Raises:
        Fault: The search did not converge; never seen so far, and no distance is returned then.
    """
    named = _named_by_fcl(first, second)
    if named is None:
        return _searched(first, second, first.points[0] - second.points[0])
    near_first, near_second, normal = named
    gap = _gap(first, second, normal)
    length = float((near_second - near_first) @ normal)
    if abs(gap - (length - first.radius - second.radius)) <= PROOF_TOLERANCE:
        return _apart(first, second, gap, normal, near_first, near_second)
    return _searched(first, second, near_second - near_first)


def _named_by_fcl(first: ConvexBody, second: ConvexBody) -> tuple[Array, Array, Array] | None:
    """FCL's nearest points and the unit vector between them; None where FCL reports contact."""
    result = fcl.DistanceResult()
    if fcl.distance(first.collision, second.collision, _REQUEST, result) <= PROOF_TOLERANCE:
        return None
    near_first, near_second = (np.asarray(p, dtype=np.float64) for p in result.nearest_points)
    between = near_second - near_first
    length = float(np.linalg.norm(between))
    if not length > PROOF_TOLERANCE:
        return None
    return near_first, near_second, between / length


def _gap(first: ConvexBody, second: ConvexBody, normal: Array) -> float:
    """Room between the two extents along a unit vector; a lower bound of the distance, [m]."""
    return -float(second.extent(-normal)) - float(first.extent(normal))


def _apart(
    first: ConvexBody, second: ConvexBody, gap: float, normal: Array, near_a: Array, near_b: Array
) -> Separation:
    grown_a, grown_b = near_a + first.radius * normal, near_b - second.radius * normal
    return Separation(gap, grown_a, grown_b, normal)


def _searched(first: ConvexBody, second: ConvexBody, guess: Array) -> Separation:
    """Wolfe's min-norm-point search over the differences of points of the two bodies.

    Source: P. Wolfe, "Finding the nearest point in a polytope", 1976; with a support function
    instead of a list of points it is the search of Gilbert, Johnson & Keerthi.
    """
    direction = guess if np.any(guess) else first.points[0] - second.points[0]
    if not np.any(direction):
        direction = np.array([0.0, 0.0, 1.0])
    pairs = [(first.farthest(direction), second.farthest(-direction))]
    weights = np.ones(1)
    for _ in range(200):
        corners = np.array([b - a for a, b in pairs])
        nearest = weights @ corners
        length = float(np.linalg.norm(nearest))
        if length < PROOF_TOLERANCE:
            return _overlap(first, second)
        added = (first.farthest(nearest), second.farthest(-nearest))
        open_part = length - float((added[1] - added[0]) @ nearest) / length
        if open_part <= PROOF_TOLERANCE or _repeats(added, pairs):
            if open_part > 10.0 * PROOF_TOLERANCE:
                break
            normal = nearest / length
            gap = _gap(first, second, normal)
            near = [sum(w * p[i] for w, p in zip(weights, pairs, strict=True)) for i in (0, 1)]
            return _apart(first, second, gap, normal, np.asarray(near[0]), np.asarray(near[1]))
        pairs.append(added)
        pairs, weights = _nearest_face(pairs, np.append(weights, 0.0))
    raise Fault(
        "the distance between two bodies could not be proved",
        where="clearance",
        why="the search for the nearest points did not converge",
        next_step="report this with the rig and the scene; no distance was assumed",
    )


def _repeats(added: tuple[Array, Array], pairs: list[tuple[Array, Array]]) -> bool:
    return any(np.array_equal(added[0], a) and np.array_equal(added[1], b) for a, b in pairs)


def _nearest_face(
    pairs: list[tuple[Array, Array]], weights: Array
) -> tuple[list[tuple[Array, Array]], Array]:
    """The point of the corners' hull nearest to the origin, as weights of supporting corners."""
    while True:
        corners = np.array([b - a for a, b in pairs])
        wanted = _affine_nearest(corners)
        if np.all(wanted > 1e-12):
            return pairs, wanted
        falling = wanted <= 1e-12
        room = weights[falling] / np.maximum(weights[falling] - wanted[falling], 1e-300)
        weights = weights + min(1.0, float(np.min(room))) * (wanted - weights)
        kept = weights > 1e-12
        if kept.all():  # round-off: drop the one that limits
            kept[int(np.argmin(weights))] = False
        pairs = [pair for pair, keep in zip(pairs, kept, strict=True) if keep]
        weights = weights[kept] / weights[kept].sum()


def _affine_nearest(corners: Array) -> Array:
    """Weights, sum 1, of the point of the corners' affine hull nearest to the origin."""
    spread = (corners[1:] - corners[0]).T
    if spread.shape[1] == 0:
        return np.ones(1)
    tail = np.linalg.lstsq(spread, -corners[0], rcond=None)[0]
    return np.concatenate([[1.0 - tail.sum()], tail])


def _overlap(first: ConvexBody, second: ConvexBody) -> Separation:
    """The shortest separating translation along face normals and crossed edges.

    Source: the separating axis theorem. Exact for polytopes; for round bodies it separates but may
    not be the shortest.
    """
    crossed = np.cross(first.edges[:, None, :], second.edges[None, :, :]).reshape(-1, 3)
    to_second = second.points.mean(axis=0) - first.points.mean(axis=0)
    tried = _unit(np.concatenate([first.faces, second.faces, crossed, to_second[None, :]]))
    if len(tried) == 0:
        tried = np.eye(3)
    tried = np.concatenate([tried, -tried])
    gaps = -second.extent(-tried) - first.extent(tried)
    best = int(np.argmax(gaps))
    normal = tried[best]
    touching = (first.farthest(normal) + second.farthest(-normal)) / 2.0
    return Separation(min(0.0, float(gaps[best])), touching, touching, normal)


def _unit(vectors: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=-1)
    keep = lengths > 1e-12
    unit: Array = vectors[keep] / lengths[keep][:, None]
    return unit
