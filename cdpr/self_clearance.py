"""How far cables are from each other and from the platform, for one pose or many at once.

At its anchor a cable touches the platform, so the platform is compared with the part of each cable
farther than a stub from its anchor. The stub is geometry alone: a quarter of the platform's
shortest side; a clearance c then means that the cable leaves the platform at an angle of at least
arcsin(c / stub). Two cables whose anchors (or outlets) are nearer to each other than a stub are
compared without a stub at that end, for the same reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from cdpr.cables import Cables
from cdpr.poses import Array
from cdpr.rig import Rig
from cdpr.segments import segment_box_points, segment_pair_points

_STUB_SHARE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Distances between surfaces of bodies that belong to the robot.

    Attributes:
        distances: Shape (..., k), [m]; negative where they overlap.
        first_points: On the first body, world frame, shape (..., k, 3), [m].
        second_points: On the second body, likewise.
    """

    distances: Array
    first_points: Array
    second_points: Array


class SelfModel:
    """What is compared with what on one rig.

    Attributes:
        pairs: The cables of each compared pair, counted from 0, shape (p, 2).
        stub: Length of cable at its anchor that may be near the platform, [m].
    """

    def __init__(self, rig: Rig) -> None:
        """Finds the pairs of cables and the ends that they share."""
        self.rig = rig
        self.stub = _STUB_SHARE * 2.0 * float(np.min(rig.half_size))
        pairs = np.array(list(combinations(range(rig.cable_count), 2)), dtype=np.int64)
        self.pairs: NDArray[np.int64] = pairs.reshape(-1, 2)
        self._at_anchor = self._stubs_where_near(rig.anchors)
        self._at_exit = self._stubs_where_near(rig.outlets)

    def cable_pairs(self, cables: Cables) -> Gaps:
        """Cable to cable, for `pairs`; ``cables`` of one pose or a batch."""
        radius = self.rig.cable_radius
        a, b = (self._parts(cables, self.pairs[:, side]) for side in (0, 1))
        on_a, on_b = segment_pair_points(*a, *b)
        distances = np.linalg.norm(on_a - on_b, axis=-1) - 2.0 * radius
        return Gaps(distances, on_a, on_b)

    def to_platform(self, cables: Cables, positions: Array, rotations: Array) -> Gaps:
        """Each cable beyond its stub to the platform.

        Args:
            cables: Of one pose or a batch.
            positions: Of the platform, shape (..., 3), [m].
            rotations: ``world_from_platform``, shape (..., 3, 3) or (3, 3).
        """
        half, radius = self.rig.half_size, self.rig.cable_radius
        start = cables.anchors + self.stub * cables.directions
        origin = positions[..., None, :]
        on_cable, in_box = segment_box_points(
            (start - origin) @ rotations, (cables.exits - origin) @ rotations, half
        )
        apart = np.linalg.norm(on_cable - in_box, axis=-1)
        inside = np.minimum(np.max(np.abs(on_cable) - half, axis=-1), 0.0)
        distances = np.where(apart > 0.0, apart, inside) - radius
        turned = np.swapaxes(rotations, -1, -2)
        return Gaps(distances, on_cable @ turned + origin, in_box @ turned + origin)

    def _stubs_where_near(self, ends: Array) -> Array:
        """The length to leave out at an end of both cables of each pair, shape (p, 1), [m]."""
        apart = np.linalg.norm(ends[self.pairs[:, 0]] - ends[self.pairs[:, 1]], axis=-1)
        return np.where(apart < self.stub, self.stub, 0.0)[:, None]

    def _parts(self, cables: Cables, chosen: NDArray[np.int64]) -> tuple[Array, Array]:
        along = cables.directions[..., chosen, :]
        start = cables.anchors[..., chosen, :] + self._at_anchor * along
        end = cables.exits[..., chosen, :] - self._at_exit * along
        return start, end
