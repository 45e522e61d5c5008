"""How well places determine a rig's numbers: by the scatter of cables, and place by place.

The scatter alone promises too much where residuals of one place err together: a pose that is off,
a cable law that is not the rig file's. The spread of the fits without any one place (the jackknife
over places, to first order) feels that. The rig file's numbers are a measurement beside the places,
stated and never left out.

Source: Efron & Tibshirani, "An Introduction to the Bootstrap", 1993, ch. 11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from calibration.interval import CONFIDENCE
from calibration.rig_fit import RigFit
from calibration.rig_measurements import RigMeasurements
from calibration.rig_observability import Observability
from calibration.rig_parameters import Parameters
from cdpr.poses import Array, read_only


@dataclass(frozen=True, slots=True, eq=False)
class RigUncertainty:
    """What is known about the errors of a rig's numbers, [m] or share.

    Attributes:
        by_scatter: Covariance, shape (p, p); what is not identified has that of the rig file.
        by_places: The same by what leaving each place out changes.
        scatter: By how much the residuals' variance is larger than stated; 1 where it is not.
        quantile: Half the width of a 95 % interval in standard deviations.
    """

    by_scatter: Array
    by_places: Array
    scatter: float
    quantile: float

    @property
    def half_widths(self) -> Array:
        """Of the 95 % intervals, the larger of both, shape (p,)."""
        return self.worst(np.eye(len(self.by_scatter))[:, None])

    def worst(self, slopes: Array) -> Array:
        """How far off vectors that depend on the numbers may be, along their worst direction.

        Args:
            slopes: Their derivatives by the numbers, shape (k, d, p).

        Returns:
            95 %, shape (k,).
        """
        variances = [
            np.linalg.eigvalsh(slopes @ covariance @ np.swapaxes(slopes, 1, 2))[:, -1]
            for covariance in (self.by_scatter, self.by_places)
        ]
        worst: Array = self.quantile * np.sqrt(np.maximum(*variances))
        return worst


def uncertainty_of_rig(
    parameters: Parameters,
    measured: RigMeasurements,
    fit: RigFit,
    observability: Observability,
) -> RigUncertainty:
    """The uncertainty of a fit.

    Args:
        parameters: The unknowns.
        measured: Places at rest.
        fit: Of them, in the directions that they tell; where residuals tell of lengths farther off
            than they were taken to be, that holds.
        observability: Which those are.
    """
    known, unknown = observability.known, observability.unknown
    informations = known.T @ fit.informations @ known
    scores = fit.scores @ known
    whole = informations.sum(axis=0) + np.eye(known.shape[1])
    squares = float(np.sum(fit.weights * (fit.residuals / fit.deviations) ** 2))
    freedom = fit.residuals.size - known.shape[1] - 6 * int((~measured.posed).sum())
    scatter = max(1.0, squares / max(freedom, 1))
    count = len(measured)
    without = np.linalg.solve(whole - informations, scores[..., None])[..., 0]
    apart = without - without.mean(axis=0)
    by_drawing = np.linalg.inv(whole @ whole)
    places = (count - 1) / count * apart.T @ apart + by_drawing
    spread = parameters.deviations
    of_all = (
        known @ inner @ known.T + unknown @ unknown.T
        for inner in (scatter * np.linalg.inv(whole), places)
    )
    by_scatter, by_places = (read_only(inner * np.outer(spread, spread)) for inner in of_all)
    quantile = float(student.ppf(0.5 + CONFIDENCE / 2.0, count - 1))
    return RigUncertainty(by_scatter, by_places, scatter, quantile)
