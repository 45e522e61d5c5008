"""Clearance along a run: from the drives' positions and, with a camera, from the tags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpr.clearance import ClearanceModel, Nearest
from cdpr.poses import Array, Pose
from executor.clearance_table import ClearanceTable, no_clearance
from tracking.measured_clearance import MeasuredClearance

#: What a clearance from drive positions may be off by: counts, torque resolution, one cycle, [m].
ENCODER_UNCERTAINTY = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceRow:
    """Distances at one measured pose, one entry an obstacle.

    Attributes:
        time: [s].
        source: As `ClearanceTable` has it.
        measured: At the measured pose.
        uncertainty: How much less than the smallest of them the smallest true one may be, [m].
        at_most: The smallest true one is no more than this, [m].
        planned: At the planned pose of the same time.
    """

    time: float
    source: str
    measured: tuple[Nearest, ...]
    uncertainty: float
    at_most: float
    planned: tuple[Nearest, ...]

    @classmethod
    def by_tags(
        cls,
        time: float,
        clearance: MeasuredClearance,
        planned: tuple[Nearest, ...],
        source: str = "tag",
    ) -> ClearanceRow:
        """The row of a pose that the cameras measured, or one of them alone."""
        measured, spread = clearance.nearest, clearance.uncertainty
        return cls(time, source, measured, spread, clearance.at_most, planned)

    @classmethod
    def by_drives(
        cls, time: float, measured: tuple[Nearest, ...], planned: tuple[Nearest, ...]
    ) -> ClearanceRow:
        """The row of a pose that follows from the drives' positions."""
        at_most = min((n.distance for n in measured), default=np.inf) + ENCODER_UNCERTAINTY
        return cls(time, "encoder", measured, ENCODER_UNCERTAINTY, at_most, planned)


def encoder_rows(
    model: ClearanceModel, times: Array, measured: Sequence[Pose], planned: Sequence[Pose]
) -> list[ClearanceRow]:
    """A row for each pose that follows from the drives' positions."""
    return [
        ClearanceRow.by_drives(float(time), model.obstacles(at), model.obstacles(due))
        for time, at, due in zip(times, measured, planned, strict=True)
    ]


def clearance_table(names: tuple[str, ...], rows: Sequence[ClearanceRow]) -> ClearanceTable:
    """Rows as a table; a scene without obstacles has none."""
    if not rows or not names:
        return no_clearance(names)
    nearest = [min(row.measured, key=lambda n: n.distance) for row in rows]
    measured = np.array([[n.distance for n in row.measured] for row in rows])
    planned = np.array([[n.distance for n in row.planned] for row in rows])
    return ClearanceTable(
        time=np.array([row.time for row in rows]),
        source=tuple(row.source for row in rows),
        distance=measured.min(axis=1),
        uncertainty=np.array([row.uncertainty for row in rows]),
        at_most=np.array([row.at_most for row in rows]),
        body=tuple(n.first for n in nearest),
        obstacle=tuple(n.second for n in nearest),
        planned_distance=planned.min(axis=1),
        obstacles=names,
        distances=measured,
        planned_distances=planned,
    )
