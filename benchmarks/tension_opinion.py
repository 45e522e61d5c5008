"""Feasibility of a load by a quadratic program, with its solution verified in the equations."""

from __future__ import annotations

from itertools import product

import daqp
import numpy as np

from model.kinematics import cables_to
from model.pose import Array
from model.rig import Rig
from model.scene import Scene

GRAVITY = 9.80665
_BALANCED = 1e-6
"""Largest wrench residual, [N] and [N m]."""
_RELEASED = 1e-4
"""Largest violation of the tension limits, [N]."""


def tension_problem(rig: Rig, scene: Scene, position: Array) -> str:
    """A problem if tensions cannot hold weight, payload and all corner disturbances; else empty.

    Args:
        rig: The robot.
        scene: Its load, and the orientation of its start.
        position: Of the platform, shape (3,), [m].
    """
    rotation, load = np.array(scene.start.rotation), scene.load
    arms = rig.anchors @ rotation.T
    cables = cables_to(rig, arms + position)
    pulls = cables.exits - cables.anchors
    pulls = pulls / np.linalg.norm(pulls, axis=1)[:, None]
    matrix = np.hstack([pulls, np.cross(arms, pulls)]).T
    down = np.array([0.0, 0.0, -GRAVITY])
    weight = np.zeros(6)
    for mass, centre in (
        (rig.mass, rig.centre_of_mass),
        (load.payload_mass, load.payload_centre),
    ):
        weight += np.append(mass * down, np.cross(rotation @ centre, mass * down))
    spread = np.concatenate([load.force, load.moment])
    signs = [(-1.0, 1.0) if part > 0.0 else (0.0,) for part in spread]
    low, high = (np.full(rig.cable_count, t) for t in (rig.min_tension, rig.max_tension))
    for corner in product(*signs):
        wanted = -(weight + np.array(corner) * spread)
        if not _balanced(matrix, wanted, low, high):
            return "no tensions hold the load"
    return ""


def _balanced(matrix: Array, wanted: Array, low: Array, high: Array) -> bool:
    count = matrix.shape[1]
    sense = np.zeros(count + 6, dtype=np.int32)
    sense[count:] = 5  # equality
    tensions, _, flag, _ = daqp.solve(
        np.eye(count), -(low + high) / 2.0, np.ascontiguousarray(matrix),
        np.concatenate([high, wanted]), np.concatenate([low, wanted]), sense,
    )  # fmt: skip
    if flag != 1:
        return False
    kept = (tensions >= low - _RELEASED) & (tensions <= high + _RELEASED)
    return bool(kept.all() and np.abs(matrix @ tensions - wanted).max() <= _BALANCED)
