"""Clearance at measured poses, with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.cameras import Z_95
from model.clearance import ClearanceModel, Nearest, cable_name
from model.errors import BadInput
from model.kinematics import Cables, cables_at
from model.pose import Array, Pose, points_by_twist, read_only
from model.rig import Camera, Rig
from tracking.measurement import PoseMeasurement, largest_deviations

COVERAGE = 0.95
"""Share of true distances that lie within the stated uncertainty."""
INTERVAL = f"{100.0 * COVERAGE:.0f} % interval"
"""Its name in verdict, report and messages."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredClearance:
    """Distances to every obstacle at a measured pose.

    Attributes:
        nearest: In the order of the scene's obstacles.
        uncertainties: Half widths of each distance's interval with `COVERAGE`, from the measured
            pose, outlets and anchors; shape (k,), [m].
        others: Pairs hardly farther apart, which may be nearer, each with its uncertainty, [m].
    """

    nearest: tuple[Nearest, ...]
    uncertainties: Array
    others: tuple[tuple[Nearest, float], ...] = ()

    @property
    def distance(self) -> float:
        """The smallest distance, [m]."""
        return min(n.distance for n in self.nearest)

    @property
    def uncertainty(self) -> float:
        """`distance` minus the lower bound of the smallest true distance, [m].

        It exceeds the nearest pair's own uncertainty if one slightly farther away is less certain.
        """
        return self.distance - min(near.distance - spread for near, spread in self._pairs)

    @property
    def upper_bound(self) -> tuple[Nearest, float]:
        """The pair that determines `at_most`, and its uncertainty, [m]."""
        return min(self._pairs, key=lambda pair: pair[0].distance + pair[1])

    @property
    def at_most(self) -> float:
        """Upper bound of the smallest true distance, [m].

        Each pair counts with its own uncertainty.
        """
        near, spread = self.upper_bound
        return near.distance + spread

    @property
    def _pairs(self) -> list[tuple[Nearest, float]]:
        own: list[float] = self.uncertainties.tolist()
        return [*zip(self.nearest, own, strict=True), *self.others]


def clearance_of(model: ClearanceModel, measurement: PoseMeasurement) -> MeasuredClearance | None:
    """Clearance to every obstacle at a measurement; None in a scene without obstacles.

    Covariances of lens, extrinsics, tags, outlets, anchors and pose are propagated to each
    distance.

    Raises:
        BadInput: There are obstacles, and a part of these is not stated.
    """
    if not model.obstacle_names:
        return None
    if measurement.unstated:
        raise BadInput(
            "the error of this pose is unknown, so the clearance has no interval",
            next_step="calibrate, or state `error_mm` of the camera in the rig file",
        )
    covariance = measurement.covariance + measurement.shared
    return clearance_at(model, measurement.pose, covariance, 0.0, measurement.cable_error)


def clearance_at(
    model: ClearanceModel,
    pose: Pose,
    covariance: Array,
    allowance: float,
    cable_error: float = 0.0,
) -> MeasuredClearance | None:
    """Clearance to every obstacle at a measured pose; None in a scene without obstacles.

    The pose's covariance is propagated to the distance by its gradient: the robot's nearest point
    moves with the platform (fully on it, in proportion along a cable), and the distance changes by
    that motion along the line to the obstacle; sliding of the nearest points has no first-order
    effect.

    Args:
        pose: ``world_from_platform``.
        covariance: Of position and rotation vector about world axes, shape (6, 6), [m, rad].
        allowance: Added for errors outside the covariance, [m].
        cable_error: Error of cables, 95 %, anywhere along them, [m], that the covariance states for
            their anchors; 0 to use the rig's `outlet_error` and `anchor_error`.
    """
    if not model.obstacle_names:
        return None
    cables = cables_at(model.rig, pose)
    names = {cable_name(i): i for i in range(model.rig.cable_count)}
    at_ends = (model.rig.outlet_error or 0.0, model.rig.anchor_error or 0.0)
    ends = np.array((cable_error, 0.0) if cable_error > 0.0 else at_ends) / Z_95

    def uncertainty(near: Nearest) -> float:
        cable = names.get(near.first)
        variance = _variance(near, cable, cables, pose, covariance, ends, cable_error > 0.0)
        return Z_95 * math.sqrt(variance) + allowance

    nearby = model.near(pose, _largest_difference(model.rig, covariance, ends))
    nearest = tuple(bodies[0] for bodies in nearby)
    others = tuple((near, uncertainty(near)) for bodies in nearby for near in bodies[1:])
    own = read_only(np.array([uncertainty(near) for near in nearest]))
    return MeasuredClearance(nearest, own, others)


