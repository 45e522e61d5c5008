"""Two edge checkers for the same question: whether the robot keeps the scene's clearance.

(a) python-fcl as a user would call it: distances at poses a few millimetres apart along the edge.
(b) our compiled checker, exact from end to end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import fcl
import numba
import numpy as np

from model.kinematics import cables_at
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene
from model.shapes import Box, Capsule, Cylinder, Obstacle, Sphere
from planner.collision.edges import edge_free
from planner.collision.world import build_world
from planner.kernels.scene_arrays import World

EdgeCheck = Callable[[float, float, float, float, float, float], bool]
SPACING = 0.005
"""Spacing of the poses that python-fcl checks, [m]."""
_THREAD = 1e-4
"""Radius of the capsule that represents a cable of zero thickness, [m]."""


def exact_edges(rig: Rig, scene: Scene) -> EdgeCheck:
    """Checks of translations given as six coordinates, compiled for this scene."""
    world: World = build_world(rig, scene, scene.start.rotation, scene.obstacle_clearance)

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def check(x: float, y: float, z: float, u: float, v: float, w: float) -> bool:
        start, end = np.empty(3), np.empty(3)
        start[0], start[1], start[2] = x, y, z
        end[0], end[1], end[2] = u, v, w
        return edge_free(world, start, end)

    check(*scene.start.position.tolist(), *scene.start.position.tolist())
    made: EdgeCheck = check
    return made


class FclStates:
    """Distances of all bodies to all obstacles at one position."""

    def __init__(self, rig: Rig, scene: Scene) -> None:
        """Builds the collision objects once."""
        self._rig = rig
        self._rotation = scene.start.rotation
        self._clearance = scene.obstacle_clearance
        self._obstacles = [_placed(_shape(o), o.pose) for o in scene.obstacles]
        self._platform = fcl.CollisionObject(fcl.Box(*(2.0 * rig.half_size)))
        self._request = fcl.DistanceRequest()

    def free(self, x: float, y: float, z: float) -> bool:
        """Whether every distance is at least the scene's clearance."""
        pose = Pose(np.array([x, y, z]), self._rotation)
        self._platform.setTransform(fcl.Transform(pose.rotation, pose.position))
        if not self._apart(self._platform, self._clearance):
            return False
        cables = cables_at(self._rig, pose)
        radius = max(self._rig.cable_radius, _THREAD)
        needed = self._clearance - (radius - self._rig.cable_radius)
        spans = cables.anchors - cables.exits
        lengths = np.linalg.norm(spans, axis=1)
        frames, middles = _frames(spans / lengths[:, None]), (cables.anchors + cables.exits) / 2.0
        for frame, middle, length in zip(frames, middles, lengths.tolist(), strict=True):
            thread = fcl.CollisionObject(fcl.Capsule(radius, length), fcl.Transform(frame, middle))
            if not self._apart(thread, needed):
                return False
        return True

    def _apart(self, body: Any, needed: float) -> bool:
        return all(
            fcl.distance(body, obstacle, self._request, fcl.DistanceResult()) >= needed
            for obstacle in self._obstacles
        )


def _frames(axes: Array) -> Array:
    """Rotations that map z to unit vectors, shape (k, 3) → (k, 3, 3)."""
    helpers = np.where(np.abs(axes[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(axes, helpers)
    x /= np.linalg.norm(x, axis=1)[:, None]
    frames: Array = np.stack([x, np.cross(axes, x), axes], axis=-1)
    return frames


def _placed(shape: Any, pose: Pose) -> Any:
    return fcl.CollisionObject(shape, fcl.Transform(pose.rotation, pose.position))


def _shape(obstacle: Obstacle) -> Any:
    match obstacle.shape:
        case Box(half_size=half):
            return fcl.Box(*(2.0 * half))
        case Sphere(radius=radius):
            return fcl.Sphere(radius)
        case Cylinder(radius=radius, length=length):
            return fcl.Cylinder(radius, length)
        case Capsule(radius=radius, length=length):
            return fcl.Capsule(radius, length)
        case other:
            raise SystemExit(f"this benchmark does not support {type(other).__name__}")
