"""Wrench feasibility along edges: weight, payload and the box of disturbances within the tensions.

An edge is feasible when the capacity margin is above a reserve at samples at most 5 mm apart. While
the tree grows, samples whose margin is far above the reserve are read from a lattice over the
workspace (corners computed when first needed, trilinear between them); nearer to the limit the
margin itself is computed. This is a search rule, not a proof: the proof, with a bound of how fast
the margin can change between samples, is `planner.check`, which every finished plan passes.
"""

from __future__ import annotations

import numpy as np

from cdpr.cables import cables_to
from cdpr.kinematics import structure_matrix_of
from cdpr.poses import Array, Pose, interpolate
from cdpr.rig import Rig
from cdpr.scene import Scene
from cdpr.statics.dexterity import rms_anchor_radius
from cdpr.statics.feasibility import WrenchBox, capacity_margin
from cdpr.statics.working import weight_wrench
from planner.lattice import Lattice, corners_and_weights

_SAMPLING = 0.005
_FAR_FROM_LIMIT = 5.0


def external_wrenches(rig: Rig, scene: Scene, rotation: Array) -> WrenchBox:
    """The wrenches that must be held at an orientation, shape (3, 3): weight and disturbances."""
    load = scene.load
    weight = weight_wrench(rig, Pose(rig.home.position, rotation), load)
    return WrenchBox(weight, np.concatenate([load.force, load.moment]))


def capacity_margins(rig: Rig, scene: Scene, positions: Array, rotation: Array) -> Array:
    """Capacity margins at one orientation, positions shape (k, 3), [m]; shape (k,), [N].

    Moments are divided by the root mean square radius of the anchors.
    """
    anchors = rig.anchors @ rotation.T + positions[:, None, :]
    matrices = structure_matrix_of(cables_to(rig, anchors), positions)
    return capacity_margin(
        matrices,
        rig.min_tension,
        rig.max_tension,
        external_wrenches(rig, scene, rotation),
        rms_anchor_radius(rig.anchors),
    )


class FeasibleEdges:
    """Whether the cables can hold the platform along an edge."""

    def __init__(self, rig: Rig, scene: Scene, rotation: Array, reserve: float) -> None:
        """Prepares an empty lattice.

        Args:
            rig: The robot.
            scene: Its load.
            rotation: The orientation for which the lattice is made, shape (3, 3).
            reserve: Smallest allowed capacity margin, [N].
        """
        self.rig = rig
        self.scene = scene
        self.reserve = reserve
        self._rotation = rotation
        self._lattice = Lattice.over(rig.workspace_lower, rig.workspace_upper)
        self._margins = np.full(self._lattice.count, np.nan)

    def feasible(self, start: Pose, end: Pose) -> bool:
        """Whether the margin stays above the reserve from ``start`` to ``end``."""
        travel = start.distance_to(end) + start.angle_to(end) * float(
            np.linalg.norm(self.rig.half_size)
        )
        shares = np.linspace(0.0, 1.0, int(np.ceil(travel / _SAMPLING)) + 1)
        if not np.array_equal(start.rotation, end.rotation) or not np.array_equal(
            start.rotation, self._rotation
        ):
            poses = [interpolate(start, end, s) for s in shares.tolist()]
            return all(self._margin(pose) >= self.reserve for pose in poses)
        points = start.position + shares[:, None] * (end.position - start.position)
        near = self._from_lattice(points) < _FAR_FROM_LIMIT * self.reserve
        if not near.any():
            return True
        margins = capacity_margins(self.rig, self.scene, points[near], self._rotation)
        return bool(np.all(margins >= self.reserve))

    def _margin(self, pose: Pose) -> float:
        at = pose.position[None, :]
        return float(capacity_margins(self.rig, self.scene, at, pose.rotation)[0])

    def _from_lattice(self, points: Array) -> Array:
        corners, weights = corners_and_weights(self._lattice, points)
        missing = np.unique(corners[np.isnan(self._margins[corners])])
        if len(missing):
            where = self._lattice.points(missing)
            self._margins[missing] = capacity_margins(self.rig, self.scene, where, self._rotation)
        interpolated: Array = np.sum(self._margins[corners] * weights, axis=-1)
        return interpolated