def _largest_difference(rig: Rig, covariance: Array, ends: Array) -> float:
    """Largest possible uncertainty of any distance, 95 %, without the allowance, [m]."""
    points = np.vstack([rig.anchors, rig.platform_corners])
    reach = float(np.linalg.norm(points, axis=1).max())
    position, turn = largest_deviations(covariance)
    return Z_95 * math.hypot(position + reach * turn, float(ends.max()))


def _variance(
    nearest: Nearest,
    cable: int | None,
    cables: Cables,
    pose: Pose,
    spread: Array,
    ends: Array,
    is_shared: bool,
) -> float:
    """Variance of one distance, [m²]; ``ends``: deviations of outlets and anchors, [m].

    ``is_shared``: the first of them is of the whole cable, from what moves both ends together.
    """
    share, point, own = 1.0, nearest.first_point, 0.0
    if cable is not None:
        start, end = cables.exits[cable], cables.anchors[cable]
        length = float(np.linalg.norm(end - start))
        share = float(np.clip((point - start) @ (end - start) / length**2, 0.0, 1.0))
        point = end
        at_outlet = 1.0 - share**2 if is_shared else (1.0 - share) ** 2
        own = at_outlet * ends[0] ** 2 + (share * ends[1]) ** 2
    arm = point - pose.position
    by_pose = share * points_by_twist(arm)
    covariance = by_pose @ spread @ by_pose.T
    line = nearest.first_point - nearest.second_point
    length = float(np.linalg.norm(line))
    if length < 1e-9:  # contact: the direction is unknown, so the worst counts
        return own + float(np.linalg.eigvalsh(covariance)[-1])
    direction = line / length
    return own + float(direction @ covariance @ direction)


def missing_errors(rig: Rig, camera: Camera) -> tuple[str, ...]:
    """Parts of the chain from lens to cables whose errors are not stated.

    Returns:
        Keys of the rig file, and the verbs that calibrate them; empty if all are stated.
    """
    stated = {
        "lens_covariance (`cdpr calibrate camera`)": camera.lens_covariance,
        "pose_covariance (`cdpr calibrate extrinsics`)": camera.pose_covariance,
        "tags: error_mm (`cdpr calibrate tags`)": rig.tag_error,
        "outlets_error_mm (`cdpr calibrate rig`)": rig.outlet_error,
        "anchors_error_mm (`cdpr calibrate rig`)": rig.anchor_error,
    }
    return tuple(key for key, value in stated.items() if value is None)


def require_stated_errors(
    rig: Rig, cameras: Sequence[Camera], use: str = "measure clearance", then: str = ""
) -> None:
    """Refuses to measure with unknown errors.

    Args:
        cameras: That measure.
        use: What they are to do.
        then: The step after a change of the rig file.

    Raises:
        BadInput: For a camera with unknown errors; it asks for one number.
    """
    for camera in cameras:
        missing = missing_errors(rig, camera)
        if missing and camera.error is None:
            raise BadInput(
                f"the measuring error of camera {camera.name!r} is unknown, so it cannot {use}",
                where=f"rig {rig.name}",
                why=f"calibrations have not stated {', '.join(missing)}",
                next_step=f"add `error_mm` to camera {camera.name!r} in the rig file: the error of"
                f" the measured platform and cables, 95 %; or run these calibrations{then}",
                values={"camera": camera.name},
            )


# Monitoring of measured clearance: its upper bound against the limit.


#: Consecutive images with too small a clearance that stop the run.
NEAR_IMAGES = 2


class ClearanceMonitor:
    """Detects clearance below a limit in the last images, beyond their uncertainty.

    A single image may have an error that its covariance does not include.
    """

    def __init__(self, limit: float) -> None:
        """Starts without an image.

        Args:
            limit: Clearance required by the scene, [m].
        """
        self._limit, self._pictures = limit, 0

    def take(self, clearance: MeasuredClearance | None) -> str:
        """The pair below the limit, with values, if the last images agree; else empty.

        Args:
            clearance: Of the newest image with a pose; None in a scene without obstacles.
        """
        if clearance is None or clearance.at_most >= self._limit:
            self._pictures = 0
            return ""
        self._pictures += 1
        if self._pictures < NEAR_IMAGES:
            return ""
        near, spread = clearance.upper_bound
        return (
            f"{near.first} to {near.second}: {near.distance * 1e3:.1f} ± {spread * 1e3:.1f} mm"
            f" ({INTERVAL});"
            f" the scene requires {self._limit * 1e3:g} mm"
        )
