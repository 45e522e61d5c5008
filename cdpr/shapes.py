"""Obstacle shapes, each in its own frame, [m]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array, Pose, read_only

Indices = np.ndarray[tuple[int, ...], np.dtype[np.int64]]


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
    """A surface of triangles: ``vertices`` shape (n, 3), [m]; ``triangles`` shape (t, 3)."""

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
