"""Clearance at measured poses, with what it may be off by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.clearance import ClearanceModel, Nearest, cable_name
from model.kinematics import Cables, cables_at
from model.pose import Array, Pose, read_only, skew
from tracking.measurement import PoseMeasurement

#: How many standard deviations of the pose an uncertainty holds.
DEVIATIONS = 3.0
#: Added where nobody stated what the camera's place or the tags may be off by, [m].
UNSTATED = 0.5e-3


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredClearance:
    """Distances to every obstacle at a measured pose.

    Attributes:
        nearest: In the order of the scene's obstacles.
        uncertainties: Of each distance: `DEVIATIONS` standard deviations of the measured pose and
            what they do not know; shape (k,), [m].
    """

    nearest: tuple[Nearest, ...]
    uncertainties: Array

    @property
    def distance(self) -> float:
        """The smallest distance, [m]."""
        return min(n.distance for n in self.nearest)

    @property
    def uncertainty(self) -> float:
        """How much less than `distance` the smallest true distance may be, [m].

        More than the nearest obstacle's own uncertainty where one slightly farther away is known
        less well.
        """
        lows = [n.distance - u for n, u in zip(self.nearest, self.uncertainties, strict=True)]
        return self.distance - float(min(lows))

    @property
    def worst_case_obstacle(self) -> int:
        """Number of the obstacle that `at_most` is of."""
        return int(np.argmin(self._highs))

    @property
    def at_most(self) -> float:
        """The smallest true distance is no more than this, [m].

        Each obstacle counts with its own uncertainty: one that is known badly hides no other.
        """
        return float(np.min(self._highs))

    @property
    def _highs(self) -> Array:
        return np.array([n.distance for n in self.nearest]) + self.uncertainties


def clearance_of(model: ClearanceModel, measurement: PoseMeasurement) -> MeasuredClearance | None:
    """Clearance to every obstacle as a camera sees it; None in a scene without obstacles.

    What the camera's place and the tags may be off by counts by its covariance, carried to each
    distance with that of the pose.
    """
    covariance = measurement.covariance + measurement.shared
    allowance = UNSTATED if measurement.unstated else 0.0
    return clearance_at(model, measurement.pose, covariance, allowance)


def clearance_at(
    model: ClearanceModel, pose: Pose, covariance: Array, allowance: float
) -> MeasuredClearance | None:
    """Clearance to every obstacle at a measured pose; None in a scene without obstacles.

    The pose's covariance is carried to the distance by its gradient: the nearest point of the robot
    moves with the platform (wholly on it, in proportion along a cable), and the distance changes by
    that motion along the line to the obstacle; that both nearest points slide changes nothing to
    first order.

    Args:
        model: Robot and scene.
        pose: ``world_from_platform``.
        covariance: Of position and rotation vector about world axes, shape (6, 6), [m, rad].
        allowance: What the covariance does not know, [m].
    """
    nearest = model.obstacles(pose)
    if not nearest:
        return None
    cables = cables_at(model.rig, pose)
    names = {cable_name(i): i for i in range(model.rig.cable_count)}
    deviations = [_deviation(n, names.get(n.first), cables, pose, covariance) for n in nearest]
    return MeasuredClearance(nearest, read_only(DEVIATIONS * np.array(deviations) + allowance))


def _deviation(
    nearest: Nearest, cable: int | None, cables: Cables, pose: Pose, spread: Array
) -> float:
    """Standard deviation of one distance, [m]."""
    share, point = 1.0, nearest.first_point
    if cable is not None:
        start, end = cables.exits[cable], cables.anchors[cable]
        length = float(np.linalg.norm(end - start))
        share = float(np.clip((point - start) @ (end - start) / length**2, 0.0, 1.0))
        point = end
    arm = point - pose.position
    by_pose = share * np.hstack([np.eye(3), -skew(arm)])
    covariance = by_pose @ spread @ by_pose.T
    line = nearest.first_point - nearest.second_point
    length = float(np.linalg.norm(line))
    if length < 1e-9:  # they touch, so the line is unknown: any direction may be the worst
        return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    direction = line / length
    return float(np.sqrt(direction @ covariance @ direction))
