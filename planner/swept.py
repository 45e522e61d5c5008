"""What the robot sweeps along an edge, as convex hulls with a bound for what they leave out.

Under pure translation a cable with a point exit sweeps exactly the triangle of its exit and its
anchor before and after, and the platform the hull of its corners before and after. With pulleys the
exits move, and with rotation anchors and corners move on arcs; then the hull of the ends is grown
by a bound on how far a point leaves its chord, so that it still holds all that is swept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.cables import cables_at
from cdpr.poses import Array, Pose
from cdpr.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Swept:
    """Hulls that hold all that cables and platform pass through along an edge.

    Attributes:
        cables: Hull points of each cable, shape (m, 3 or 4, 3), [m].
        platform: Hull points of the platform, shape (16, 3), [m].
        growth: What each hull must be grown by, cables and then platform, shape (m + 1,), [m];
            zero where a hull is exact. Cable radii are not in it.
    """

    cables: Array
    platform: Array
    growth: Array

    def reach(self, directions: Array) -> Array:
        """Largest reach of each hull, not grown; shape (..., m + 1, 3) → (..., m + 1), [m]."""
        cables = np.einsum("...mi,mki->...mk", directions[..., :-1, :], self.cables).max(axis=-1)
        platform = (directions[..., -1, :] @ self.platform.T).max(axis=-1)
        return np.concatenate([cables, platform[..., None]], axis=-1)

    def points(self, body: int) -> Array:
        """Hull points of a body: a cable, or for m the platform."""
        return self.platform if body == len(self.cables) else self.cables[body]


def swept(rig: Rig, start: Pose, end: Pose) -> Swept:
    """What is swept when ``start`` moves to ``end`` as `cdpr.poses.interpolate` does."""
    before, after = cables_at(rig, start), cables_at(rig, end)
    platform = np.concatenate([start.apply(rig.platform_corners), end.apply(rig.platform_corners)])
    exits = (before.exits,) if rig.pulley_radius == 0.0 else (before.exits, after.exits)
    cables = np.stack([*exits, before.anchors, after.anchors], axis=1)
    growth = np.zeros(rig.cable_count + 1)
    angle = start.angle_to(end) if not np.array_equal(start.rotation, end.rotation) else 0.0
    if angle:
        # A point at radius b turning by an angle leaves its chord by at most b (1 - cos(angle/2)).
        away = 1.0 - np.cos(angle / 2.0)
        growth[:-1] = np.linalg.norm(rig.anchors, axis=1) * away
        growth[-1] = float(np.linalg.norm(rig.half_size)) * away
    if rig.pulley_radius:
        # A point no faster than v leaves the chord of its unit of time by at most v / 2.
        growth[:-1] = np.maximum(growth[:-1], exit_motion(rig, start, end) / 2.0)
    return Swept(cables, platform, growth)


def anchor_motion(rig: Rig, start: Pose, end: Pose) -> Array:
    """A bound of how far each anchor travels along an edge, shape (m,), [m]."""
    travel = np.full(rig.cable_count, start.distance_to(end))
    if np.array_equal(start.rotation, end.rotation):
        return travel
    bound: Array = travel + start.angle_to(end) * np.linalg.norm(rig.anchors, axis=1)
    return bound


def exit_motion(rig: Rig, start: Pose, end: Pose) -> Array:
    """A bound of how far each exit travels along an edge, shape (m,), [m]; infinite if unbounded.

    An anchor that moves by dB turns the pulley about its swivel axis by at most dB / ρ, which moves
    the exit by at most 2 r dB / ρ, and rolls the cable on it by at most dB / l, which moves the
    exit by r dB / l; ρ is the anchor's distance from the swivel axis and l the free length. The two
    parts of dB are perpendicular.
    """
    radius = rig.pulley_radius
    if radius == 0.0:
        return np.zeros(rig.cable_count)
    travel = anchor_motion(rig, start, end)
    # Wherever it is on the way, an anchor is within half its travel of one of its ends.
    ends = np.stack([start.apply(rig.anchors), end.apply(rig.anchors)]) - rig.outlets
    along = np.sum(ends * rig.feed_directions, axis=-1)
    radial = np.linalg.norm(ends - along[..., None] * rig.feed_directions, axis=-1)
    reach = radial.min(axis=0) - travel / 2.0
    from_centre = np.linalg.norm(ends, axis=-1).min(axis=0) - radius - travel / 2.0
    free = np.sqrt(np.maximum(from_centre**2 - radius**2, 0.0))
    bounded = (reach > 0.0) & (from_centre > radius)
    safe_reach, safe_free = np.where(bounded, reach, 1.0), np.where(bounded, free, 1.0)
    gain = radius * np.maximum(2.0 / safe_reach, 1.0 / safe_free)
    return np.where(bounded, gain * travel, np.inf)
