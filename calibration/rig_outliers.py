"""Leaves out places that contradict the others: a drive that slipped, a pose that was mistaken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calibration.rig_fit import RigFit
from calibration.rig_measurements import RigMeasurements
from cdpr.poses import Array

FAR_OFF = 4.0
"""A place is left out that is so many times as far off as the median,"""
OFF = 2.0
"""and farther off than so many of the standard deviations that were stated."""


def without_outliers(measured: RigMeasurements, fit: RigFit, fewest: int) -> RigMeasurements:
    """The places that agree with each other; the others are named as unused.

    Args:
        measured: Places at rest.
        fit: Of all of them, robust.
        fewest: Nothing is left out where fewer places than that would remain.
    """
    cables = fit.residuals / fit.deviations
    misfits = _misfits(cables, fit.pose_misfits, measured)
    usual = float(np.median(misfits))
    bad = misfits > max(FAR_OFF * usual, OFF)
    if not bad.any() or len(measured) - int(bad.sum()) < fewest:
        return measured
    unused = dict(measured.unused)
    for k in np.flatnonzero(bad):
        worst = int(np.argmax(np.abs(cables[k])))
        by_pose = fit.pose_misfits[k] > abs(cables[k, worst])
        what = "pose" if by_pose else f"cable {worst + 1}"
        apart = fit.positions[k] - measured.positions[k]
        off = float(np.linalg.norm(apart)) if by_pose else float(abs(fit.residuals[k, worst]))
        unused[measured.names[k]] = (
            f"contradicts the others: {what} is {off * 1e3:.3g} mm off, the place"
            f" {misfits[k] / usual:.3g} times as far as most"
        )
    return replace(measured, unused=unused).part(~bad)


def _misfits(cables: Array, poses: Array, measured: RigMeasurements) -> Array:
    """How far off places are, RMS in standard deviations, shape (n,)."""
    freedom = np.maximum(cables.shape[1] - 6 * ~measured.posed, 1)
    misfits: Array = np.sqrt((np.sum(cables**2, axis=1) + poses**2) / freedom)
    return misfits
