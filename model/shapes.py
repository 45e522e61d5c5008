"""Obstacle shapes, each in its own frame, [m], and their polygons for images and logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.pose import Array, Pose, ReadOnly, read_only

Indices = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

_FLAT = 1e-9
"""Heights up to this part of a mesh's size are round-off."""
_ROUNDED = 2e-6
"""And those up to this, [m]: coordinates of files are often rounded to a micrometre."""


@dataclass(frozen=True, slots=True, eq=False)
class Box(ReadOnly):
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
class ConvexHull(ReadOnly):
    """The convex hull of ``vertices``, shape (n, 3), [m]; ``triangles`` shape (t, 3)."""

    vertices: Array
    triangles: Indices


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh(ReadOnly):
    """A surface of triangles: ``vertices`` shape (n, 3), [m]; ``triangles`` shape (t, 3).

    The enclosed volume is free. A scene's mesh around a convex volume is read as a `ConvexHull`.
    """

    vertices: Array
    triangles: Indices


Shape = Box | Sphere | Cylinder | Capsule | ConvexHull | TriangleMesh


def shape_points(shape: Shape) -> Array:
    """Points whose hull, grown by the shape's ``radius`` where it has one, contains the shape.

    Vertices of boxes, hulls and meshes; points on the axis of round shapes; shape (n, 3).
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
    """A named shape at a pose in the world (``pose`` is ``world_from_shape``)."""

    name: str
    shape: Shape
    pose: Pose


def read_only_indices(triangles: Sequence[Sequence[int]]) -> Indices:
    """Corner indices of triangles, shape (t, 3), in a read-only array."""
    array = np.array(triangles, dtype=np.int64)
    array.setflags(write=False)
    return array


def convex_hull(points: Array) -> ConvexHull:
    """The hull of points, shape (n ≥ 4, 3), [m], triangles counter-clockwise from outside.

    Raises:
        ValueError: The points lie in a plane.
    """
    hull = _qhull(points)
    number = {int(v): i for i, v in enumerate(hull.vertices)}
    vertices = points[hull.vertices]
    triangles = []
    for simplex, equation in zip(hull.simplices, hull.equations, strict=True):
        a, b, c = (int(i) for i in simplex)
        normal = np.cross(points[b] - points[a], points[c] - points[a])
        ordered = (a, b, c) if normal @ equation[:3] > 0 else (a, c, b)
        triangles.append([number[i] for i in ordered])
    return ConvexHull(read_only(vertices), read_only_indices(triangles))


def _qhull(points: Array) -> Any:
    """SciPy's hull of points, [m].

    Raises:
        ValueError: The points lie in a plane.
    """
    from scipy.spatial import ConvexHull as Hull
    from scipy.spatial import QhullError

    try:
        return Hull(points)
    except QhullError as error:
        raise ValueError("the points must span a volume") from error


def enclosed_convex(vertices: Array, triangles: Indices) -> ConvexHull | None:
    """The convex volume that triangles enclose; None if they do not.

    They do if every side is shared by two of them, and all lie on the hull of their corners. The
    hull contains them: where rounded coordinates leave dents, it is the larger body.

    Args:
        vertices: Shape (n, 3), [m]; equal ones are one, as in an STL file every triangle has its
            own.
        triangles: Indices of their corners, shape (t, 3).
    """
    used, numbers = np.unique(vertices[triangles].reshape(-1, 3), axis=0, return_inverse=True)
    sides = np.sort(numbers.reshape(-1, 3)[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    sides = sides[(sides[..., 0] != sides[..., 1]).all(axis=1)].reshape(-1, 2)
    _, counts = np.unique(sides, axis=0, return_counts=True)
    if np.any(counts != 2):
        return None
    try:
        hull = _qhull(used)
    except ValueError:
        return None
    rounded = max(_FLAT * float(np.ptp(used, axis=0).max()), _ROUNDED)
    if hull.volume <= rounded * hull.area / 2.0:  # a sheet
        return None
    middles = np.column_stack([vertices[triangles].mean(axis=1), np.ones(len(triangles))])
    planes = np.unique(hull.equations, axis=0).T
    for block in np.array_split(middles, len(middles) // 256 + 1):
        if (block @ planes).max(axis=1).min() < -rounded:
            return None
    return convex_hull(vertices[np.unique(triangles)])


# Obstacles as polygons, for images and logs; never for distances.


Face = tuple[int, ...]
_SIDES = 24
_STEP = 15.0  # degrees of a round profile per ring
#: Neighbouring faces at a smaller angle form one smooth surface, whose edge is not drawn.
_SMOOTH = np.cos(np.radians(20.0))


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A surface of flat faces.

    Attributes:
        vertices: World frame, shape (n, 3), [m].
        faces: Convex polygons by vertex number.
        edges: Pairs of vertex numbers: the edges worth drawing.
    """

    vertices: Array
    faces: tuple[Face, ...]
    edges: tuple[tuple[int, int], ...]

    def triangles(self) -> Array:
        """The faces cut into triangles, shape (t, 3, 3), [m]."""
        cut = [(f[0], f[k], f[k + 1]) for f in self.faces for k in range(1, len(f) - 1)]
        corners: Array = self.vertices[np.array(cut)]
        return corners


