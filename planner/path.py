"""What a planner hands over: a path, the path it was made from, and how it was found."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.pose import Array, Pose, interpolate, rotation_vector_from_matrix
from model.rig import Rig

Progress = Callable[[float, float, float], None]
"""Reported by a search: work done, its limit, and how close or how good it is so far."""


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A path from start to goal that keeps every limit; coordinates of the space searched.

    Attributes:
        path: The finished path, shape (k, n).
        raw: The path before post-processing, shape (j, n).
        nodes: Of the search tree, shape (i, n); both paths' ends are among them.
        parents: Of each node, -1 for the root, shape (i,).
        iterations: How many samples were drawn.
        edge_checks: How many edges were asked about, post-processing included.
    """

    path: Array
    raw: Array
    nodes: Array
    parents: NDArray[np.int64]
    iterations: int
    edge_checks: int


# The best path that is no longer than asked: a price λ of length is raised until it holds.
#
# With the objective plus λ times the length, a higher λ gives a shorter path. After every few
# rounds λ is moved by halving towards the least that keeps the limit; the best path that did is
# kept.


LEAST_ROUNDS_WITH_LIMIT = 80
"""Done whatever the clock says: the price is found in steps of some rounds."""
_ROUNDS = 6
"""Between changes of λ."""
_MOST = 64.0
"""λ with which the length is practically all that counts, in units of the objective."""


class LengthLimit:
    """The search for λ, updated after every round.

    Attributes:
        price: λ, what a metre costs beside the objective.
        path: The best path found that is short enough, shape (k, n); None without one.
    """

    def __init__(self, longest: float, unit: float) -> None:
        """Begins without a price of length.

        Args:
            longest: Longest path allowed, [m].
            unit: What a metre of a usual path costs by the objective.
        """
        self.price = 0.0
        self.path: Array | None = None
        self._longest, self._unit = longest, unit
        self._low, self._high = 0.0, math.inf
        self._rounds = 0
        self._least = math.inf

    def after_round(self, path: Array, length: float, cost: Callable[[], float]) -> bool:
        """Looks at the best path at this price, and changes the price when it is time to.

        Args:
            path: Of the round before, shape (k, n).
            length: Its length, [m].
            cost: Computes its cost by the objective alone.

        Returns:
            Whether the price is another now.
        """
        short_enough = length <= self._longest
        if short_enough:
            self._keep(path, cost())
        self._rounds += 1
        return self._rounds % _ROUNDS == 0 and self._moved(short_enough)

    def _keep(self, path: Array, cost: float) -> None:
        if cost < self._least:
            self._least, self.path = cost, path

    def _moved(self, short_enough: bool) -> bool:
        if short_enough:
            self._high = self.price
        else:
            self._low = self.price
        if self._high == 0.0:
            return False  # the objective alone keeps the limit
        if self._high == math.inf:
            self.price = min(max(4.0 * self.price, 0.25 * self._unit), _MOST)
        else:
            self.price = (self._low + self._high) / 2.0
        return True


# A sequence of poses as one curve, measured by how far anything on the platform can have moved.


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
