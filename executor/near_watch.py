"""Watches measured clearance, picture by picture, for one that is surely below the limit."""

from __future__ import annotations

from tracking.measured_clearance import MeasuredClearance

#: So many pictures in a row must show too little clearance before the run is stopped for it.
NEAR_PICTURES = 2


class NearWatch:
    """Tells when clearance was below a limit in the last pictures, whatever they are off by.

    One picture alone may be wrong for a reason that its covariance does not know.
    """

    def __init__(self, limit: float) -> None:
        """Begins without a picture.

        Args:
            limit: Clearance that the scene asks for, [m].
        """
        self._limit, self._pictures = limit, 0

    def take(self, clearance: MeasuredClearance | None) -> str:
        """What is too near, with numbers, when the last pictures say so; else nothing.

        Args:
            clearance: Of the newest picture with a pose; None in a scene without obstacles.
        """
        if clearance is None or clearance.at_most >= self._limit:
            self._pictures = 0
            return ""
        self._pictures += 1
        if self._pictures < NEAR_PICTURES:
            return ""
        at = clearance.surely_nearest
        near, spread = clearance.nearest[at], float(clearance.uncertainties[at])
        return (
            f"{near.first} to {near.second}: {near.distance * 1e3:.1f} ± {spread * 1e3:.1f} mm;"
            f" the scene asks for {self._limit * 1e3:g} mm"
        )
