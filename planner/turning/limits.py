"""The scene's rotation limits along a move; `cdpr.rotation_limits` is the definition."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.exact.compiled import kernel

Array = NDArray[np.float64]


@kernel
def rotations_kept(tilt: float, turn: float, start: Array, end: Array) -> bool:
    """Whether tilt and turn stay within limits, [rad], all along a move between poses."""
    first = 1.0 if start[3] >= 0.0 else -1.0
    cosine = first * (start[3] * end[3] + start[4] * end[4] + start[5] * end[5] + start[6] * end[6])
    last = 1.0 if cosine >= 0.0 else -1.0
    cosine = abs(cosine)
    if turn < math.pi:
        for pose, sign in ((start, first), (end, last)):
            if not sign * pose[3] > 0.0 or not 2.0 * math.atan2(abs(pose[6]), abs(pose[3])) <= turn:
                return False
    bound = math.sin(tilt / 2.0) ** 2
    at_start, at_end = start[4] ** 2 + start[5] ** 2, end[4] ** 2 + end[5] ** 2
    if not max(at_start, at_end) <= bound:
        return False
    across_x = last * end[4] - cosine * first * start[4]
    across_y = last * end[5] - cosine * first * start[5]
    across_z = last * end[6] - cosine * first * start[6]
    across_w = last * end[3] - cosine * first * start[3]
    sine = math.sqrt(across_x**2 + across_y**2 + across_z**2 + across_w**2)
    if sine == 0.0:
        return True
    mean = (at_start + (across_x**2 + across_y**2) / (sine * sine)) / 2.0
    cosine_part = at_start - mean
    sine_part = first * (start[4] * across_x + start[5] * across_y) / sine
    peak = math.atan2(sine_part, cosine_part) % (2.0 * math.pi)
    if peak > 2.0 * math.atan2(sine, cosine):
        return True
    return bool(mean + math.hypot(cosine_part, sine_part) <= bound)
