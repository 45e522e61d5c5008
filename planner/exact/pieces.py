"""Obstacles as the pieces that the compiled checks know, chosen by shape alone.

A box, ball, capsule, cylinder or hull is one piece. A mesh is a guard, its hull, which is looked
into, triangle by triangle, only where the guard is too near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from cdpr.poses import Array, Pose
from cdpr.scene import Scene
from cdpr.shapes import (
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

BOX: Final = 0
ROUND: Final = 1
HULL: Final = 2
MESH: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
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
        owner: Number of its obstacle in the scene.
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
        """How little the piece reaches along unit vectors, shape (..., 3) → (...), [m]."""
        reach: Array = np.min(directions @ self.points.T, axis=-1) - self.radius
        if self.disc:
            along = directions @ self.disc_axis
            reach = reach - self.disc * np.sqrt(np.maximum(1.0 - along**2, 0.0))
        return reach


def pieces_of(scene: Scene) -> tuple[Piece, ...]:
    """The pieces of all obstacles, sorted by kind."""
    made = [_piece(obstacle, k) for k, obstacle in enumerate(scene.obstacles)]
    return tuple(sorted(made, key=lambda piece: piece.kind))


def _piece(obstacle: Obstacle, owner: int) -> Piece:
    shape, pose = obstacle.shape, obstacle.pose
    points = pose.apply(shape_points(shape))
    kind, half, radius, disc = _sizes(shape, points)
    faces, edges = _features(shape, points, pose)
    triangles = np.zeros((0, 3, 3))
    if kind == MESH and isinstance(shape, TriangleMesh):
        triangles = points[shape.triangles]
    return Piece(kind, pose, half, points, radius, disc, faces, edges, triangles, owner)


def _sizes(shape: Shape, points: Array) -> tuple[int, Array, float, float]:
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
    """Normals of faces and ends of edges, from which separating planes are tried."""
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
