"""Limits for gate, monitors and verdict, from the rig and the checked table."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from executor.safety.gate import Limits
from executor.safety.monitor import MonitorLimits
from executor.safety.stall import StuckLimits
from executor.safety.sync_timeout import SyncAge
from model.files.rig_file import OdriveDocument
from model.rig import Rig

#: A cable is slack below this share of the least planned tension. Plans reach the least tension
#: itself (in 6 % of the paper rig's box), and one count changes it by 1.7 N: not yet slack.
SLACK_SHARE = 0.5
#: Below this share of it a cable has no tension: broken or slack.
LOOSE_SHARE = 0.1
#: Set-points and positions are whole counts: together a noise of one count. A drive is judged
#: over at least 8/3 of the noise. See `executor.safety.stall`.
LEAST_TRAVEL = 3
#: A step of one count from reply to reply may be rounding alone, [counts].
LEAST_STEP = 2
#: Above this share of the largest planned tension a cable is overloaded; torque is read in ‰.
OVERLOAD_SHARE = 1.02


def tension_limits(rig: Rig) -> tuple[float, float]:
    """Tensions below which a cable is slack and above which it is overloaded, [N]."""
    return SLACK_SHARE * rig.min_tension, OVERLOAD_SHARE * rig.max_tension


def monitor_limits(rig: Rig, sync_age: SyncAge, *, slack_counts: bool = True) -> MonitorLimits:
    """Limits of the monitor.

    Args:
        sync_age: Limit on the age of the last SYNC.
        slack_counts: Whether a slack cable is a fault; otherwise only a tension of NaN is.
    """
    low, high = tension_limits(rig)
    return MonitorLimits(
        following_error=rig.motion.following_error,
        min_tension=low if slack_counts else -math.inf,
        max_tension=high,
        no_tension=LOOSE_SHARE * rig.min_tension if slack_counts else -math.inf,
        gone_periods=sync_age.limit - 1.0,
        may_disarm=isinstance(rig.document.drives, OdriveDocument),
    )


def stuck_limits(rig: Rig, cycle: float) -> tuple[StuckLimits, ...]:
    """Limits of stall detection per drive, from the rig file's motion.

    Args:
        cycle: [s].
    """
    drives = rig.document.drives
    reply = drives.estimates_ms / 1000.0 if isinstance(drives, OdriveDocument) else cycle
    period = math.floor(max(cycle, reply) / cycle + 1e-9)
    step, travel = rig.motion.stuck_speed * cycle, rig.motion.stuck_travel
    return tuple(
        StuckLimits(
            least=max(LEAST_STEP / period, step * abs(winch.counts_per_metre)),
            travel=max(LEAST_TRAVEL, math.ceil(travel * abs(winch.counts_per_metre))),
            period=period,
        )
        for winch in rig.winches
    )


def gate_limits(rig: Rig, setpoints: NDArray[np.int32], cycle: float) -> Limits:
    """The table's own range with the start tolerance, the winches' speed, the following error.

    Args:
        setpoints: The checked table, shape (n, m), [counts].
        cycle: [s].
    """
    per_metre = np.abs([w.counts_per_metre for w in rig.winches])
    margin = np.ceil(per_metre * rig.motion.start_tolerance).astype(int)
    speeds = np.array([w.max_speed for w in rig.winches])
    rows = setpoints.astype(np.int64)
    step = np.floor(per_metre * speeds * cycle).astype(int) + 1
    # The actual position is one cycle old, and the drives follow one cycle behind.
    lag = np.floor(per_metre * rig.motion.following_error).astype(int) + 2 * step
    return Limits(
        lowest=tuple((rows.min(axis=0) - margin).tolist()),
        highest=tuple((rows.max(axis=0) + margin).tolist()),
        largest_step=tuple(step.tolist()),
        largest_lag=tuple(lag.tolist()),
    )
