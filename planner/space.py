"""The space that is searched: which numbers stand for a pose, and their bounds."""

from __future__ import annotations

from typing import Protocol

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
