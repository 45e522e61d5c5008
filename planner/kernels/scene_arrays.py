"""Named access to the columns of a world's arrays.

A world is passed to every function, and compiled code counts references to each of its arrays at
every call; hence few arrays with many columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.pose import Array, Pose
from model.scene import Scene
from model.shapes import (
    Box,
    Capsule,
    ConvexHull,
    Cylinder,
    Obstacle,
    Shape,
    Sphere,
    TriangleMesh,
    shape_points,
)
from planner.kernels.jit import kernel, leaf
from planner.kernels.primitives import Vector, along, dot, minus, norm

Integers = NDArray[np.int64]


class World(NamedTuple):
    """One rig at one orientation in one scene; from `planner.collision.world.build_world`.

    Bodies are the m cables and then the platform. A pair is one body and one piece of an obstacle.

    Attributes:
        limits: Lower and upper corner of the workspace box, shape (2, 3), [m].
        platform: Rotation ``world_from_platform`` under translation, and half extents of the box,
            shape (4, 3).
        pulley: Radius of the pulleys, [m]; 0 for point exits.
        cables: Outlet, feed direction, anchor in the platform's frame, and the same rotated into
            the world's axes, shape (m, 12), [m].
        bodies: Required distance of each body to any obstacle, radius included, and its radius,
            shape (m + 1, 2), [m].
        pieces: Rotation ``shape_from_world``, centre, half extents of a box, half extents of the
            box grown by the platform (zeros where that is not a box), radius of the ball and of
            the disc by which the piece is grown, shape (k, 20).
        spans: Kind, index of the obstacle, first and last + 1 of its `points` and of its
            `triangles`, shape (k, 6).
        points: Of all pieces, world frame, shape (n, 3), [m].
        triangles: Of all meshes, world frame, shape (t, 3, 3), [m].
        planes: Of all pairs, shape (l, 6): unit normal n; the limit of n · position; least extent
            of the ungrown piece along n; extent of the exit along n (-inf for the platform).
        pairs: All pairs, those that forbid most positions first: piece, body, first proving plane
            (before one of which a position is allowed), first core plane (behind all of which it
            is forbidden), last core plane + 1, shape (k (m + 1), 5).
    """

    limits: Array
    platform: Array
    pulley: float
    cables: Array
    bodies: Array
    pieces: Array
    spans: Integers
    points: Array
    triangles: Array
    planes: Array
    pairs: Integers


@leaf
def _triple(array: Array, index: int, column: int) -> Vector:
    return (array[index, column], array[index, column + 1], array[index, column + 2])


@leaf
def outlet(world: World, cable: int) -> Vector:
    """Outlet of a cable, world frame, [m]."""
    return _triple(world.cables, cable, 0)


@leaf
def feed(world: World, cable: int) -> Vector:
    """Feed direction of a cable's pulley, world frame."""
    return _triple(world.cables, cable, 3)


@leaf
def anchor(world: World, cable: int) -> Vector:
    """Anchor of a cable, platform frame, [m]."""
    return _triple(world.cables, cable, 6)


@leaf
def arm(world: World, cable: int) -> Vector:
    """From the platform's origin to a cable's anchor under translation, world axes, [m]."""
    return _triple(world.cables, cable, 9)


@leaf
def half_size(world: World) -> Vector:
    """Half extents of the platform box, [m]."""
    return _triple(world.platform, 3, 0)


@leaf
def centre(world: World, piece: int) -> Vector:
    """Origin of a piece, world frame, [m]."""
    return _triple(world.pieces, piece, 9)


@leaf
def box_half(world: World, piece: int) -> Vector:
    """Half extents of a box, [m]."""
    return _triple(world.pieces, piece, 12)


@leaf
def box_sum(world: World, piece: int) -> Vector:
    """Half extents of a box grown by the platform, [m]; zeros where that is not a box."""
    return _triple(world.pieces, piece, 15)


@leaf
def disc_axis(world: World, piece: int) -> Vector:
    """Axis of the disc by which a piece is grown, world frame."""
    return _triple(world.pieces, piece, 6)


@leaf
def in_frame(world: World, piece: int, vector: Vector) -> Vector:
    """A vector of the world in the axes of a piece."""
    return (
        dot(_triple(world.pieces, piece, 0), vector),
        dot(_triple(world.pieces, piece, 3), vector),
        dot(_triple(world.pieces, piece, 6), vector),
    )


@leaf
def ball(world: World, piece: int) -> float:
    """Radius of the ball by which a piece is grown, [m]."""
    return world.pieces[piece, 18]  # type: ignore[no-any-return]


@leaf
def disc(world: World, piece: int) -> float:
    """Radius of the disc by which a piece is grown, [m]."""
    return world.pieces[piece, 19]  # type: ignore[no-any-return]


# Obstacles as convex pieces for the compiled checks, depending on their shape alone.
#
# A box, ball, capsule, cylinder or hull is one piece. A mesh is represented by its hull; its
# triangles are checked only where the hull is too near.


