"""The space that is searched: which numbers stand for a pose, and their bounds."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from cdpr.poses import Array, Pose
from cdpr.rig import Rig


class Space(Protocol):
    """A bounded box of n coordinates, each point of which is a pose.

    The tree, the samplers and the post-processing know no more of poses than this.

    Attributes:
        lower: Smallest coordinates, shape (n,).
        upper: Largest coordinates, shape (n,).
    """

    lower: Array
    upper: Array

    def pose(self, coordinates: Array) -> Pose:
        """The pose at coordinates, shape (n,)."""
        ...

    def coordinates(self, pose: Pose) -> Array:
        """The coordinates of a pose, shape (n,)."""
        ...


class PoseSpace:
    """Positions [m] and unit quaternions (w, x, y, z); n = 7.

    The bounds of the quaternion are those of its numbers; the scene's rotation limits are narrower.
    """

    def __init__(self, rig: Rig) -> None:
        """The workspace of ``rig`` with the platform turned in any way."""
        self.lower = np.append(rig.workspace_lower, np.full(4, -1.0))
        self.upper = np.append(rig.workspace_upper, np.full(4, 1.0))

    def pose(self, coordinates: Array) -> Pose:
        """The pose of a position and a quaternion, shape (7,)."""
        return Pose.from_quaternion(coordinates[:3], coordinates[3:])

    def coordinates(self, pose: Pose) -> Array:
        """Position and quaternion of a pose, shape (7,)."""
        return np.append(pose.position, pose.quaternion)


class TranslationSpace:
    """Positions of the platform's origin in the workspace box at one orientation; n = 3, [m]."""

    def __init__(self, rig: Rig, rotation: Array) -> None:
        """The workspace of ``rig`` with the platform turned by ``rotation``, shape (3, 3)."""
        self.lower = rig.workspace_lower
        self.upper = rig.workspace_upper
        self.rotation = rotation

    def pose(self, coordinates: Array) -> Pose:
        """The pose with the platform's origin at ``coordinates``, shape (3,), [m]."""
        return Pose(coordinates, self.rotation)

    def coordinates(self, pose: Pose) -> Array:
        """The position of a pose, shape (3,), [m]."""
        return pose.position
