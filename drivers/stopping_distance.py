"""How far the platform goes on when the master is lost: what the clearance of a plan must hold."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.can_load import heartbeat_timeout
from model.errors import Refused
from model.files.rig_file import Cia402Document, OdriveDocument
from model.rig import Rig


@dataclass(frozen=True, slots=True)
class LostMaster:
    """What drives do without their master.

    Attributes:
        noticed_by: What stays away: SYNC, the heartbeat, or set-points.
        notice: Until the last drive begins to stop, [s].
        ramp: Until it stands then, [s].
        distance: How far the platform goes meanwhile at the rig's speed along the path, [m].
    """

    noticed_by: str
    notice: float
    ramp: float
    distance: float


def lost_master(rig: Rig) -> LostMaster:
    """From the rig file and its drive profile.

    Drives that interpolate may go on at their last speed until they notice, and then slow down
    evenly, so the distance is speed × (notice + ramp / 2).

    Raises:
        BadInput: There is no such profile, or its file is wrong.
    """
    cycle = rig.cycle
    drives = rig.document.drives
    if isinstance(drives, Cia402Document):
        noticed_by, notice, ramp = _cia402_times(rig)
    else:
        noticed_by, notice, ramp = "set-points", _watchdog(drives), cycle
    distance = rig.motion.speed * (notice + 0.5 * ramp)
    return LostMaster(noticed_by, notice, ramp, distance)


def _cia402_times(rig: Rig) -> tuple[str, float, float]:
    """What CiA 402 drives miss, when the last one notices, and its ramp, [s]."""
    # Their objects are not loaded for drives of another protocol.
    from drivers.cia402.object_dictionary import quick_stop_ramp
    from drivers.cia402.profile import profile_of

    cycle, profile = rig.cycle, profile_of(rig)
    steepest = profile.range_of(0x6085, 0)
    wanted = max(quick_stop_ramp(rig, i, cycle, profile) for i in range(rig.cable_count))
    ramp = cycle if steepest is None else cycle * max(1.0, wanted / max(1, steepest.high))
    if profile.monitoring == "heartbeat":
        return "heartbeat", heartbeat_timeout(cycle), ramp
    return "SYNC", profile.sync_timeout_periods * cycle, ramp


def _watchdog(drives: OdriveDocument) -> float:
    """Without one nothing is armed."""
    return (drives.watchdog_ms or 0.0) / 1000.0


def require_stopping_room(rig: Rig, clearance: float) -> None:
    """A platform whose master is lost stands before it touches anything.

    Args:
        rig: The robot.
        clearance: Proved along the whole path, [m]; infinite without obstacles.

    Raises:
        Refused: The clearance is smaller than the distance to a stop.
    """
    lost = lost_master(rig)
    if not clearance < lost.distance:
        return
    raise Refused(
        f"the path comes within {clearance * 1000:.1f} mm of an obstacle; without its master the"
        f" platform travels up to {lost.distance * 1000:.1f} mm",
        where="set-point table",
        why=f"the drives detect the loss by {lost.noticed_by} after {lost.notice * 1000:.0f} ms, at"
        f" {rig.motion.speed * 1000:g} mm/s",
        next_step="plan with a larger clearance, or lower motion.speed_mm_s; nothing was armed",
        values={"clearance_mm": clearance * 1000.0, "distance_mm": lost.distance * 1000.0},
    )
