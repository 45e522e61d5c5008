"""Clearance along a run: from the drives' positions and, with a camera, from the tags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cdpr.clearance import ClearanceModel, Nearest
from cdpr.poses import Array, Pose
from cdpr.winches import WinchMap
from executor.clearance_table import ClearanceTable, no_clearance
from executor.drives_covariance import covariance_by_drives
from tracking.measured_clearance import MeasuredClearance, clearance_at

#: What the covariance of a pose by the drives does not know, [m]: forward kinematics takes cables
#: for straight and weightless, and the rig for as it was calibrated.
ALLOWANCE = 1e-4


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
    def at(
        cls, time: float, source: str, clearance: MeasuredClearance, planned: tuple[Nearest, ...]
    ) -> ClearanceRow:
        """The row of a measured pose."""
        measured, spread = clearance.nearest, clearance.uncertainty
        return cls(time, source, measured, spread, clearance.at_most, planned)


def encoder_rows(
    model: ClearanceModel,
    winches: WinchMap,
    times: Array,
    measured: Sequence[Pose],
    planned: Sequence[Pose],
    noise: Array,
) -> list[ClearanceRow]:
    """A row for each pose that follows from the drives' positions; none without an obstacle.

    Args:
        model: Robot and scene.
        winches: Of the robot.
        times: Of n poses, shape (n,), [s].
        measured: By the drives, ``world_from_platform``.
        planned: At the same times.
        noise: Of the tensions that the drives tell, shape (m,), [N].
    """
    rows = []
    for time, at, due in zip(times.tolist(), measured, planned, strict=True):
        covariance = covariance_by_drives(winches, model.rig, at, noise)
        clearance = clearance_at(model, at, covariance, ALLOWANCE)
        if clearance is not None:
            rows.append(ClearanceRow.at(time, "encoder", clearance, model.obstacles(due)))
    return rows


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
