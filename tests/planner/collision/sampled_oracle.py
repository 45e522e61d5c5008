"""Random rigs and scenes, and their distances by coal at single poses and on swept hulls."""

from __future__ import annotations

import math
from itertools import combinations

import coal
import numpy as np
from scipy.spatial.transform import Rotation

from model.files.scene_file import SceneDocument
from model.kinematics import cables_at
from model.pose import Array, Pose
from model.rig import Rig, rig_from_document
from model.scene import Scene, scene_from_document
from model.shapes import Box, Capsule, Cylinder, Obstacle, Sphere

KINDS = ("box", "rotated box", "sphere", "capsule", "cylinder", "hull", "convex mesh", "mesh")


def random_scene(rng: np.random.Generator, rig: Rig, count: int, kinds=KINDS) -> Scene:
    """Obstacles of random kinds in the workspace of a rig."""
    size = rig.workspace_upper - rig.workspace_lower
    scale = float(size.min())
    obstacles = []
    for k in range(count):
        kind = str(rng.choice(kinds))
        position = rng.uniform(rig.workspace_lower - 0.3 * size, rig.workspace_upper + 0.1 * size)
        entry: dict[str, object] = {"name": f"{kind} {k}", "position_mm": (1e3 * position).tolist()}
        if kind != "box":
            entry["rotation_wxyz"] = Rotation.random(rng=rng).as_quat(scalar_first=True).tolist()
        entry |= _shape(rng, kind, 1e3 * scale)
        obstacles.append(entry)
    document = {
        "schema_version": 1,
        "name": "random",
        "start": {"position_mm": (1e3 * rig.home.position).tolist()},
        "goal": {"position_mm": (1e3 * rig.home.position).tolist()},
        "obstacles": obstacles,
    }
    return scene_from_document(SceneDocument.model_validate(document))


def _shape(rng: np.random.Generator, kind: str, scale: float) -> dict[str, object]:
    radius, length = scale * rng.uniform(0.03, 0.15), scale * rng.uniform(0.1, 0.6)
    cloud = scale * rng.uniform(-0.25, 0.25, (9, 3))
    match kind:
        case "box" | "rotated box":
            return {"box": {"size_mm": (scale * rng.uniform(0.05, 0.4, 3)).tolist()}}
        case "sphere":
            return {"sphere": {"radius_mm": radius}}
        case "capsule" | "cylinder":
            return {kind: {"radius_mm": radius, "length_mm": length}}
        case "hull":
            return {"convex": {"points_mm": cloud.tolist()}}
        case "convex mesh":
            triangles = [list(t) for t in combinations(range(4), 3)]
            return {"mesh": {"points_mm": cloud[:4].tolist(), "triangles": triangles}}
        case _:
            triangles = [[0, 1, 2], [2, 3, 4], [4, 5, 6]]
            return {"mesh": {"points_mm": cloud[:7].tolist(), "triangles": triangles}}


def changed_rig(rig: Rig, **changes: object) -> Rig:
    """A rig with some top-level keys of its file replaced."""
    document = rig.document.model_dump(mode="json") | changes
    return rig_from_document(type(rig.document).model_validate(document))


class CoalScene:
    """The obstacles of a scene as coal knows them."""

    def __init__(self, scene: Scene) -> None:
        self.bodies = [
            (geometry, _transform(obstacle.pose))
            for obstacle in scene.obstacles
            for geometry in _geometries(obstacle)
        ]

    def points_distance(self, points: Array) -> float:
        """From the hull of points, shape (3 or k, 3), to the nearest obstacle; 0 if touching."""
        moved = triangle(points) if len(points) == 3 else _cloud(points)
        return self._nearest(moved, coal.Transform3s.Identity())

    def pose_distance(self, rig: Rig, pose: Pose) -> float:
        """From the robot at one pose to the nearest obstacle, primitives only; 0 if touching."""
        cables = cables_at(rig, pose)
        found = [self._nearest(coal.Box(*(2.0 * rig.half_size)), _transform(pose))]
        for exit, anchor in zip(cables.exits, cables.anchors, strict=True):
            thread, where = _thread(exit, anchor)
            found.append(self._nearest(thread, where) + 1e-9 - rig.cable_radius)
        return min(found)

    def _nearest(self, moved, where) -> float:
        return min((_distance(moved, where, *body) for body in self.bodies), default=np.inf)


def _distance(first, at_first, second, at_second) -> float:
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance, request.gjk_max_iterations = 1e-9, 2000
    return max(coal.distance(first, at_first, second, at_second, request, result), 0.0)


def _geometries(obstacle: Obstacle) -> list:
    shape = obstacle.shape
    match shape:
        case Box(half_size=half):
            return [coal.Box(*(2.0 * half))]
        case Sphere(radius=radius):
            return [coal.Sphere(radius)]
        case Cylinder(radius=radius, length=length):
            return [coal.Cylinder(radius, length)]
        case Capsule(radius=radius, length=length):
            return [coal.Capsule(radius, length)]
        case _ if "mesh" in obstacle.name and "convex" not in obstacle.name:
            return [triangle(corners) for corners in shape.vertices[shape.triangles]]
        case _:
            return [_cloud(shape.vertices)]


def triangle(corners: Array):
    """A triangle as a convex body with two sides; coal has no distances for its own triangles."""
    points, sides = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for corner in corners:
        points.append(np.array(corner))
    sides.append(coal.Triangle(0, 1, 2))
    sides.append(coal.Triangle(0, 2, 1))
    return coal.Convex(points, sides)


def _cloud(points: Array):
    cloud = coal.StdVec_Vec3s()
    for point in points:
        cloud.append(np.array(point))
    return coal.Convex.convexHull(cloud, False, "")


def _transform(pose: Pose):
    return coal.Transform3s(np.array(pose.rotation), np.array(pose.position))


def _thread(start: Array, end: Array):
    x, y, z = (end - start).tolist()
    length = math.hypot(x, y, z)
    x, y, z = x / length, y / length, z / length
    # Axes at right angles to the thread (Duff et al., "Building an Orthonormal Basis", 2017).
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    right, up = (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
    turned = np.array([right, up, (x, y, z)]).T
    return coal.Capsule(1e-9, length), coal.Transform3s(turned, (start + end) / 2.0)
