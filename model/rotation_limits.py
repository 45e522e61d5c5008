"""How far the platform may be tilted and turned, exact along whole moves.

Every orientation is a turn about the vertical followed by a tilt, a rotation about a horizontal
axis. With the unit quaternion (w, x, y, z) the tilt is 2 asin √(x² + y²), the angle of the
platform's z axis from the vertical, and the turn 2 atan(z / w). Along a move at a constant axis the
quaternion goes on a circle: x² + y² is then a constant and a wave of the angle, the largest value
of which is known in closed form, and z / w goes one way only, from end to end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from model.pose import Array, Pose

_AT_LIMIT = 1e-7
"""By how much a limit may be exceeded, [rad]: round-off of quaternions in files."""


@dataclass(frozen=True, slots=True)
class RotationLimits:
    """The orientations that a scene allows, measured from level and not turned, in the world.

    Attributes:
        tilt: Largest angle between the platform's z axis and the vertical, [rad], at most π/2.
        turn: Largest turn about the vertical, either way, [rad]; π for any.
    """

    tilt: float
    turn: float

    def excess(self, start: Pose, end: Pose) -> Excess | None:
        """What a straight move between two poses exceeds; None where it keeps the limits."""
        tilt, turn = largest_rotations(start.quaternion, end.quaternion)
        if not tilt <= self.tilt + _AT_LIMIT:
            return Excess("tilted", tilt, self.tilt)
        if not turn <= self.turn + _AT_LIMIT:
            return Excess("turned", turn, self.turn)
        return None


@dataclass(frozen=True, slots=True)
class Excess:
    """A limit that a move does not keep.

    Attributes:
        how: "tilted" or "turned".
        measured: The largest on the move, [rad].
        limit: That the scene allows, [rad].
    """

    how: str
    measured: float
    limit: float

    def sentence(self) -> str:
        """In words, with figures."""
        measured, limit = math.degrees(self.measured), math.degrees(self.limit)
        return f"{self.how} by {measured:.4g} deg, rotation_limits allow {limit:.4g} deg"


def largest_rotations(start: Array, end: Array) -> tuple[float, float]:
    """The largest tilt and the largest turn on the shorter way between two orientations, [rad].

    Args:
        start: Unit quaternion (w, x, y, z), shape (4,).
        end: Likewise.
    """
    first = start if start[0] >= 0.0 else -start
    last = end if float(first @ end) >= 0.0 else -end
    across = last - (first @ last) * first
    sine = float(np.linalg.norm(across))
    way = 2.0 * math.atan2(sine, float(first @ last))  # of the angle that x² + y² depends on
    squares = [float(q[1] ** 2 + q[2] ** 2) for q in (first, last)]
    if sine > 0.0:
        across = across / sine
        mean = (squares[0] + float(across[1] ** 2 + across[2] ** 2)) / 2.0
        cosine_part, sine_part = squares[0] - mean, float(first[1:3] @ across[1:3])
        if 0.0 <= math.atan2(sine_part, cosine_part) % (2.0 * math.pi) <= way:
            squares.append(mean + math.hypot(cosine_part, sine_part))
    tilt = 2.0 * math.asin(min(math.sqrt(max(squares)), 1.0))
    if last[0] <= 0.0:
        return tilt, math.pi
    return tilt, max(2.0 * math.atan2(abs(float(q[3])), float(q[0])) for q in (first, last))
