"""Obstacle shapes, each in its own frame, [m]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.pose import Array, Pose, read_only

Indices = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

_FLAT = 1e-9
"""Of the size of a mesh: heights up to this are round-off."""


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A box about its centre; ``half_size`` shape (3,), [m]."""

    half_size: Array


@dataclass(frozen=True, slots=True, eq=False)
class Sphere:
    """A ball about its centre, [m]."""

    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class Cylinder:
    """A cylinder about its centre along its z axis; ``length`` between the flat ends, [m]."""

    radius: float
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """All points within ``radius`` of a segment of ``length`` on the z axis, [m]."""

    radius: float
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class ConvexHull:
    """The convex hull of ``vertices``, shape (n, 3), [m]; ``triangles`` shape (t, 3)."""

    vertices: Array
    triangles: Indices


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """A surface of triangles: ``vertices`` shape (n, 3), [m]; ``triangles`` shape (t, 3).

    What it encloses is free. A scene's mesh about a convex volume is read as a `ConvexHull`.
    """

    vertices: Array
    triangles: Indices


Shape = Box | Sphere | Cylinder | Capsule | ConvexHull | TriangleMesh


def shape_points(shape: Shape) -> Array:
    """Points whose hull, grown by the shape's ``radius`` where it has one, holds the shape.

    For boxes, hulls and meshes the vertices; for round shapes points of their axis; shape (n, 3).
    """
    match shape:
        case Box(half_size=half):
            signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
            points: Array = signs * half
            return points
        case Sphere():
            return np.zeros((1, 3))
        case Cylinder(length=length) | Capsule(length=length):
            return np.array([[0.0, 0.0, -length / 2], [0.0, 0.0, length / 2]])
        case ConvexHull(vertices=vertices) | TriangleMesh(vertices=vertices):
            return vertices


def encloses_convex(vertices: Array, triangles: Indices) -> bool:
    """Whether triangles enclose a convex volume.

    Every side is then shared by two triangles, and every vertex lies behind every triangle.

    Args:
        vertices: Shape (n, 3), [m].
        triangles: Numbers of their corners, shape (t, 3).
    """
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, counts = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    if np.any(counts != 2):
        return False
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    used = vertices[np.unique(triangles)]
    size = float(np.ptp(used, axis=0).max())
    if np.any(lengths <= _FLAT * size**2):
        return False
    normals = normals / lengths[:, None]
    heights = used @ normals.T - np.sum(corners[:, 0] * normals, axis=1)
    one_side = np.all(heights <= _FLAT * size, axis=0) | np.all(heights >= -_FLAT * size, axis=0)
    flat = np.all(np.abs(heights) <= _FLAT * size)
    return bool(np.all(one_side) and not flat)


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle:
    """A named shape at a place in the world (``pose`` is ``world_from_shape``)."""

    name: str
    shape: Shape
    pose: Pose


def read_only_indices(triangles: Sequence[Sequence[int]]) -> Indices:
    """Corner numbers of triangles, shape (t, 3), in an array that cannot be written to."""
    array = np.array(triangles, dtype=np.int64)
    array.setflags(write=False)
    return array


def convex_hull(points: Array) -> ConvexHull:
    """The hull of points, shape (n ≥ 4, 3), [m], triangles counter-clockwise from outside.

    Raises:
        ValueError: The points lie in a plane.
    """
    from scipy.spatial import ConvexHull as Hull
    from scipy.spatial import QhullError

    try:
        hull = Hull(points)
    except QhullError as error:
        raise ValueError("the points must span a volume") from error
    number = {int(v): i for i, v in enumerate(hull.vertices)}
    vertices = points[hull.vertices]
    triangles = []
    for simplex, equation in zip(hull.simplices, hull.equations, strict=True):
        a, b, c = (int(i) for i in simplex)
        normal = np.cross(points[b] - points[a], points[c] - points[a])
        ordered = (a, b, c) if normal @ equation[:3] > 0 else (a, c, b)
        triangles.append([number[i] for i in ordered])
    return ConvexHull(read_only(vertices), read_only_indices(triangles))
