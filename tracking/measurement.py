"""What a tracker says about one picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.poses import Array, Pose


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """A measured pose of the platform.

    Attributes:
        time: Of the picture, [s].
        pose: ``world_from_platform``.
        covariance: Of position [m] and rotation vector [rad] along the world's axes, shape (6, 6).
            It holds the scatter of the corners, not errors of the camera's place or of the tags'.
        tags: Numbers of the tags it rests on.
        reprojection: RMS error of their corners, [px].
        status: ``found`` (searched in the whole picture), ``tracked`` (where it was expected) or
            ``guided`` (where the drives' positions put it).
    """

    time: float
    pose: Pose
    covariance: Array
    tags: tuple[int, ...]
    reprojection: float
    status: str

    @property
    def position_deviation(self) -> Array:
        """Standard deviations of the position, world axes, shape (3,), [m]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def rotation_deviation(self) -> Array:
        """Standard deviations of the rotation vector, world axes, shape (3,), [rad]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))


@dataclass(frozen=True, slots=True)
class NoPose:
    """A picture that gives no pose.

    Attributes:
        time: Of the picture, [s].
        reason: Why.
        seen: Numbers of the tags of the rig's family that were seen.
    """

    time: float
    reason: str
    seen: tuple[int, ...] = ()


Observation = PoseMeasurement | NoPose
