"""How far a plan tilts and turns the platform, in words."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.plan_file import PlanDocument


def rotation_facts(document: PlanDocument) -> list[tuple[str, str]]:
    """One line for a plan on which the platform turns; none for others."""
    import numpy as np

    from cdpr.rotation_limits import largest_rotations
    from cdpr.statics.dexterity import rms_anchor_radius

    poses = [waypoint.pose() for waypoint in document.waypoints]
    if all(pose.angle_to(poses[0]) == 0.0 for pose in poses):
        return []
    found = [largest_rotations(a.quaternion, b.quaternion) for a, b in pairwise(poses)]
    tilt, turn = (math.degrees(max(values)) for values in zip(*found, strict=True))
    radius = rms_anchor_radius(np.array(document.rig.anchors_mm))
    way = sum(
        math.hypot(a.distance_to(b) * 1e3, radius * a.angle_to(b)) for a, b in pairwise(poses)
    )
    text = f"tilted up to {tilt:.2f}°, turned up to {turn:.2f}°; {way:.1f} mm long with turning"
    return [("rotation", text)]
