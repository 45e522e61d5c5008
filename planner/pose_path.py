"""A sequence of poses as one curve, measured by how far anything on the platform can have moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.errors import BadInput
from model.pose import Array, Pose, interpolate, rotation_vector_from_matrix
from model.rig import Rig


class PosePath:
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

    def positions(self, low: float, high: float) -> Array:
        """Positions whose hull holds the track between two places, shape (k, 3), [m]."""
        inner = slice(*np.searchsorted(self.marks, (low, high), side="right"))
        ends = self.pose(low).position, self.pose(high).position
        return np.vstack([ends[0], self._positions[inner], ends[1]])

    def twists(self, places: Array, turn_radius: float) -> Array:
        """Motion at places per unit of path as it is executed, shape (k, 6); zero at rest.

        Args:
            places: Shape (k,), [m].
            turn_radius: Metres of executed path for a radian of turning.

        Returns:
            Velocity of the origin [-] and angular velocity [rad/m], world axes.
        """
        if len(self.poses) == 1:
            return np.zeros((len(places), 6))
        k = np.clip(np.searchsorted(self.marks, places, side="right") - 1, 0, len(self.poses) - 2)
        moves = np.array([self._move(int(i), turn_radius) for i in np.unique(k)])
        return np.asarray(moves[np.searchsorted(np.unique(k), k)])

    def _move(self, k: int, turn_radius: float) -> Array:
        """The twist of the straight move from pose k to the next, per unit of executed path."""
        start, end = self.poses[k], self.poses[k + 1]
        turn = start.rotation @ rotation_vector_from_matrix(start.rotation.T @ end.rotation)
        twist = np.concatenate([end.position - start.position, turn])
        way = float(np.hypot(np.linalg.norm(twist[:3]), turn_radius * np.linalg.norm(turn)))
        moved: Array = twist / way if way > 0.0 else np.zeros(6)
        return moved
