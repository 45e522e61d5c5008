"""The tensions of places where nobody measured them, and how far off those may be."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from calibration.rig_measurements import RigMeasurements
from cdpr.poses import Array, Pose
from cdpr.rig import Rig
from cdpr.statics.tension_solution import TensionInfeasible
from cdpr.statics.working import PRETENSION_SHARE, working_tensions


def tension_doubt(rig: Rig) -> float:
    """How far off tensions may be that were not measured, one standard deviation, [N].

    Cables of a rig that is not built as its file says pull against each other. They were not slack,
    so the least allowed tension is taken to be two standard deviations below the pretension.
    """
    return PRETENSION_SHARE * (rig.max_tension - rig.min_tension) / 2.0


def likely_tensions(rig: Rig, measured: RigMeasurements) -> Array:
    """Tensions as measured; else the working ones of the place, shape (n, m), [N].

    Where the pose is not known, or such that the rig file's cables cannot hold the platform there,
    they are those of home: `tension_doubt` holds for both.

    Args:
        rig: As its file tells it.
        measured: Places at rest.

    Raises:
        TensionInfeasible: The rig cannot hold its platform at home.
    """
    told = np.isfinite(measured.tensions)
    likely = np.tile(working_tensions(rig, rig.home).tensions, (len(measured), 1))
    for k in np.flatnonzero(measured.posed & ~told.all(axis=1)):
        with suppress(TensionInfeasible):
            pose = Pose(measured.positions[k], measured.rotations[k])
            likely[k] = working_tensions(rig, pose).tensions
    return np.where(told, measured.tensions, likely)
