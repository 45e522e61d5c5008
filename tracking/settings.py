"""When a measured pose is believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """When a pose is believed.

    Attributes:
        reprojection_px: Largest RMS error of the corners.
        view_angle: Tags seen more aslant than this are left out, [rad].
        position_deviation: Largest standard deviation of the position along any direction, [m].
        jump: Largest way from the last pose beside what speed allows, [m].
        jump_angle: Largest turn from the last pose, [rad].
        speed: Fastest the platform is expected to go, [m/s].
        turn: Largest turn from the home pose; no cable robot turns by a right angle, [rad].
        single_tag_margin: By how much, in variances, a single tag's pose must fit better than its
            mirror pose.
        camera_moved_px: Frame tags farther off than this mean that the camera was moved.
        camera_check_period: Images between checks of the camera.
    """

    reprojection_px: float = 0.5
    view_angle: float = float(np.radians(76.0))
    position_deviation: float = 0.003
    jump: float = 0.03
    jump_angle: float = 0.25
    speed: float = 0.2
    turn: float = float(np.radians(80.0))
    single_tag_margin: float = 30.0
    camera_moved_px: float = 1.0
    camera_check_period: int = 10