BOX: Final = 0
ROUND: Final = 1
HULL: Final = 2
MESH: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class ConvexPiece:
    """A convex piece in the world: the hull of points, grown by a disc and by a ball.

    Attributes:
        kind: `BOX`, `ROUND` (a grown point or segment), `HULL` (a cylinder too) or `MESH`.
        pose: ``world_from_shape``.
        half: Half extents of a box, shape (3,), [m]; else zeros.
        points: World frame, shape (k, 3), [m].
        radius: Of the ball, [m].
        disc: Radius of a disc across the shape's z axis, [m].
        faces: Normals of faces, world frame, shape (f, 3).
        edges: Ends of edges, world frame, shape (e, 2, 3), [m].
        triangles: Of a mesh, world frame, shape (t, 3, 3), [m]; else empty.
        owner: Index of its obstacle in the scene.
    """

    kind: int
    pose: Pose
    half: Array
    points: Array
    radius: float
    disc: float
    faces: Array
    edges: Array
    triangles: Array
    owner: int

    @property
    def disc_axis(self) -> Array:
        """Axis of the disc, world frame, shape (3,)."""
        axis: Array = self.pose.rotation[:, 2]
        return axis

    def least(self, directions: Array) -> Array:
        """Least extent of the piece along unit vectors, shape (..., 3) → (...), [m]."""
        reach: Array = np.min(directions @ self.points.T, axis=-1) - self.radius
        if self.disc:
            along = directions @ self.disc_axis
            reach = reach - self.disc * np.sqrt(np.maximum(1.0 - along**2, 0.0))
        return reach


def pieces_of(scene: Scene) -> tuple[ConvexPiece, ...]:
    """The pieces of all obstacles, sorted by kind."""
    made = [_piece(obstacle, k) for k, obstacle in enumerate(scene.obstacles)]
    return tuple(sorted(made, key=lambda piece: piece.kind))


def _piece(obstacle: Obstacle, owner: int) -> ConvexPiece:
    shape, pose = obstacle.shape, obstacle.pose
    points = pose.apply(shape_points(shape))
    kind, half, radius, disc = _sizes(shape)
    faces, edges = _features(shape, points, pose)
    triangles = np.zeros((0, 3, 3))
    if kind == MESH and isinstance(shape, TriangleMesh):
        triangles = points[shape.triangles]
    return ConvexPiece(kind, pose, half, points, radius, disc, faces, edges, triangles, owner)


def _sizes(shape: Shape) -> tuple[int, Array, float, float]:
    none = np.zeros(3)
    match shape:
        case Box(half_size=half):
            return BOX, np.array(half), 0.0, 0.0
        case Sphere(radius=radius) | Capsule(radius=radius):
            return ROUND, none, radius, 0.0
        case Cylinder(radius=radius):
            return HULL, none, 0.0, radius
        case ConvexHull():
            return HULL, none, 0.0, 0.0
        case TriangleMesh():
            return MESH, none, 0.0, 0.0


def _features(shape: Shape, points: Array, pose: Pose) -> tuple[Array, Array]:
    """Normals of faces and ends of edges, as candidates for separating planes."""
    match shape:
        case Box():
            signs = np.sign(shape_points(shape))
            pairs = [
                (i, j) for i in range(8) for j in range(i) if np.sum(signs[i] != signs[j]) == 1
            ]
            axes = np.concatenate([pose.rotation.T, -pose.rotation.T])
            return axes, points[np.array(pairs)]
        case ConvexHull(triangles=triangles):
            corners = points[triangles]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            return normals / np.where(lengths > 0.0, lengths, 1.0), ends
        case Cylinder():
            return np.stack([pose.rotation[:, 2], -pose.rotation[:, 2]]), np.zeros((0, 2, 3))
        case _:
            return np.zeros((0, 3)), np.zeros((0, 2, 3))


# Where a cable leaves its pulley, and a bound on the travel of that point.


@kernel
def exit_point(world: World, cable: int, anchor: Vector) -> Vector:
    """The exit point of a cable to an anchor, world frame, [m]; NaN where there is none."""
    origin = outlet(world, cable)
    radius = world.pulley
    if radius == 0.0:
        return origin
    axis = feed(world, cable)
    offset = minus(anchor, origin)
    rise = dot(offset, axis)
    radial = along(offset, axis, -rise)
    reach = norm(radial)
    outward = reach - radius
    distance = math.sqrt(outward * outward + rise * rise)
    if reach == 0.0 or distance <= radius:
        return (np.nan, np.nan, np.nan)
    angle = math.atan2(rise, outward) + math.acos(radius / distance)
    out = radius * (1.0 + math.cos(angle)) / reach
    return along(along(origin, radial, out), axis, radius * math.sin(angle))


@kernel
def exit_travel(world: World, cable: int, start: Vector, end: Vector, travel: float) -> float:
    """A bound on the travel of an exit point, [m]; infinite where there is none.

    An anchor that moves by dB swivels the pulley by at most dB / ρ, which moves the exit by at most
    2 r dB / ρ, and rolls the cable by at most dB / l, which moves it by r dB / l; ρ is the distance
    from the swivel axis, l the free length.

    Args:
        start: The anchor before, world frame, [m].
        end: The anchor after, [m].
        travel: Most the anchor travels between them, [m].
    """
    radius = world.pulley
    if radius == 0.0:
        return 0.0
    origin, axis = outlet(world, cable), feed(world, cable)
    first, last = minus(start, origin), minus(end, origin)
    reach = min(_radial(first, axis), _radial(last, axis)) - travel / 2.0
    from_centre = min(norm(first), norm(last)) - radius - travel / 2.0
    if not (reach > 0.0 and from_centre > radius):
        return np.inf
    free = math.sqrt(from_centre * from_centre - radius * radius)
    return radius * max(2.0 / reach, 1.0 / free) * travel


@kernel
def _radial(offset: Vector, axis: Vector) -> float:
    return norm(along(offset, axis, -dot(offset, axis)))
