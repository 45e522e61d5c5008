"""How far a winch's drive may ever have to turn."""

from __future__ import annotations

import math

import numpy as np

from cdpr.errors import BadInput
from cdpr.rig import Rig
from cdpr.winches import WinchMap


def position_limits(rig: Rig, drive: int, winch_map: WinchMap) -> tuple[int, int]:
    """Software limits: positions with the platform anywhere in its workspace, any way turned.

    Raises:
        BadInput: They do not fit the 32-bit position of the drive.
    """
    outlet, reach = rig.outlets[drive], float(np.linalg.norm(rig.anchors[drive]))
    wrapped = 2.0 * math.pi * rig.pulley_radius
    nearest = np.clip(outlet, rig.workspace_lower, rig.workspace_upper)
    middle = (rig.workspace_lower + rig.workspace_upper) / 2.0
    farthest = np.where(outlet > middle, rig.workspace_lower, rig.workspace_upper)
    shortest = max(0.0, float(np.linalg.norm(outlet - nearest)) - reach)
    longest = float(np.linalg.norm(outlet - farthest)) + reach + wrapped
    lengths = np.zeros((2, rig.cable_count))
    lengths[:, drive] = shortest, longest
    tensions = np.array([[rig.max_tension], [0.0]])
    ends = winch_map.counts(winch_map.unstrained(lengths, tensions))[:, drive]
    low, high = math.floor(min(ends)), math.ceil(max(ends))
    if low < -(2**31) or high >= 2**31:
        raise BadInput(
            f"positions from {low} to {high} counts do not fit the drive's 32 bits",
            where=f"rig {rig.name}: winches[{drive}]",
            next_step="choose home_counts nearer to 0, or fewer counts a metre of cable",
        )
    return low, high
