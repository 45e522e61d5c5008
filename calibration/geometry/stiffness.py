"""Whether the data show another stiffness than the rig file, or cables that differ.

One step of the fit with the compliance (1 / stiffness) as one more number that the rig file does
not give, all others and the poses eliminated: a wrong stiffness makes residuals grow with tension
and length alike, and nothing else does. The other numbers would hide a part of it, and their
intervals would be false. Where the stiffness is among them, the doubt that was stated counts too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calibration.geometry.calibrate import RigCalibration
from calibration.geometry.model import RigModel
from model.pose import Array

CONTRADICTION = 4.0
"""This many standard deviations from the rig file are significant."""
LEAST_CHANCE = 1e-3
"""Cables differ where chance explains it less often."""


@dataclass(frozen=True, slots=True)
class Compliance:
    """Estimate of the cables' compliance, 1 / stiffness.

    Attributes:
        drawn: By the rig file, to first order about the fit, [1/N].
        estimated: From the data, [1/N].
        deviation: Standard deviation of the difference, [1/N].
    """

    drawn: float
    estimated: float
    deviation: float

    @property
    def contradicts(self) -> bool:
        """Whether the data contradict the rig file."""
        return abs(self.estimated - self.drawn) > CONTRADICTION * self.deviation

    def __str__(self) -> str:
        """The estimated stiffness, in words."""
        if self.estimated > 0.0:
            return f"about {1.0 / self.estimated:.2g} N"
        return "too high to determine"


@dataclass(frozen=True, slots=True)
class Differences:
    """Estimate of each cable's own compliance.

    Attributes:
        estimated: Shape (m,), [1/N].
        chance: How likely differences from the rig file as large as these are by chance.
    """

    estimated: Array
    chance: float

    @property
    def contradict(self) -> bool:
        """Whether one compliance for all cables does not explain the data."""
        return self.chance < LEAST_CHANCE

    def __str__(self) -> str:
        """The estimated stiffnesses, in words."""
        estimated = (
            f"{1.0 / c:.2g} N" if c > 0.0 else "too high to determine" for c in self.estimated
        )
        return ", ".join(estimated)


def compliance_told(result: RigCalibration) -> Compliance | None:
    """The estimate; None where the tensions were not measured in all samples.

    Args:
        result: The fit with the rig file's stiffness.
    """
    if not np.isfinite(result.measured.tensions).all():
        return None
    information, pull = _told(result, np.ones((result.rig.cable_count, 1)))
    drawn = _drawn(result)
    own = float(information[0, 0])
    return Compliance(drawn, drawn - float(pull[0]) / own, own**-0.5)


def differences_told(result: RigCalibration) -> Differences | None:
    """The estimate of each cable; None where tensions were not measured in all samples.

    Args:
        result: The fit with one stiffness for all cables.
    """
    if not np.isfinite(result.measured.tensions).all():
        return None
    cables = result.rig.cable_count
    information, pull = _told(result, np.eye(cables))
    change = -np.asarray(np.linalg.solve(information, pull))
    chance = float(chi2.sf(-pull @ change, cables))
    estimated: Array = _drawn(result) + change
    return Differences(estimated, chance)


def _drawn(result: RigCalibration) -> float:
    """The rig file's compliance as the fit sees it, [1/N].

    Changes are solved about the fit, whose unknown is the logarithm of the stiffness: the rig
    file is as far off as the tangent there says, not as the reciprocal of its own number.
    """
    fit = result.geometry.stiffness
    return (1.0 + math.log(fit / result.rig.cable_stiffness)) / fit


def _told(result: RigCalibration, groups: Array) -> tuple[Array, Array]:
    """Information on compliances beside all other parameters and the poses, per variance.

    Args:
        result: The fit.
        groups: Which cables share a compliance, shape (m, q).

    Returns:
        Information, shape (q, q), [N²], and half the slope of the squares, shape (q,), [N].
    """
    data, fit, parameters = result.measured, result.fit, result.parameters
    model = RigModel(parameters, data)
    line = model.linearised(fit.values, fit.positions, fit.rotations)
    by_compliance = -model.counted.by_compliance(result.geometry)[..., None] * groups
    free = parameters.deviations[:, None] * result.observability.known
    by_all = np.concatenate([line.by_values @ free, by_compliance], axis=2)
    weights = fit.weights / fit.deviations**2
    weighted = weights[..., None] * line.by_pose
    poses = np.swapaxes(line.by_pose, 1, 2) @ weighted
    poses += data.pose_information(fit.rotations)
    mixed = np.swapaxes(by_all, 1, 2) @ weighted
    gained = np.linalg.solve(poses, np.swapaxes(mixed, 1, 2))
    information = np.einsum("nmp,nm,nmq->pq", by_all, weights, by_all)
    information -= np.einsum("npi,niq->pq", mixed, gained)
    r = free.shape[1]
    information[:r, :r] += np.eye(r)
    own = information[r:, r:] - information[r:, :r] @ np.linalg.solve(
        information[:r, :r], information[:r, r:]
    )
    pull = np.einsum("nmq,nm,nm->q", by_compliance, weights, fit.residuals)
    return own / result.uncertainty.scatter, pull / result.uncertainty.scatter
