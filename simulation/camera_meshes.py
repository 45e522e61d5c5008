"""Obstacle shapes as triangles, for the synthetic camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array
from cdpr.shapes import (
    Box,
    Capsule,
    ConvexHull,
    Cylinder,
    Shape,
    Sphere,
    TriangleMesh,
    convex_hull,
    shape_points,
)

#: Corners around a round shape.
AROUND = 40


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles of a shape in its own frame.

    Attributes:
        vertices: Shape (n, 3, 3), [m].
        normals: Outward unit normals at the vertices, shape (n, 3, 3).
    """

    vertices: Array
    normals: Array


def surface_of(shape: Shape) -> Surface:
    """The surface of any obstacle shape; round ones within 0.4 % of their radius."""
    match shape:
        case Box():
            hull = convex_hull(shape_points(shape))
            return _faceted(hull.vertices[hull.triangles])
        case ConvexHull(vertices=vertices, triangles=triangles):
            return _faceted(vertices[triangles])
        case TriangleMesh(vertices=vertices, triangles=triangles):
            return _faceted(vertices[triangles])
        case Sphere(radius=radius):
            return _turned(*_arc(radius, 0.0, -np.pi / 2, np.pi / 2))
        case Capsule(radius=radius, length=length):
            low = _arc(radius, -length / 2, -np.pi / 2, 0.0)
            high = _arc(radius, length / 2, 0.0, np.pi / 2)
            return _turned(np.vstack([low[0], high[0]]), np.vstack([low[1], high[1]]))
        case Cylinder(radius=radius, length=length):
            h = length / 2
            outline = [(0, -h), (radius, -h), (radius, -h), (radius, h), (radius, h), (0, h)]
            normals = [(0, -1), (0, -1), (1, 0), (1, 0), (0, 1), (0, 1)]
            return _turned(np.array(outline, dtype=float), np.array(normals, dtype=float))


def _faceted(vertices: Array) -> Surface:
    """Flat triangles: one normal for all three corners."""
    normal = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(length, 1e-15)
    return Surface(vertices, np.repeat(normal[:, None, :], 3, axis=1))


def _arc(radius: float, height: float, start: float, end: float) -> tuple[Array, Array]:
    """Part of a circle about (0, height) in the (r, z) plane, and its normals."""
    angles = np.linspace(start, end, max(2, int(AROUND * (end - start) / (2 * np.pi)) + 1))
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    return radius * normals + np.array([0.0, height]), normals


def _turned(outline: Array, normals: Array) -> Surface:
    """Surface of revolution about z of an outline in the (r, z) plane, shapes (k, 2)."""
    angles = np.linspace(0.0, 2 * np.pi, AROUND + 1)
    turn = np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def swept(profile: Array) -> Array:
        around = profile[:, None, :1] * turn
        along = np.broadcast_to(profile[:, None, 1:], (*around.shape[:2], 1))
        return np.concatenate([around, along], axis=-1)

    return Surface(_strips(swept(outline)), _strips(swept(normals)))


def _strips(grid: Array) -> Array:
    """The triangles of a grid of points, shape (k, l, 3); shape (n, 3, 3)."""
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    first, second = np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)
    return np.concatenate([first.reshape(-1, 3, 3), second.reshape(-1, 3, 3)])
