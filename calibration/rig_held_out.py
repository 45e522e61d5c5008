"""How well a rig's numbers tell places that the fit has not seen, each left out once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.rig_fit import poses_from_lengths
from calibration.rig_measurements import RigMeasurements
from calibration.rig_model import RigModel
from calibration.rig_observability import identified
from calibration.rig_parameters import Parameters, rig_with
from cdpr.kinematics import poses_near
from cdpr.poses import Array

FOLDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Places that a fit has not seen, each left out once.

    Attributes:
        before: How far off they are by the rig file, shape (n,), [m].
        after: By the fits that did not see them, shape (n,), [m].
        poses: Distances of positions; else of cables from any pose, for lengths alone.
    """

    before: Array
    after: Array
    poses: bool


def held_out(parameters: Parameters, measured: RigMeasurements, length_deviation: float) -> HeldOut:
    """Fits without every fifth place in turn, and looks at those.

    Args:
        parameters: The unknowns.
        measured: Places at rest.
        length_deviation: Of a cable's length as a drive tells it, [m].

    Raises:
        Fault: A part of the measurements cannot be fitted.
    """
    n = len(measured)
    posed = bool(measured.posed.all())
    before, after = np.empty(n), np.empty(n)
    zero = np.zeros(len(parameters))
    for fold in range(FOLDS):
        out = np.arange(n) % FOLDS == fold
        rest, left_out = measured.part(~out), measured.part(out)
        fit, _ = identified(parameters, rest, length_deviation)
        for errors, values in ((before, zero), (after, fit.values)):
            errors[out] = _errors(parameters, values, left_out, posed)
    return HeldOut(before, after, posed)


def _errors(parameters: Parameters, values: Array, measured: RigMeasurements, posed: bool) -> Array:
    """How far off places are that a fit has not seen, shape (n,), [m]."""
    model, geometry = RigModel(parameters, measured), parameters.geometry(values)
    lengths, rig = model.counted.by(geometry), rig_with(parameters.rig, geometry)
    if not posed:
        found = poses_from_lengths(rig, lengths)
        return np.array([float(np.sqrt(np.mean(one.residual**2))) for one in found])
    positions, _ = poses_near(rig, lengths, measured.positions, measured.rotations, steps=8)
    return np.asarray(np.linalg.norm(positions - measured.positions, axis=1))
