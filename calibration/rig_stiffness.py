"""Whether the data tell of another stiffness of the cables than the rig file.

One step of the fit with the compliance (1 / stiffness) as one more number that the rig file does
not tell, all others and the poses eliminated: a wrong stiffness makes residuals grow with tension
and length alike, and nothing else does. The other numbers would hide a part of it, and their
intervals would be false. Where the stiffness is among them, the doubt that was stated counts too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.rig_calibration import RigCalibration
from calibration.rig_model import RigModel

CONTRADICTION = 4.0
"""So many standard deviations from the rig file are no chance."""


@dataclass(frozen=True, slots=True)
class Compliance:
    """What the data tell of the cables' compliance, 1 / stiffness.

    Attributes:
        drawn: By the rig file, [1/N].
        told: By the data, [1/N].
        deviation: Standard deviation of the difference, [1/N].
    """

    drawn: float
    told: float
    deviation: float

    @property
    def contradicts(self) -> bool:
        """Whether the data tell another one than the rig file."""
        return abs(self.told - self.drawn) > CONTRADICTION * self.deviation

    def __str__(self) -> str:
        """The stiffness that the data tell, in words."""
        if self.told > 0.0:
            return f"about {1.0 / self.told:.2g} N"
        return "more than can be told"


def compliance_told(result: RigCalibration) -> Compliance | None:
    """What the data tell; None where the tensions were not measured in all places.

    Args:
        result: The fit with the rig file's stiffness.
    """
    data, fit, parameters = result.measured, result.fit, result.parameters
    if not np.isfinite(data.tensions).all():
        return None
    model = RigModel(parameters, data)
    line = model.linearised(fit.values, fit.positions, fit.rotations)
    by_compliance = -model.counted.by_compliance(result.geometry)
    free = parameters.deviations[:, None] * result.observability.known
    by_all = np.concatenate([line.by_values @ free, by_compliance[..., None]], axis=2)
    weights = fit.weights / result.length_deviation**2
    weighted = weights[..., None] * line.by_pose
    poses = np.swapaxes(line.by_pose, 1, 2) @ weighted
    poses[data.posed] += np.linalg.inv(data.covariances[data.posed])
    mixed = np.swapaxes(by_all, 1, 2) @ weighted
    gained = np.linalg.solve(poses, np.swapaxes(mixed, 1, 2))
    told = np.einsum("nmp,nm,nmq->pq", by_all, weights, by_all)
    told -= np.einsum("npi,niq->pq", mixed, gained)
    told[:-1, :-1] += np.eye(free.shape[1])
    own = told[-1, -1] - told[-1, :-1] @ np.linalg.solve(told[:-1, :-1], told[:-1, -1])
    pull = float(np.sum(by_compliance * weights * fit.residuals))
    drawn = 1.0 / result.rig.cable_stiffness
    return Compliance(drawn, drawn - pull / float(own), float(own) ** -0.5)
