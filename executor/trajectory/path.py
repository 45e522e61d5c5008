"""The geometric path: straight segments and rounded corners, by travelled length.

Every segment is a Bézier curve in the chart of one rotation R₀: a point (p, r) of R⁶ is the
pose (p, R₀ exp[r]). Straight moves with a constant axis of rotation are straight lines there, so a
corner's curve meets its two neighbours with the same direction and with zero curvature.

Length is measured as √(|dp|² + (ρ |dr|)²) with ρ the RMS distance of the anchors from the
platform's origin, so that the speed along the path bounds translation and rotation together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from model.pose import (
    Array,
    Pose,
    interpolate,
    matrix_from_rotation_vector,
    rotation_vector_from_matrix,
)

CORNER_SAMPLES = 257
#: Control points of a corner along its two legs, as shares of the leg.
_SHARES = (1.0, 0.6, 0.2)
#: Distance from a corner point to the middle of its curve, as a share of the sum of its legs:
#: (1·1 + 5·0.6 + 10·0.2)/32, the legs' weights at the middle of a quintic.
MIDDLE_SHARE = 6.0 / 32.0


@dataclass(frozen=True, eq=False)
class Segment:
    """One curve of the path.

    Attributes:
        chart: Rotation R₀, shape (3, 3).
        control: Control points (position [m], rotation vector [rad]), shape (2 or 6, 6).
        weight: ρ, metres of path per radian of rotation.
    """

    chart: Array
    control: Array
    weight: float

    @property
    def straight(self) -> bool:
        """Whether it is a line, not a rounded corner."""
        return len(self.control) == 2

    @cached_property
    def _metric(self) -> Array:
        return metric(self.weight)

    @cached_property
    def _even(self) -> Array:
        return np.linspace(0.0, 1.0, CORNER_SAMPLES)

    @cached_property
    def _speeds(self) -> Array:
        """Length per unit of the parameter at even parameters, shape (CORNER_SAMPLES,), [m]."""
        speeds: Array = np.linalg.norm(self._derivative(1, self._even), axis=1)
        return speeds

    @cached_property
    def _travelled(self) -> Array:
        """Length from the start at even parameters (Simpson), shape (CORNER_SAMPLES,), [m]."""
        between = (self._even[:-1] + self._even[1:]) / 2.0
        middle = np.linalg.norm(self._derivative(1, between), axis=1)
        steps = (self._speeds[:-1] + 4.0 * middle + self._speeds[1:]) / 6.0 / (CORNER_SAMPLES - 1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def length(self) -> float:
        """[m]."""
        if self.straight:
            return float(np.linalg.norm((self.control[1] - self.control[0]) * self._metric))
        return float(self._travelled[-1])

    @cached_property
    def bends(self) -> tuple[float, float]:
        """Largest second and third derivative of the curve by its length, [1/m] and [1/m²].

        At a path speed v they cause an acceleration of v² times the first and a jerk of v³ times
        the second, translation and rotation together.
        """
        if self.straight:
            return 0.0, 0.0
        first, second, third = (self._derivative(order, self._even) for order in (1, 2, 3))
        speed = self._speeds[:, None]
        along = _dot(first, second) / speed
        along_change = (_dot(second, second) + _dot(first, third) - along**2) / speed
        by_length = (second - first / speed * along) / speed**2
        change = (third - 3.0 * by_length * speed * along - first / speed * along_change) / speed**3
        norms = (np.linalg.norm(values, axis=1).max() for values in (by_length, change))
        curvature, curvature_change = map(float, norms)
        return curvature, curvature_change

    def _derivative(self, order: int, parameters: Array) -> Array:
        """Derivative of the curve by its parameter, rotation in metres, shape (n, 6), [m]."""
        control = self.control * self._metric
        for _ in range(order):
            control = (len(control) - 1) * np.diff(control, axis=0)
        return _bezier(control, parameters)

    def _parameters(self, travelled: Array) -> Array:
        """Curve parameters at given lengths: cubic between even parameters, exact slopes."""
        if self.length == 0.0:
            return np.zeros_like(travelled)
        if self.straight:
            return travelled / self.length
        ends = np.searchsorted(self._travelled, travelled, "right")
        right = np.clip(ends, 1, CORNER_SAMPLES - 1)
        left = right - 1
        step = self._travelled[right] - self._travelled[left]
        x = (travelled - self._travelled[left]) / step
        slopes = step / self._speeds[left], step / self._speeds[right]
        rise = self._even[right] - self._even[left]
        cubic = x * x * (3.0 - 2.0 * x) * rise
        cubic += x * (1.0 - x) ** 2 * slopes[0] - x * x * (1.0 - x) * slopes[1]
        return self._even[left] + cubic

    def at(self, travelled: Array) -> tuple[Array, Array]:
        """Positions, shape (n, 3), [m], and rotations, shape (n, 3, 3), after given lengths [m]."""
        points = _bezier(self.control, self._parameters(travelled))
        return points[:, :3], _rotations(self.chart, points[:, 3:])


def metric(weight: float) -> Array:
    """Metres of path per unit of each coordinate (position, rotation vector), shape (6,)."""
    return np.array([1.0, 1.0, 1.0, weight, weight, weight])


def _bezier(control: Array, parameters: Array) -> Array:
    degree = len(control) - 1
    powers = np.arange(degree + 1)
    binomials = np.array([math.comb(degree, k) for k in powers], dtype=np.float64)
    t = parameters[:, None]
    points: Array = (binomials * t**powers * (1.0 - t) ** (degree - powers)) @ control
    return points


def _dot(a: Array, b: Array) -> Array:
    """Row by row, shape (n, 1)."""
    product: Array = np.sum(a * b, axis=1, keepdims=True)
    return product


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
    return Segment(
        start.rotation, np.array([_in_chart(start, start), _in_chart(start, end)]), weight
    )


def corner(before: Pose, at: Pose, after: Pose, weight: float) -> Segment:
    """The rounded corner from ``before`` to ``after``, points on two lines that meet at ``at``.

    Its middle is at a distance of `MIDDLE_SHARE` times the sum of the two legs from the corner
    point; with legs of equal length no point of it is farther from the two lines.

    Raises:
        ValueError: The path reverses, so that no smooth curve follows it.
    """
    corner_point = _in_chart(at, at)
    legs = [_in_chart(at, end) - corner_point for end in (before, after)]
    apart, *sizes = np.linalg.norm([legs[0] - legs[1], *legs] * metric(weight), axis=1)
    if apart <= 1e-6 * sum(sizes):
        raise ValueError("a corner at which the path reverses cannot be rounded")
    control = [corner_point + share * legs[0] for share in _SHARES]
    control += [corner_point + share * legs[1] for share in reversed(_SHARES)]
    return Segment(at.rotation, np.array(control), weight)


def direction(at: Pose, towards: Pose, weight: float) -> Array:
    """Unit vector of the straight move from a pose to another, in the chart of the first.

    Returns:
        (Position, rotation vector) in metres of path, shape (6,).
    """
    leg = (_in_chart(at, towards) - _in_chart(at, at)) * metric(weight)
    unit: Array = leg / np.linalg.norm(leg)
    return unit


def _in_chart(origin: Pose, pose: Pose) -> Array:
    turn = rotation_vector_from_matrix(origin.rotation.T @ pose.rotation)
    return np.array([*pose.position, *turn])


def poses_of(positions: Array, rotations: Array) -> list[Pose]:
    """The rows of `Path.at` as poses."""
    return [Pose(p, r) for p, r in zip(positions, rotations, strict=True)]


# Rounding of a plan's corners, as far as tolerance and clearance allow.


#: A corner uses at most this share of each adjacent line, so that corners never meet.
LONGEST_SHARE = 0.45
#: Halvings of a too tight corner before the path stops at it instead.
HALVINGS = 5
#: A turn of more than 105° is not rounded: its curve is so tight that a stop takes less time
#: (measured for both example rigs), and a reversal has no smooth curve.
SHARPEST_TURN = float(np.radians(105.0))
#: Waypoints that change the path by less are dropped, [m] and [rad].
SAME = 1e-9

IsAllowed = Callable[[Sequence[Pose]], bool]


def rounded(
    waypoints: Sequence[Pose], tolerance: float, weight: float, is_allowed: IsAllowed
) -> Path:
    """The path through waypoints with rounded corners.

    Rounding cuts a corner on its inner side, where an obstacle usually is. Each corner is therefore
    checked; one that is too tight is rounded less, or else the path stops at the corner itself.

    Args:
        waypoints: At least two poses, ``world_from_platform``.
        tolerance: Largest distance of a rounded corner from the sharp one, rotation counted as
            ``weight`` metres per radian, [m]; 0 keeps all sharp.
        weight: Metres of path per radian of rotation.
        is_allowed: Returns whether dense poses all keep the scene's clearances.
    """
    points = _needed(waypoints, weight)
    segments: list[Segment] = []
    begin = points[0]
    for before, at, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        turn = _largest_allowed((before, at, after), tolerance, weight, is_allowed)
        if turn is None:
            segments.append(line(begin, at, weight))
            begin = at
            continue
        start, end, segment = turn
        segments += [line(begin, start, weight), segment]
        begin = end
    segments.append(line(begin, points[-1], weight))
    return Path(tuple(segments))


def _needed(waypoints: Sequence[Pose], weight: float) -> list[Pose]:
    """Waypoints without repeats and without those on the line between their neighbours."""
    kept = [waypoints[0]]
    for pose in waypoints[1:]:
        if _same(pose, kept[-1]):
            continue
        if len(kept) > 1 and _is_between(kept[-2], kept[-1], pose, weight):
            kept.pop()
        kept.append(pose)
    return kept if len(kept) > 1 else [waypoints[0], waypoints[-1]]


def _same(a: Pose, b: Pose) -> bool:
    return a.distance_to(b) <= SAME and a.angle_to(b) <= SAME


def _is_between(before: Pose, at: Pose, after: Pose, weight: float) -> bool:
    """Whether the straight move from the first to the last passes through the second."""
    legs = [line(before, at, weight).length, line(at, after, weight).length]
    return _same(interpolate(before, after, legs[0] / sum(legs)), at)


def _largest_allowed(
    turn: tuple[Pose, Pose, Pose], tolerance: float, weight: float, is_allowed: IsAllowed
) -> tuple[Pose, Pose, Segment] | None:
    before, at, after = turn
    lengths = [line(before, at, weight).length, line(at, after, weight).length]
    # Both moves in the direction of travel: a half turn is ambiguous in reverse.
    legs = [
        direction(at, interpolate(before, at, 0.5), weight),
        direction(at, interpolate(at, after, 0.5), weight),
    ]
    if -legs[0] @ legs[1] < np.cos(SHARPEST_TURN):
        return None
    deviation = MIDDLE_SHARE * float(np.linalg.norm(legs[0] + legs[1]))  # for a metre of leg
    reach = min(LONGEST_SHARE * min(lengths), tolerance / max(deviation, 1e-12))
    for _ in range(HALVINGS):
        if reach <= 0.0:
            return None
        start = interpolate(before, at, 1.0 - reach / lengths[0])
        end = interpolate(at, after, reach / lengths[1])
        segment = corner(start, at, end, weight)
        steps = max(9, int(np.ceil(segment.length / 0.001)))
        samples = poses_of(*segment.at(np.linspace(0.0, segment.length, steps)))
        if is_allowed(samples):
            return start, end, segment
        reach /= 2.0
    return None