def solid_of(obstacle: Obstacle) -> Solid:
    """The surface of an obstacle in the world; round shapes as polygons."""
    vertices, faces = _surface(obstacle.shape)
    world = obstacle.pose.apply(vertices)
    return Solid(world, faces, _sharp_edges(world, faces))


def box_solid(half_size: Array, pose: Pose | None = None) -> Solid:
    """A box about its centre, ``pose`` is ``world_from_box``; at the origin when left out."""
    return solid_of(Obstacle("box", Box(half_size), pose or Pose.level(np.zeros(3))))


def _surface(shape: Shape) -> tuple[Array, tuple[Face, ...]]:
    match shape:
        case Box(half_size=half):
            return _box(half)
        case Sphere(radius=radius):
            return _revolved(_arc(radius, 0.0, -90.0, 90.0))
        case Cylinder(radius=radius, length=length):
            half_length = length / 2.0
            return _revolved(
                [
                    (0.0, -half_length),
                    (radius, -half_length),
                    (radius, half_length),
                    (0.0, half_length),
                ]
            )
        case Capsule(radius=radius, length=length):
            below = _arc(radius, -length / 2.0, -90.0, 0.0)
            return _revolved([*below, *_arc(radius, length / 2.0, 0.0, 90.0)])
        case ConvexHull(vertices=vertices, triangles=triangles):
            return vertices, _as_faces(triangles)
        case TriangleMesh(vertices=vertices, triangles=triangles):
            return vertices, _as_faces(triangles)


def _as_faces(triangles: NDArray[np.int64]) -> tuple[Face, ...]:
    return tuple((int(a), int(b), int(c)) for a, b, c in triangles)


def _box(half: Array) -> tuple[Array, tuple[Face, ...]]:
    signs = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    faces = (
        (0, 2, 3, 1),
        (4, 5, 7, 6),
        (0, 1, 5, 4),
        (2, 6, 7, 3),
        (0, 4, 6, 2),
        (1, 3, 7, 5),
    )
    return np.array(signs) * half, faces


def _arc(radius: float, height: float, start: float, end: float) -> list[tuple[float, float]]:
    angles = np.radians(np.arange(start, end + _STEP / 2.0, _STEP))
    return [(radius * float(np.cos(a)), height + radius * float(np.sin(a))) for a in angles]


def _revolved(profile: Sequence[tuple[float, float]]) -> tuple[Array, tuple[Face, ...]]:
    """The surface of revolution about z of a (radius, height) profile with ends on the axis."""
    angles = np.arange(_SIDES) * 2.0 * np.pi / _SIDES
    rings = [
        np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(_SIDES, h)])
        for r, h in profile
    ]
    faces: list[Face] = []
    for ring in range(1, len(profile) - 2):  # the first and the last ring are the poles
        low, high = ring * _SIDES, (ring + 1) * _SIDES
        for k in range(_SIDES):
            after = (k + 1) % _SIDES
            faces.append((low + k, low + after, high + after, high + k))
    faces += _caps(profile)
    return np.vstack(rings), tuple(faces)


def _caps(profile: Sequence[tuple[float, float]]) -> list[Face]:
    """The flat polygons that close a surface of revolution at the rings next to its poles."""
    last = (len(profile) - 2) * _SIDES
    return [tuple(range(2 * _SIDES - 1, _SIDES - 1, -1)), tuple(range(last, last + _SIDES))]


def _sharp_edges(vertices: Array, faces: tuple[Face, ...]) -> tuple[tuple[int, int], ...]:
    beside: dict[tuple[int, int], list[Array]] = {}
    for face in faces:
        a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
        normal = np.cross(b - a, c - a)
        normal = normal / max(float(np.linalg.norm(normal)), 1e-30)
        for start, end in zip(face, (*face[1:], face[0]), strict=True):
            beside.setdefault((min(start, end), max(start, end)), []).append(normal)
    return tuple(
        edge
        for edge, normals in beside.items()
        if len(normals) != 2 or float(normals[0] @ normals[1]) < _SMOOTH
    )
