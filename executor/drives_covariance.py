"""How exactly the drives tell where the platform is: whole counts, and stretch by noisy torques."""

from __future__ import annotations

import numpy as np

from cdpr.kinematics import cable_lengths, structure_matrix
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.winches import WinchMap

#: Standard deviation of a normal distribution by the median of its absolute values.
_BY_MEDIAN = 1.4826


def tension_noise(rig: Rig, tensions: Array) -> Array:
    """Standard deviation of the tensions that torques tell, by what changes between two cycles.

    What the platform's motion changes in a cycle counts as noise, too: a torque may be a cycle old.

    Args:
        rig: The robot.
        tensions: Of every cycle, shape (n, m), [N]; NaN where none was told.

    Returns:
        Shape (m,), [N].
    """
    # One is the smallest step of a torque: drives tell whole per mille of the rated one.
    rounding: Array = np.abs(rig.tensions_by(np.ones(rig.cable_count))) / np.sqrt(12.0)
    steps = np.abs(np.diff(tensions, axis=0))
    known = np.isfinite(steps).all(axis=1)
    if not known.any():
        return rounding
    told = _BY_MEDIAN * np.median(steps[known], axis=0) / np.sqrt(2.0)
    noise: Array = np.hypot(told, rounding)
    return noise


def covariance_by_drives(winches: WinchMap, rig: Rig, pose: Pose, noise: Array) -> Array:
    """Covariance of a pose that fits the cable lengths which the drives tell.

    Args:
        winches: Of the robot.
        rig: The robot.
        pose: ``world_from_platform``.
        noise: See `tension_noise`, shape (m,), [N].

    Returns:
        Of position and rotation vector about world axes, shape (6, 6), [m, rad].
    """
    counts = 1.0 / np.abs(winches.counts_per_metre) / np.sqrt(12.0)
    whole = cable_lengths(rig, pose) + winches.behind_outlet
    lengths = np.hypot(counts, whole / winches.stiffness * noise)
    spread = np.linalg.pinv(structure_matrix(rig, pose).T) * lengths
    covariance: Array = spread @ spread.T
    return covariance
