"""Travel of the platform after the loss of the master, which a plan's clearance must exceed."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

from drivers.can_load import heartbeat_timeout
from model.errors import Refused
from model.files.rig_file import Cia402Document, OdriveDocument
from model.rig import Rig
from model.statics.wrench_sets import rms_anchor_radius


@dataclass(frozen=True, slots=True)
class LostMaster:
    """Reaction of the drives to the loss of their master.

    Attributes:
        noticed_by: Missing message: SYNC, the heartbeat, or set-points.
        notice: Time until the last drive begins to stop, [s].
        distance: Travel of every point of the platform until it stops, without rotation, [m].
        distance_turning: Largest travel of any point where the platform rotates, [m].
    """

    noticed_by: str
    notice: float
    distance: float
    distance_turning: float


def lost_master(rig: Rig) -> LostMaster:
    """The reaction, from the rig file and its drive profile.

    Drives that interpolate may continue at their last speed until they notice, then decelerate
    uniformly, so the distance is v × (notice + ramp / 2). Along a path v² = |dp/dt|² + (ρ ω)², with
    ρ the RMS distance of the anchors, so a point at the distance R from the platform's origin moves
    at up to |dp/dt| + R ω ≤ v √(1 + (R/ρ)²).

    Raises:
        BadInput: There is no such profile, or its file is invalid.
    """
    cycle = rig.cycle
    drives = rig.document.drives
    if isinstance(drives, Cia402Document):
        noticed_by, notice, ramp = _cia402_times(rig)
    else:
        noticed_by, notice, ramp = "set-points", _watchdog(drives), cycle
    distance = rig.motion.speed * (notice + 0.5 * ramp)
    turning = hypot(1.0, rig.reach / rms_anchor_radius(rig.anchors))
    return LostMaster(noticed_by, notice, distance, turning * distance)


def _cia402_times(rig: Rig) -> tuple[str, float, float]:
    """Missing message, time until the last CiA 402 drive notices, and its ramp, [s]."""
    from drivers.cia402.object_dictionary import QUICK_STOP_RAMP, quick_stop_ramp, quick_stop_time
    from drivers.cia402.profile import profile_of

    cycle, profile = rig.cycle, profile_of(rig)
    allowed = profile.range_of(QUICK_STOP_RAMP, 0)
    wanted = max(quick_stop_ramp(rig, i, cycle, profile) for i in range(rig.cable_count))
    ramp = cycle if allowed is None else quick_stop_time(wanted, allowed, cycle)
    if profile.monitoring == "heartbeat":
        return "heartbeat", heartbeat_timeout(cycle), ramp
    return "SYNC", profile.sync_timeout_periods * cycle, ramp


def _watchdog(drives: OdriveDocument) -> float:
    """Watchdog time, [s]; arming requires one."""
    return (drives.watchdog_ms or 0.0) / 1000.0


def require_stopping_room(rig: Rig, clearance: float, *, turns: bool) -> None:
    """Requires that the platform stops before it touches an obstacle after a loss of the master.

    Args:
        rig: The robot.
        clearance: Proved for the whole path, [m]; infinite without obstacles.
        turns: Whether the platform rotates along it.

    Raises:
        Refused: The clearance is smaller than the distance to a stop.
    """
    lost = lost_master(rig)
    distance = lost.distance_turning if turns else lost.distance
    if clearance >= distance:
        return
    where = " along a path that rotates the platform" if turns else ""
    raise Refused(
        f"the path comes within {clearance * 1000:.1f} mm of an obstacle; without its master the"
        f" platform travels up to {distance * 1000:.1f} mm",
        where="set-point table",
        why=f"the drives detect the loss by {lost.noticed_by} after {lost.notice * 1000:.0f} ms, at"
        f" {rig.motion.speed * 1000:g} mm/s{where}",
        next_step="plan with a larger clearance, or lower motion.speed_mm_s; nothing was armed",
        values={"clearance_mm": clearance * 1000.0, "distance_mm": distance * 1000.0},
    )
