"""Cables and obstacles as bodies of coal, and the distance between two of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import coal
import numpy as np

from model.pose import Array, Pose
from model.shapes import Box, Capsule, ConvexHull, Cylinder, Shape, Sphere, TriangleMesh

EXACT = 2e-7
"""Assumed error of coal's distances, [m]; those of cylinders are off by up to 1e-8."""
THREAD = 1e-9
"""Radius of the capsule that represents a cable, [m]; included in `EXACT`."""
_REQUEST = coal.DistanceRequest()
_REQUEST.gjk_tolerance, _REQUEST.gjk_max_iterations = 1e-9, 2000

Body = tuple[Any, Any]
"""A coal shape and its pose."""


def distance(first: Body, second: Body) -> float:
    """Distance between surfaces, [m]; negative where they overlap."""
    return float(coal.distance(*first, *second, _REQUEST, coal.DistanceResult()))


def thread(exit: Array, anchor: Array, at_exit: float, at_anchor: float) -> Body:
    """A part of a straight cable; in plain numbers for speed, as a path needs a thousand.

    Args:
        exit: Where the cable leaves its outlet, world frame, shape (3,), [m].
        anchor: Where it ends, world frame, shape (3,), [m].
        at_exit: Length left out at the exit, [m].
        at_anchor: Length left out at the anchor, [m].
    """
    a, b, c = exit.tolist()
    u, v, w = anchor.tolist()
    whole = math.dist((a, b, c), (u, v, w))
    x, y, z = (u - a) / whole, (v - b) / whole, (w - c) / whole
    sign = math.copysign(1.0, z)
    p = -1.0 / (sign + z)
    q = x * y * p
    frame = np.array(
        [
            [1.0 + sign * x * x * p, q, x],
            [sign * q, sign + y * y * p, y],
            [-sign * x, -y, z],
        ]
    )
    length = whole - at_exit - at_anchor
    middle = at_exit + length / 2.0
    centre = np.array([a + middle * x, b + middle * y, c + middle * z])
    return coal.Capsule(THREAD, length), coal.Transform3s(frame, centre)


def geometries(shape: Shape, pose: Pose) -> Iterator[Body]:
    """A shape in the world as convex bodies; a mesh is its triangles."""
    transform = coal.Transform3s(np.array(pose.rotation), np.array(pose.position))
    match shape:
        case Box(half_size=half):
            yield coal.Box(*(2.0 * half)), transform
        case Sphere(radius=radius):
            yield coal.Sphere(radius), transform
        case Cylinder(radius=radius, length=length):
            yield coal.Cylinder(radius, length), transform
        case Capsule(radius=radius, length=length):
            yield coal.Capsule(radius, length), transform
        case ConvexHull():
            cloud = coal.StdVec_Vec3s()
            for point in shape.vertices:
                cloud.append(np.array(point))
            yield coal.Convex.convexHull(cloud, False, ""), transform
        case TriangleMesh():
            for corners in shape.vertices[shape.triangles]:
                yield _triangle(corners), transform


def _triangle(corners: Array) -> Any:
    """A convex body with two sides; coal has no distances for its own triangles."""
    points, sides = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for corner in corners:
        points.append(np.array(corner))
    sides.append(coal.Triangle(0, 1, 2))
    sides.append(coal.Triangle(0, 2, 1))
    return coal.Convex(points, sides)
