"""How far a plan tilts and turns the platform, in words."""

from __future__ import annotations

from itertools import pairwise
from math import degrees
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.plan_file import PlanDocument


def rotation_facts(document: PlanDocument) -> list[tuple[str, str]]:
    """One line for a plan on which the platform turns; none for others."""
    from cdpr.rotation_limits import largest_rotations

    poses = [waypoint.pose() for waypoint in document.waypoints]
    if all(pose.angle_to(poses[0]) == 0.0 for pose in poses):
        return []
    found = [largest_rotations(a.quaternion, b.quaternion) for a, b in pairwise(poses)]
    tilt, turn = (degrees(max(values)) for values in zip(*found, strict=True))
    return [("rotation", f"tilted up to {tilt:.2f}°, turned up to {turn:.2f}°")]
