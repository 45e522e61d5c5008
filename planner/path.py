"""What a planner finds: a path, its raw path and statistics; and poses joined to one curve."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.pose import Array, Pose, interpolate, rotation_vector_from_matrix
from model.rig import Rig

Progress = Callable[[float, float, float], None]
"""Called by a search: work done, its limit, and the distance to the goal or the cost so far."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A path from start to goal that keeps every limit; coordinates of the space searched.

    Attributes:
        path: The finished path, shape (k, n).
        raw: The path before post-processing, shape (j, n).
        nodes: Of the search tree, shape (i, n); they include the ends of both paths.
        parents: Of each node, -1 for the root, shape (i,).
        iterations: Number of samples drawn, or of rounds, which reproduce the route.
        edge_checks: Number of edges checked, post-processing included.
        search_time: Of the rounds, [s]; None for the paper's planners.
    """

    path: Array
    raw: Array
    nodes: Array
    parents: NDArray[np.int64]
    iterations: int
    edge_checks: int
    search_time: float | None = None

    @classmethod
    def from_rounds(
        cls, path: Array, first: Array, rounds: int, checks: int, search_time: float
    ) -> Route:
        """The result of a search in rounds; its tree is the first path that it found.

        Args:
            path: Shape (k, n).
            first: Shape (j, n).
            rounds: Number of rounds done.
            checks: Number of edges checked.
            search_time: [s].
        """
        parents = np.arange(-1, len(first) - 1, dtype=np.int64)
        return cls(path, first, first, parents, rounds, checks, search_time)


# A sequence of poses as one curve, parametrised by a bound on the motion of any platform point.


class PosePath:
    """Straight moves from pose to pose.

    Its parameter is the motion: the distance travelled by the platform's origin plus, where it
    rotates, the angle times the radius of its farthest point. No point of the platform, and no
    point of a cable (which moves no faster than its faster end), moves farther than the motion
    between two positions on the path.

    Attributes:
        poses: The poses, at least one.
        marks: The motion from the first to each pose, shape (k,), [m].
        length: Distance travelled by the platform's origin, [m].
        angles: Of the rotation in each move, shape (k - 1,), [rad].
        turns: Whether the orientation changes.
    """

    def __init__(self, rig: Rig, poses: Sequence[Pose]) -> None:
        """Measures the moves.

        Raises:
            BadInput: There are no poses.
        """
        if not poses:
            raise BadInput("a path without poses cannot be checked")
        self.poses = tuple(poses)
        self.radius = rig.reach
        self._positions = np.array([pose.position for pose in self.poses])
        self._lengths = np.linalg.norm(np.diff(self._positions, axis=0), axis=1)
        rotations = np.array([pose.rotation for pose in self.poses])
        moved = np.any(rotations[1:] != rotations[:-1], axis=(1, 2))
        self.angles = np.zeros(len(self._lengths))
        for k in np.flatnonzero(moved).tolist():
            self.angles[k] = self.poses[k].angle_to(self.poses[k + 1])
        self.turns = bool(self.angles.any())
        self.length = float(self._lengths.sum())
        self.marks = self._sums(1.0, self.radius)

    def _sums(self, per_metre: float, per_radian: float | Array) -> Array:
        steps = per_metre * self._lengths + per_radian * self.angles
        sums: Array = np.append(0.0, np.cumsum(steps))
        return sums

    def largest_change(
        self, per_metre: float, per_radian: float | Array
    ) -> Callable[[Array], Array]:
        """The largest change of a value from the start to positions along the path.

        Args:
            per_metre: Largest change per metre that the origin travels.
            per_radian: Largest change per radian of rotation, of each move or of all, shape
                (k - 1,) or ().

        Returns:
            A function of positions, [m] of motion, shape (n,) → (n,).
        """
        sums = self._sums(per_metre, per_radian)
        return lambda positions: np.interp(positions, self.marks, sums)

    def samples(self, spacing: float) -> Array:
        """Positions at most ``spacing`` apart, with both ends and every corner of a coarse path.

        Of poses nearer to each other than half the spacing some are left out: the motion between
        two samples bounds them too.
        """
        kept = [0.0]
        for mark in self.marks[1:].tolist():
            if mark - kept[-1] >= spacing / 2.0:
                count = int(np.ceil((mark - kept[-1]) / spacing))
                kept += np.linspace(kept[-1], mark, count + 1)[1:].tolist()
        if kept[-1] < self.marks[-1]:
            kept.append(float(self.marks[-1]))
        return np.array(kept)

    def pose(self, position: float) -> Pose:
        """The pose at a position along the path, [m] of motion."""
        k = int(np.searchsorted(self.marks, position, side="right")) - 1
        if k >= len(self.poses) - 1:
            return self.poses[-1]
        start, end = self.poses[k], self.poses[k + 1]
        share = (position - self.marks[k]) / (self.marks[k + 1] - self.marks[k])
        return interpolate(start, end, float(share))

    def positions(self, low: float, high: float) -> Array:
        """Platform positions whose hull contains the path from ``low`` to ``high``, (k, 3), [m]."""
        inner = slice(*np.searchsorted(self.marks, (low, high), side="right"))
        ends = self.pose(low).position, self.pose(high).position
        return np.vstack([ends[0], self._positions[inner], ends[1]])

    def twists(self, positions: Array, turn_radius: float) -> Array:
        """Twists per unit of executed path, shape (k, 6); zero at rest.

        Args:
            positions: Along the path, shape (k,), [m] of motion.
            turn_radius: Metres of executed path for a radian of rotation.

        Returns:
            Velocity of the origin [-] and angular velocity [rad/m], world axes.
        """
        if len(self.poses) == 1:
            return np.zeros((len(positions), 6))
        found = np.searchsorted(self.marks, positions, side="right") - 1
        k = np.clip(found, 0, len(self.poses) - 2)
        moves = np.array([self._move(int(i), turn_radius) for i in np.unique(k)])
        return np.asarray(moves[np.searchsorted(np.unique(k), k)])

    def _move(self, k: int, turn_radius: float) -> Array:
        """The twist of the straight move from pose k to the next, per unit of executed path."""
        start, end = self.poses[k], self.poses[k + 1]
        turn = start.rotation @ rotation_vector_from_matrix(start.rotation.T @ end.rotation)
        twist = np.concatenate([end.position - start.position, turn])
        length = float(np.hypot(np.linalg.norm(twist[:3]), turn_radius * np.linalg.norm(turn)))
        per_metre: Array = twist / length if length > 0.0 else np.zeros(6)
        return per_metre
