"""Wrench feasibility: weight, payload and the box of disturbances within the tensions."""

from __future__ import annotations

import numpy as np

from cdpr.cables import cables_to
from cdpr.kinematics import structure_matrix_of
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.scene import Scene
from cdpr.statics.dexterity import rms_anchor_radius
from cdpr.statics.feasibility import WrenchBox, capacity_margin
from cdpr.statics.working import weight_wrench


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
