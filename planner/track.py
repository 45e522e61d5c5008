"""A sequence of poses as one curve, measured by how far anything on the platform can have moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cdpr.errors import BadInput
from cdpr.poses import Array, Pose, interpolate
from cdpr.rig import Rig


class Track:
    """Straight moves from pose to pose.

    Its measure is motion: the way of the platform's origin and, where it turns, the angle times the
    radius of its farthest point. No point of the platform, and no point of a cable (which moves no
    faster than its faster end), moves farther than the motion between two places of the track.

    Attributes:
        poses: The poses, at least one.
        marks: The motion from the first to each pose, shape (k,), [m].
        length: The way of the platform's origin, [m].
        turns: Whether the orientation changes.
    """

    def __init__(self, rig: Rig, poses: Sequence[Pose]) -> None:
        """Measures the moves.

        Raises:
            BadInput: There is no pose.
        """
        if not poses:
            raise BadInput("a path without poses cannot be checked")
        self.poses = tuple(poses)
        self.radius = max(
            float(np.linalg.norm(rig.half_size)),
            float(np.linalg.norm(rig.anchors, axis=1).max()),
        )
        self._positions = np.array([pose.position for pose in self.poses])
        ways = np.linalg.norm(np.diff(self._positions, axis=0), axis=1)
        rotations = np.array([pose.rotation for pose in self.poses])
        moved = np.any(rotations[1:] != rotations[:-1], axis=(1, 2))
        angles = np.zeros(len(ways))
        for k in np.flatnonzero(moved).tolist():
            angles[k] = self.poses[k].angle_to(self.poses[k + 1])
        self.turns = bool(angles.any())
        self.length = float(ways.sum())
        self.marks: Array = np.append(0.0, np.cumsum(ways + self.radius * angles))

    def places(self, spacing: float) -> Array:
        """Places at most ``spacing`` apart, both ends and every corner of a coarse path included.

        Poses nearer to each other than half the spacing are not all places: where they lie on the
        curve between two places is part of what the motion bounds.
        """
        kept = [0.0]
        for mark in self.marks[1:].tolist():
            if mark - kept[-1] >= spacing / 2.0:
                count = int(np.ceil((mark - kept[-1]) / spacing))
                kept += np.linspace(kept[-1], mark, count + 1)[1:].tolist()
        if kept[-1] < self.marks[-1]:
            kept.append(float(self.marks[-1]))
        return np.array(kept)

    def pose(self, place: float) -> Pose:
        """The pose at a place."""
        k = int(np.searchsorted(self.marks, place, side="right")) - 1
        if k >= len(self.poses) - 1:
            return self.poses[-1]
        start, end = self.poses[k], self.poses[k + 1]
        share = (place - self.marks[k]) / (self.marks[k + 1] - self.marks[k])
        return interpolate(start, end, float(share))

    def directions(self, places: Array) -> Array:
        """Unit vectors of the origin's motion at places, shape (k, 3); zero where it stands."""
        if len(self.poses) == 1:
            return np.zeros((len(places), 3))
        k = np.clip(np.searchsorted(self.marks, places, side="right") - 1, 0, len(self.poses) - 2)
        ways = self._positions[k + 1] - self._positions[k]
        lengths = np.linalg.norm(ways, axis=1, keepdims=True)
        directions: Array = ways / np.where(lengths > 0.0, lengths, 1.0)
        return directions
