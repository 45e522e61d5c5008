"""The limits that gate, watch and verdict judge by, from the rig and the checked table."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cdpr.rig import Rig
from executor.safety.gate import Limits
from executor.safety.watch import WatchLimits

#: A cable is slack below this share of the least planned tension. Plans run at the least tension
#: itself (in 6 % of the paper rig's box), and a whole count is worth 1.7 N there: not yet slack.
SLACK_SHARE = 0.5
#: Below this share of it a cable carries nothing: it is torn, or hangs loose.
LOOSE_SHARE = 0.1
#: Steps of set-points below this share of the largest following error say nothing about a drive
#: that stands still: it may rest on its own friction.
LEAST_STEP_SHARE = 0.01
#: Above this share of the largest planned tension a cable is overloaded; torque is read in ‰.
OVERLOAD_SHARE = 1.02


def tension_limits(rig: Rig) -> tuple[float, float]:
    """Below the first a cable is slack, above the second overloaded, [N]."""
    return SLACK_SHARE * rig.min_tension, OVERLOAD_SHARE * rig.max_tension


def watch_limits(rig: Rig, *, slack_counts: bool = True) -> WatchLimits:
    """When the watch speaks up.

    Args:
        rig: The robot.
        slack_counts: A cable that hangs slack is wrong; otherwise only one whose tension is no
            number.
    """
    low, high = tension_limits(rig)
    return WatchLimits(
        following_error=rig.motion.following_error,
        min_tension=low if slack_counts else -math.inf,
        max_tension=high,
        no_tension=LOOSE_SHARE * rig.min_tension if slack_counts else -math.inf,
    )


def least_steps(rig: Rig) -> tuple[int, ...]:
    """Steps of set-points that a drive must follow at once, one a drive, [counts]."""
    least = LEAST_STEP_SHARE * rig.motion.following_error
    return tuple(max(2, math.ceil(least * abs(w.counts_per_metre))) for w in rig.winches)


def gate_limits(rig: Rig, setpoints: NDArray[np.int32], cycle: float) -> Limits:
    """The table's own range with the start tolerance, the winches' speed, the following error.

    Args:
        rig: The robot.
        setpoints: The checked table, shape (n, m), [counts].
        cycle: [s].
    """
    per_metre = np.abs([w.counts_per_metre for w in rig.winches])
    margin = np.ceil(per_metre * rig.motion.start_tolerance).astype(int)
    speeds = np.array([w.max_speed for w in rig.winches])
    rows = setpoints.astype(np.int64)
    step = np.floor(per_metre * speeds * cycle).astype(int) + 1
    # The actual position is of one cycle before, and the drives follow one cycle behind.
    lag = np.floor(per_metre * rig.motion.following_error).astype(int) + 2 * step
    return Limits(
        lowest=tuple((rows.min(axis=0) - margin).tolist()),
        highest=tuple((rows.max(axis=0) + margin).tolist()),
        largest_step=tuple(step.tolist()),
        largest_lag=tuple(lag.tolist()),
    )
