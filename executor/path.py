"""The geometric path: straight segments and rounded corners, by travelled length.

Every segment is a Bézier curve in the chart of one rotation R₀: a point (p, r) of R⁶ stands for the
pose (p, R₀ exp[r]). Straight moves with a constant axis of rotation are straight lines there, so a
corner's curve meets its two neighbours with the same direction and with zero curvature.

Length is measured as √(|dp|² + (ρ |dr|)²) with ρ the RMS distance of the anchors from the platform's
origin, so that the speed along the path bounds translation and rotation together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cdpr.poses import (
    Array,
    Pose,
    matrix_from_rotation_vector,
    rotation_vector_from_matrix,
)

CORNER_SAMPLES = 257
#: Binomials of a quintic, and of its first and second derivative.
_QUINTIC = np.array([1.0, 5.0, 10.0, 10.0, 5.0, 1.0])


@dataclass(frozen=True, eq=False)
class Segment:
    """One curve of the path.

    Attributes:
        chart: Rotation R₀, shape (3, 3).
        control: Control points (position [m], rotation vector [rad]), shape (2 or 6, 6).
        weight: ρ, metres of path for a radian of rotation.
    """

    chart: Array
    control: Array
    weight: float

    @cached_property
    def _metric(self) -> Array:
        return np.array([1.0, 1.0, 1.0, self.weight, self.weight, self.weight])

    @property
    def straight(self) -> bool:
        """True for a line, False for a rounded corner."""
        return len(self.control) == 2

    @cached_property
    def _travelled(self) -> Array:
        """Length from the start at even parameters, shape (CORNER_SAMPLES,), [m]."""
        points = self._points(np.linspace(0.0, 1.0, CORNER_SAMPLES))
        steps = np.linalg.norm(np.diff(points * self._metric, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def length(self) -> float:
        """[m]."""
        if self.straight:
            return float(np.linalg.norm((self.control[1] - self.control[0]) * self._metric))
        return float(self._travelled[-1])

    @cached_property
    def curvature(self) -> float:
        """Largest curvature of the origin's track, [1/m]."""
        if self.straight:
            return 0.0
        parameters = np.linspace(0.0, 1.0, CORNER_SAMPLES)
        points = self._points(parameters)[:, :3]
        first = np.gradient(points, parameters, axis=0)
        second = np.gradient(first, parameters, axis=0)
        speed = np.linalg.norm(first, axis=1)
        cross = np.linalg.norm(np.cross(first, second), axis=1)
        moving = speed > 1e-12
        if not moving.any():
            return 0.0
        return float(np.max(cross[moving] / speed[moving] ** 3))

    def _points(self, parameters: Array) -> Array:
        t = parameters[:, None]
        if self.straight:
            return (1.0 - t) * self.control[0] + t * self.control[1]
        powers = np.arange(6)
        points: Array = (_QUINTIC * t**powers * (1.0 - t) ** (5 - powers)) @ self.control
        return points

    def at(self, travelled: Array) -> tuple[Array, Array]:
        """Positions, shape (n, 3), [m], and rotations, shape (n, 3, 3), after given lengths [m]."""
        if self.length == 0.0:
            parameters = np.zeros_like(travelled)
        elif self.straight:
            parameters = travelled / self.length
        else:
            even = np.linspace(0.0, 1.0, CORNER_SAMPLES)
            parameters = np.interp(travelled, self._travelled, even)
        points = self._points(parameters)
        return points[:, :3], _rotations(self.chart, points[:, 3:])


def _rotations(chart: Array, vectors: Array) -> Array:
    if not vectors.any():
        return np.broadcast_to(chart, (len(vectors), 3, 3))
    return np.array([chart @ matrix_from_rotation_vector(v) for v in vectors])


@dataclass(frozen=True, eq=False)
class Path:
    """Segments end to end."""

    segments: tuple[Segment, ...]

    @cached_property
    def starts(self) -> Array:
        """Travelled length at the start of each segment and at the end, shape (n + 1,), [m]."""
        return np.concatenate([[0.0], np.cumsum([s.length for s in self.segments])])

    @property
    def length(self) -> float:
        """[m]."""
        return float(self.starts[-1])

    def at(self, travelled: Array) -> tuple[Array, Array]:
        """Positions, shape (n, 3), [m], and rotations, shape (n, 3, 3), after given lengths [m]."""
        travelled = np.clip(np.asarray(travelled, dtype=np.float64), 0.0, self.length)
        which = np.clip(np.searchsorted(self.starts, travelled, "right") - 1, 0, None)
        which = np.minimum(which, len(self.segments) - 1)
        positions = np.empty((len(travelled), 3))
        rotations = np.empty((len(travelled), 3, 3))
        for index in np.unique(which):
            chosen = which == index
            inside = travelled[chosen] - self.starts[index]
            positions[chosen], rotations[chosen] = self.segments[index].at(inside)
        return positions, rotations


def line(start: Pose, end: Pose, weight: float) -> Segment:
    """The straight move between two poses."""
    turn = rotation_vector_from_matrix(start.rotation.T @ end.rotation)
    control = np.array([[*start.position, 0.0, 0.0, 0.0], [*end.position, *turn]])
    return Segment(start.rotation, control, weight)


def corner(before: Pose, at: Pose, after: Pose, weight: float) -> Segment:
    """The rounded corner from ``before`` to ``after``, points of the two lines that meet at ``at``.

    It leaves the corner by 3/16 of the distance from the corner to the middle of its two ends,
    doubled: see `corner_deviation`.
    """
    ends = [_in_chart(at, before), _in_chart(at, after)]
    corner_point = np.array([*at.position, 0.0, 0.0, 0.0])
    legs = [end - corner_point for end in ends]
    shares = [1.0, 0.6, 0.2]
    control = [corner_point + share * legs[0] for share in shares]
    control += [corner_point + share * legs[1] for share in reversed(shares)]
    return Segment(at.rotation, np.array(control), weight)


def corner_deviation(before: Pose, at: Pose, after: Pose) -> float:
    """How far the middle of `corner` is from the corner point, [m]: (1 + 5·0.6 + 10·0.2)/32."""
    legs = (before.position - at.position) + (after.position - at.position)
    return float(np.linalg.norm(legs)) * 6.0 / 32.0


def _in_chart(origin: Pose, pose: Pose) -> Array:
    turn = rotation_vector_from_matrix(origin.rotation.T @ pose.rotation)
    return np.array([*pose.position, *turn])


def poses_of(positions: Array, rotations: Array) -> list[Pose]:
    """The rows of `Path.at` as poses."""
    return [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]


def polyline(waypoints: Sequence[Pose], weight: float) -> Path:
    """The path with sharp corners."""
    pairs = zip(waypoints[:-1], waypoints[1:], strict=True)
    return Path(tuple(line(a, b, weight) for a, b in pairs))
